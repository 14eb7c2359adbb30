"""The wall as tetrahedra: its inner and its outer side as two shells."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry.tetrahedra import boundary_faces, volumes
from lacli.geometry.triangles import area_normals

SEEDS, RAYS = 500, 24
SEEN_FROM_INSIDE = 0.5  # share of the directions from a face that meet the wall again: inside the cavity most, outside few
THICK = 2.0  # of the median way through the wall: a face with a longer one is a cut face at an opening
FAR_MM = 200.0
MANY_RIMS = 10


def shells(points: FloatArray, tets: IntArray, tag: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Triangles (t, 3) of the inner side of a wall of tetrahedra (m, 4) in mm, the tags (t,) behind them, and triangles of the
    outer side; cut faces are left out.

    A face belongs to the endocardium where most directions from it meet the wall again. Raises AnatomyError where there are no
    two sides.
    """
    size = volumes(points, tets)
    tets = tets.copy()
    tets[size < 0] = tets[size < 0][:, [0, 2, 1, 3]]
    faces, owner = boundary_faces(tets[np.abs(size) > 0])
    tags = tag[np.abs(size) > 0][owner]
    middle = points[faces].mean(axis=1)
    normal = area_normals(points[faces])
    area = 0.5 * np.linalg.norm(normal, axis=1)
    normal /= np.maximum(2.0 * area, 1e-30)[:, None]
    tree = _obstacle(points, faces)
    through = np.array([_way(tree, m, -n) for m, n in zip(middle, normal, strict=True)])
    cut = through > THICK * float(np.median(through))
    inside = _visibility(tree, middle, normal, ~cut) > SEEN_FROM_INSIDE
    sides = []
    for side in (inside & ~cut, ~inside & ~cut):
        _, part = paths.triangle_components(faces, side)
        if not side.any():
            sides.append(side)
            continue
        sides.append(part == int(np.argmax(np.bincount(part[side], area[side]))))
    sizes = [float(area[s].sum()) for s in sides]
    if min(sizes) < 0.3 * max(sizes):
        raise AnatomyError(
            f"the tetrahedra have no inner and outer side ({sizes[0]:.0f} and {sizes[1]:.0f} mm2 were told apart): is it a wall, "
            "open at the valve? Give the endocardium as a surface."
        )
    inner, outer = sides
    rims = len(paths.loops(paths.open_edges(faces[inner])))
    if rims > MANY_RIMS:
        raise AnatomyError(
            f"the inner side of the tetrahedra comes out in rags ({rims} rims where a wall has 5 or 6): cells are cut along "
            "their faces at the openings. Give the endocardium as a surface (.vtp, .stl or CARP Tr elements)."
        )
    return faces[inner], tags[inner], faces[outer]


def _obstacle(points: FloatArray, faces: IntArray) -> Any:
    import pyvista as pv
    import vtk

    tree = vtk.vtkOBBTree()
    tree.SetDataSet(pv.PolyData.from_regular_faces(points, faces))
    tree.BuildLocator()
    return tree


def _way(tree: Any, start: FloatArray, direction: FloatArray) -> float:
    """How far (mm) the next face is from just beside ``start``; FAR_MM where there is none."""
    import vtk

    hits = vtk.vtkPoints()
    begin = start + 0.05 * direction
    if not tree.IntersectWithLine(begin.tolist(), (start + FAR_MM * direction).tolist(), hits, None):
        return FAR_MM
    found = np.array([hits.GetPoint(i) for i in range(hits.GetNumberOfPoints())])
    return float(np.linalg.norm(found - start, axis=1).min())


def _visibility(tree: Any, middle: FloatArray, normal: FloatArray, chosen: np.ndarray) -> FloatArray:
    """(t,) share of the directions off each face that meet the wall again: of SEEDS of the chosen, the mean of the nearest."""
    rng = np.random.default_rng(7)
    seed = rng.permutation(np.flatnonzero(chosen))[:SEEDS]
    rays = rng.normal(size=(RAYS, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    share = np.empty(len(seed))
    for k, i in enumerate(seed):
        out = np.where((rays @ normal[i])[:, None] < 0, -rays, rays)
        share[k] = np.mean([_way(tree, middle[i], d) < FAR_MM for d in out])
    # alike in place and in direction: the two sides of the wall lie 2 mm apart but look opposite ways
    _, near = cKDTree(np.hstack([middle[seed], 15.0 * normal[seed]])).query(
        np.hstack([middle, 15.0 * normal]), k=min(5, len(seed))
    )
    return np.asarray(share[near].reshape(len(middle), -1).mean(axis=1))
