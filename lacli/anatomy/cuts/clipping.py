"""Cutting a closed surface at planes: the far piece goes, a flat labelled cap closes the hole."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry.surface import Surface, compact
from lacli.geometry.triangles import split_at

SNAP = 0.2  # of the mean edge: points nearer than that are moved onto the plane, so that no slivers arise


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
    beyond_it = (part == chosen) & (height[surface.triangles].mean(axis=1) > 0)  # not those that merely touch the plane
    if surface.areas()[beyond_it].sum() > 0.5 * surface.area_mm2():
        raise AnatomyError(
            f"the cutting plane of the {what} would remove more than half of the atrium; "
            "turn its normal (out of the atrium) or move its centre in landmarks.toml."
        )
    zone = np.zeros(len(surface.points), dtype=bool)
    zone[surface.triangles[part == chosen]] = True
    kept = _split(surface, np.where(zone & (past == going), height, -1.0), normal)
    return compact(_close(kept, normal, label, what))


def _split(surface: Surface, field: FloatArray, normal: FloatArray) -> Surface:
    """The part where the field (n,), a height over a plane along ``normal``, is not positive; points near zero are put on it."""
    edges, _, of = paths.edge_table(surface.triangles)
    typical = float(np.linalg.norm(surface.points[edges[:, 0]] - surface.points[edges[:, 1]], axis=1).mean())
    close = np.abs(field) < SNAP * typical
    points = surface.points - np.where(close, field, 0.0)[:, None] * normal
    field = np.where(close, 0.0, field)
    first, second = field[edges[:, 0]], field[edges[:, 1]]
    crossed = first * second < 0
    share = (first / np.where(crossed, first - second, 1.0))[crossed, None]
    new = np.full(len(edges), -1, dtype=np.int64)
    new[crossed] = len(points) + np.arange(int(crossed.sum()))
    points = np.vstack([points, points[edges[crossed, 0]] * (1 - share) + points[edges[crossed, 1]] * share])
    triangles, labels = split_at(surface.triangles, surface.label, new[of])
    value = np.concatenate([field, np.zeros(int(crossed.sum()))])[triangles]
    keep = (value <= 0).all(axis=1) & (value < 0).any(axis=1)
    return Surface(points, triangles[keep], labels[keep])


def _close(surface: Surface, normal: FloatArray, label: int, what: str) -> Surface:
    rims = paths.loops(paths.open_edges(surface.triangles))
    if not rims:
        raise AnatomyError(f"cutting the {what} left no rim; correct its centre in landmarks.toml.")
    points, triangles, labels = surface.points, [surface.triangles], [surface.label]
    for rim in rims:
        points, cap = fill_rim(points, rim, surface.triangles)
        triangles.append(cap)
        labels.append(np.full(len(cap), label, dtype=np.int64))
    return Surface(points, np.vstack(triangles), np.concatenate(labels))


def fill_rim(points: FloatArray, rim: IntArray, neighbours: IntArray) -> tuple[FloatArray, IntArray]:
    """Points and triangles over a rim (k,), oriented to fit ``neighbours``.

    Ears are cut; where that would double an edge that is there already, triangles meet in a new point in the middle.
    """
    cap = _ears(points, rim, neighbours)
    beside = neighbours[np.isin(neighbours, rim).sum(axis=1) >= 2]
    size = len(points) + 1

    def inner(triangles: IntArray) -> IntArray:
        pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        return pairs[:, 0] * size + pairs[:, 1]

    own = np.sort(np.column_stack([rim, np.roll(rim, -1)]), axis=1)
    chords = np.setdiff1d(inner(cap), own[:, 0] * size + own[:, 1])
    if not np.isin(chords, inner(beside)).any():
        return points, cap
    follows = {(int(a), int(b)) for a, b in cap[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)}
    ordered = rim if (int(rim[0]), int(rim[1])) in follows else rim[::-1]
    fan = np.column_stack([ordered, np.roll(ordered, -1), np.full(len(rim), len(points))])
    return np.vstack([points, points[rim].mean(axis=0)]), fan


def _ears(points: FloatArray, rim: IntArray, neighbours: IntArray) -> IntArray:
    import vtk

    directed = {
        (int(a), int(b)) for a, b in neighbours[np.isin(neighbours, rim).any(axis=1)][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    }
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
