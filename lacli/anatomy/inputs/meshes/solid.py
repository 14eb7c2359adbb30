"""The wall as tetrahedra: its inner and its outer side as two shells."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry.tetrahedra import boundary_faces, volumes
from lacli.geometry.triangles import area_normals

RAYS = 48
VOXEL_MM = 1.0  # of the wall that rays meet
REACH_MM = 80.0
LOOK_MM = 15.0  # how much a right angle between two normals counts when the nearest face alike is looked for
THICK = 2.0  # of the median way through the wall: a face with a longer one is a cut face at an opening
OPPOSITE = -0.7  # cosine of the normals of a face and of the one behind it through the wall, at most
FAR_MM = 200.0
MANY_RIMS = 10
CREASE_DEG = 30.0  # a border between the sides costs exp(-(bend / that)^2) of its length
STIFF = 2.0  # weight of the border's length (over the mean edge's) against what faces see
SCALE = 1000.0  # the minimum cut takes whole numbers


def shells(points: FloatArray, tets: IntArray, tag: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Triangles (t, 3) of the inner side of a wall of tetrahedra (m, 4) in mm, the tags (t,) behind them, and triangles of the
    outer side; cut faces are left out.

    A face belongs to the endocardium where it sees more of the wall than the face behind it does; the borders between the sides
    are the shortest along creases (a minimum cut). Raises AnatomyError where there are no two sides.
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
    typical = float(np.median(through))
    cut = through > THICK * typical
    seen = visibility(points, faces, middle, normal)
    _, behind = cKDTree(np.hstack([middle, LOOK_MM * normal])).query(np.hstack([middle - typical * normal, -LOOK_MM * normal]))
    aslant = np.einsum("ij,ij->i", normal, normal[behind]) > OPPOSITE  # zigzag rims are short of wall behind them as well
    lean = np.where(cut | aslant, 0.0, seen - seen[behind])
    sides = [_largest(faces, area, mine) for mine in _parted(points, faces, normal, lean)]
    sizes = [float(area[s].sum()) for s in sides]
    if min(sizes) <= 0.3 * max(sizes):
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


def visibility(points: FloatArray, faces: IntArray, middle: FloatArray, normal: FloatArray) -> FloatArray:
    """(t,) share of the directions off each face that meet the wall again, weighted by their cosine."""
    low = points[faces].min(axis=(0, 1)) - 2 * VOXEL_MM
    samples = _samples(points[faces], 0.5 * VOXEL_MM)
    shape = np.ceil((points[faces].max(axis=(0, 1)) + 2 * VOXEL_MM - low) / VOXEL_MM).astype(np.int64) + 1
    wall = np.zeros(tuple(shape), dtype=bool)
    wall[tuple(((samples - low) / VOXEL_MM).astype(np.int64).T)] = True
    rays = _sphere(RAYS)
    steps = np.arange(2.0 * VOXEL_MM, REACH_MM, 0.7 * VOXEL_MM)
    total, met = np.zeros(len(faces)), np.zeros(len(faces))
    for ray in rays:
        cosine = normal @ ray
        mine = np.flatnonzero(cosine > 0.2)
        start = (middle[mine] + 1.2 * VOXEL_MM * normal[mine] - low) / VOXEL_MM
        hit = np.zeros(len(mine), dtype=bool)
        left = np.arange(len(mine))
        for step in steps:
            at = (start[left] + step / VOXEL_MM * ray).astype(np.int64)
            inside = ((at >= 0) & (at < shape)).all(axis=1)
            left, at = left[inside], at[inside]
            if not len(left):
                break
            there = wall[tuple(at.T)]
            hit[left[there]] = True
            left = left[~there]
        total[mine] += cosine[mine]
        met[mine] += cosine[mine] * hit
    return np.asarray(met / np.maximum(total, 1e-9))


def _samples(corner: FloatArray, apart: float) -> FloatArray:
    """Points on triangles (t, 3, 3) not farther from each other than about ``apart``."""
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    count = np.clip(np.ceil(longest / apart).astype(int), 1, 60)
    found = []
    for n in np.unique(count):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        keep = i + j <= n
        a, b = (i[keep] / n)[:, None], (j[keep] / n)[:, None]
        c = corner[count == n][:, None]
        found.append((c[:, :, 0] * (1 - a - b) + c[:, :, 1] * a + c[:, :, 2] * b).reshape(-1, 3))
    return np.vstack(found)


def _sphere(count: int) -> FloatArray:
    """Directions (count, 3) spread evenly (golden spiral)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


def _parted(points: FloatArray, faces: IntArray, normal: FloatArray, lean: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Faces (t,) of the inner and of the outer side: what faces lean to (> 0 inner) against the length of smooth border."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    edges, _, of = paths.edge_table(faces)
    sides, edge = paths.side_pairs(of)
    one, two = sides.T // 3
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    bend = np.degrees(np.arccos(np.clip((normal[one] * normal[two]).sum(axis=1), -1.0, 1.0)))
    border = STIFF * length[edge] / length.mean() * np.maximum(np.exp(-((bend / CREASE_DEG) ** 2)), 0.02)
    n = len(faces)
    every = np.arange(n)
    found = []
    for bias in (-0.02, 0.02):  # faces that lean nowhere (of cuts) are no part of the side that is sought
        pull = np.round(SCALE * (lean + bias)).astype(np.int32)
        rows = np.concatenate([one, two, np.full(n, n), every])
        columns = np.concatenate([two, one, every, np.full(n, n + 1)])
        whole = np.round(SCALE * border).astype(np.int32)
        room = np.concatenate([whole, whole, np.maximum(pull, 0), np.maximum(-pull, 0)])
        graph = coo_matrix((room, (rows, columns)), shape=(n + 2, n + 2)).tocsr().astype(np.int32)
        rest = graph - maximum_flow(graph, n, n + 1).flow
        rest.data[rest.data < 0] = 0
        rest.eliminate_zeros()
        reached = np.zeros(n + 2, dtype=bool)
        reached[breadth_first_order(rest, n, return_predecessors=False)] = True
        found.append(reached[:n])
    return found[0], ~found[1]


def _largest(faces: IntArray, area: FloatArray, side: BoolArray) -> BoolArray:
    """The largest part of a side, without islands: whatever hangs together with the other side alone is no part of it."""
    for mine in (True, False):
        chosen = side == mine
        if not chosen.any() or chosen.all():
            return side
        _, part = paths.triangle_components(faces, chosen)
        stray = chosen & (part != int(np.argmax(np.bincount(part[chosen], area[chosen]))))
        side = np.where(stray, not mine, side)
    return side


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
