"""Cutting a closed surface at planes: the far piece goes, a flat labelled cap closes the hole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lacli.anatomy import paths
from lacli.anatomy.surface import Surface, compact
from lacli.errors import AnatomyError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def cut(surface: Surface, centre: FloatArray, normal: FloatArray, beyond: FloatArray, label: int, what: str) -> Surface:
    """Remove what lies past the plane and is connected to the point nearest ``beyond``; close it with a cap of ``label``.

    centre, normal (3,): the plane, its normal out of the cavity; beyond (3,) mm: a point of the piece to go.
    Raises AnatomyError where the plane does not cut the surface there, or would take more than half of it.
    """
    height = (surface.points - centre) @ normal
    past = height > 0
    touched = past[surface.triangles].any(axis=1)
    _, part = paths.triangle_components(surface.triangles, touched)
    seeds = np.flatnonzero(touched & past[surface.triangles].all(axis=1))
    if len(seeds) == 0:
        raise AnatomyError(f"the cutting plane of the {what} does not meet the surface; correct its centre in landmarks.toml.")
    middle = surface.points[surface.triangles[seeds]].mean(axis=1)
    chosen = part[seeds[int(np.argmin(np.linalg.norm(middle - beyond, axis=1)))]]
    going = np.zeros(len(surface.points), dtype=bool)
    going[surface.triangles[part == chosen]] = True
    going &= past
    if surface.areas()[part == chosen].sum() > 0.5 * surface.area_mm2():
        raise AnatomyError(
            f"the cutting plane of the {what} would remove more than half of the atrium; "
            "turn its normal (out of the atrium) or move its centre in landmarks.toml."
        )
    field = np.where(going, np.maximum(height, 1e-9), np.minimum(height, -1e-9))
    points, triangles, labels, side = split(surface, field)
    kept = Surface(points, triangles[~side], labels[~side])
    return compact(_close(kept, normal, label, what))


def split(surface: Surface, field: FloatArray) -> tuple[FloatArray, IntArray, IntArray, BoolArray]:
    """Cut triangles where the point field (n,) changes sign: points, triangles, labels, and (t,) whether field > 0."""
    edges, _, of = paths.edge_table(surface.triangles)
    a, b = field[edges[:, 0]], field[edges[:, 1]]
    crossed = (a > 0) != (b > 0)
    weight = np.where(crossed, a / np.where(crossed, a - b, 1.0), 0.0)
    weight = np.clip(weight, 0.02, 0.98)  # no points of zero distance; 2 % of an edge of the fine surface
    new = np.full(len(edges), -1, dtype=np.int64)
    new[crossed] = len(surface.points) + np.arange(int(crossed.sum()))
    at = surface.points[edges[crossed, 0]] + weight[crossed, None] * (surface.points[edges[crossed, 1]] - surface.points[edges[crossed, 0]])
    points = np.vstack([surface.points, at])
    middle = new[of]
    count = (middle >= 0).sum(axis=1)
    whole = count == 0
    triangles, labels = [surface.triangles[whole]], [surface.label[whole]]
    positive = [field[surface.triangles[whole, 0]] > 0]
    chosen = np.flatnonzero(count == 2)
    if len(chosen):
        # turn so that the lone corner comes first: its sides 01 and 20 are cut
        t, m = surface.triangles[chosen], middle[chosen]
        lone = (np.argmin(m >= 0, axis=1) + 2) % 3
        index = (lone[:, None] + np.arange(3)) % 3
        corner, p, q = np.take_along_axis(t, index, axis=1).T
        side = np.take_along_axis(m, index, axis=1)
        first, last = side[:, 0], side[:, 2]
        for piece, of_corner in (((corner, first, last), True), ((first, p, q), False), ((first, q, last), False)):
            triangles.append(np.column_stack(piece))
            labels.append(surface.label[chosen])
            is_positive = field[corner] > 0
            positive.append(is_positive if of_corner else ~is_positive)
    return points, np.vstack(triangles), np.concatenate(labels), np.concatenate(positive)


def _close(surface: Surface, normal: FloatArray, label: int, what: str) -> Surface:
    rims = paths.loops(paths.open_edges(surface.triangles))
    if not rims:
        raise AnatomyError(f"cutting the {what} left no rim; correct its centre in landmarks.toml.")
    triangles, labels = [surface.triangles], [surface.label]
    for rim in rims:
        cap = fill_rim(surface.points, rim, surface.triangles)
        triangles.append(cap)
        labels.append(np.full(len(cap), label, dtype=np.int64))
    return Surface(surface.points, np.vstack(triangles), np.concatenate(labels))


def fill_rim(points: FloatArray, rim: IntArray, neighbours: IntArray) -> IntArray:
    """Triangles (k - 2, 3) over a rim (k,), no new points, oriented to fit ``neighbours``."""
    import vtk

    directed = {(int(a), int(b)) for a, b in neighbours[np.isin(neighbours, rim).any(axis=1)][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)}
    if (int(rim[0]), int(rim[1])) in directed:
        rim = rim[::-1]
    polygon = vtk.vtkPolygon()
    polygon.GetPointIds().SetNumberOfIds(len(rim))
    polygon.GetPoints().SetNumberOfPoints(len(rim))
    for i, point in enumerate(points[rim]):
        polygon.GetPointIds().SetId(i, i)
        polygon.GetPoints().SetPoint(i, *point.tolist())
    ids = vtk.vtkIdList()
    good = polygon.TriangulateLocalIds(0, ids)
    local = np.array([ids.GetId(i) for i in range(ids.GetNumberOfIds())], dtype=np.int64).reshape(-1, 3)
    if not good or len(local) != len(rim) - 2:
        local = _fan(len(rim))
    cap = rim[local]
    # ear cutting keeps the rim's direction; make sure with the rim's own edges
    forward = {(int(rim[i]), int(rim[(i + 1) % len(rim)])) for i in range(len(rim))}
    hits = sum((int(a), int(b)) in forward for a, b in cap[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    return cap if hits == len(rim) else cap[:, ::-1].copy()


def _fan(size: int) -> IntArray:
    i = np.arange(1, size - 1)
    return np.column_stack([np.zeros(size - 2, dtype=np.int64), i, i + 1])
