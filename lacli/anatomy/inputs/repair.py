"""Surfaces as other tools write them: put in millimetres, cleaned, closed; everything done is said."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lacli.anatomy.cuts import clipping, closing
from lacli.anatomy.inputs.flat_caps import flat_caps
from lacli.anatomy.inputs.meshes.surfacefile import unit_scale
from lacli.anatomy.inputs.voxels import from_voxels
from lacli.anatomy.openings.candidate import RIM, Candidate, area_vector, of_ring
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry.surface import Surface, compact, defects, nearest

MANY_TRIANGLES = 400_000
MANY_HOLES = 300
FEW_BAD_EDGES = 60  # non-manifold edges: so many are mended, with more the surface is rebuilt
OPENINGS_LEAST = 5  # the mitral valve and four veins
OPENING_MM = 10.0  # rims at least this long are openings (veins, valve), shorter ones damage


@dataclass(frozen=True)
class Repaired:
    """A closed surface, the openings it had (widest first; each has its cap's label on the surface, 0 where the surface was
    rebuilt), what was done in words, the factor from the file's unit to mm, and the wall's outer side where the file had it."""

    surface: Surface
    rims: tuple[Candidate, ...]
    notes: tuple[str, ...]
    scale: float
    outer: Surface | None = None


def repair(points: FloatArray, triangles: IntArray, unit: str | None = None, outside: IntArray | None = None) -> Repaired:
    """A closed, outward oriented surface in mm from whatever triangles there are.

    Clean surfaces keep their triangles and get caps over their openings. Where edges stay non-manifold, or holes are many, the
    surface is rebuilt from voxels (0.5 mm). ``outside``: triangles of the wall's outer side, where the input tells it. Raises
    AnatomyError where there is no closed cavity to be had.
    """
    notes: list[str] = []
    bad = np.asarray(~np.isfinite(points).all(axis=1))
    if bad.any():
        hit = bad[triangles].any(axis=1)
        triangles = triangles[~hit]
        notes.append(f"{int(hit.sum())} triangles with coordinates that are not finite were dropped")
        points = np.where(bad[:, None], 0.0, points)
        if len(triangles) == 0:
            raise AnatomyError("no triangle has finite coordinates.")
        points, triangles = _used(points, triangles)
    scale, words = unit_scale(points[np.unique(triangles)], unit)
    if words:
        notes.append(words)
    points = points * scale
    outer = None if outside is None else _bare(points, outside)
    if len(triangles) > MANY_TRIANGLES:
        before = len(triangles)
        points, triangles = _cluster(points, triangles)
        notes.append(f"{before} triangles were thinned to {len(triangles)}")
    points, triangles = _merge(points, triangles, notes)
    triangles = _mended(triangles, notes)
    if outer is None:
        triangles, outside = _inner(points, triangles, notes)
        outer = None if outside is None else _bare(points, outside)
    triangles = _largest(points, triangles, notes)
    points, triangles = _used(points, triangles)
    triangles, manifold = _orient(triangles, notes)
    if manifold:
        triangles = _opened(points, triangles, notes)
        points, triangles = _used(points, triangles)
    rims: list[Candidate] = []
    loops = paths.loops(paths.open_edges(triangles)) if manifold else []
    if manifold and len(loops) <= MANY_HOLES:
        surface, rims = _closed(points, triangles, loops, notes)
        if not defects(surface.triangles):
            if surface.volume_ml() < 0:
                surface = Surface(surface.points, surface.triangles[:, ::-1].copy(), surface.label)
                notes.append("the surface was inside out and was turned")
            return Repaired(surface, tuple(_outward(r, surface) for r in rims), tuple(notes), scale, outer)
        points, triangles = surface.points, surface.triangles
    surface = from_voxels(points, triangles)
    notes.append("the triangles did not make a closed surface: it was rebuilt from voxels of 0.5 mm")
    return Repaired(surface, tuple(_outward(replace(r, cap=0), surface) for r in rims), tuple(notes), scale, outer)


def _opened(points: FloatArray, triangles: IntArray, notes: list[str]) -> IntArray:
    """Without the flat caps of a surface whose openings were closed by them: where, with rims, they are as many as an atrium has.

    Fewer flat discs may be something else: a valve's plane in a map of the heart, a wall cut by the border of an image.
    """
    loops = paths.loops(paths.open_edges(triangles))
    caps = flat_caps(points, triangles) if len(loops) < OPENINGS_LEAST else []
    if not caps or len(caps) + len(loops) < OPENINGS_LEAST:
        return triangles
    notes.append(f"{len(caps)} flat caps were taken for closed openings")
    return triangles[~np.any(caps, axis=0)]


def _bare(points: FloatArray, triangles: IntArray) -> Surface:
    return Surface(*_used(points, triangles), np.zeros(len(triangles), dtype=np.int64))


def _used(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray]:
    used, local = np.unique(triangles, return_inverse=True)
    return points[used], local.reshape(-1, 3)


def _cluster(points: FloatArray, triangles: IntArray, size_mm: float = 0.5) -> tuple[FloatArray, IntArray]:
    """Points of one cell of a grid become one."""
    key = np.floor((points - points.min(axis=0)) / size_mm).astype(np.int64)
    shape = key.max(axis=0) + 1
    _, inverse = np.unique((key[:, 0] * shape[1] + key[:, 1]) * shape[2] + key[:, 2], return_inverse=True)
    count = np.bincount(inverse)
    centre = np.column_stack([np.bincount(inverse, weights=points[:, d]) / count for d in range(3)])
    small = inverse[triangles]
    return centre, _without_doubles(small)


def _without_doubles(triangles: IntArray) -> IntArray:
    """Without triangles of a repeated point, and each set of three points once."""
    proper = (triangles[:, 0] != triangles[:, 1]) & (triangles[:, 1] != triangles[:, 2]) & (triangles[:, 2] != triangles[:, 0])
    triangles = triangles[proper]
    if len(triangles) == 0:
        return triangles
    ordered = np.sort(triangles, axis=1)
    size = int(triangles.max()) + 1
    _, first = np.unique((ordered[:, 0] * size + ordered[:, 1]) * size + ordered[:, 2], return_index=True)
    return triangles[np.sort(first)]


def _merge(points: FloatArray, triangles: IntArray, notes: list[str]) -> tuple[FloatArray, IntArray]:
    step = 1e-4
    key = np.round(points / step).astype(np.int64)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    merged = len(points) - len(first)
    if merged:
        notes.append(f"{merged} duplicate points were merged")
    before = len(triangles)
    triangles = _without_doubles(inverse.reshape(-1)[triangles])
    if len(triangles) < before:
        notes.append(f"{before - len(triangles)} degenerate or duplicate triangles were dropped")
    if len(triangles) == 0:
        raise AnatomyError("no proper triangle is left after duplicates are merged.")
    return points[first], triangles


def _mended(triangles: IntArray, notes: list[str]) -> IntArray:
    """Without the triangles at edges that have more than two, where such edges are few; the holes are filled later."""
    before = len(triangles)
    for _ in range(3):
        _, count, of = paths.edge_table(triangles)
        many = count > 2
        if not many.any() or many.sum() > FEW_BAD_EDGES:
            break
        triangles = triangles[~many[of].any(axis=1)]
    if len(triangles) < before:
        notes.append(f"{before - len(triangles)} triangles at non-manifold edges were taken out, the holes filled")
    return triangles


def _inner(points: FloatArray, triangles: IntArray, notes: list[str]) -> tuple[IntArray, IntArray | None]:
    """Of two shells of which one lies in the other (endocardium and epicardium) the inner, and the outer; else all, and None."""
    count, part = paths.triangle_components(triangles)
    if count == 1:
        return triangles, None
    area = np.bincount(part, weights=np.linalg.norm(np.cross(*_sides(points, triangles)), axis=1), minlength=count)
    first, second = (int(k) for k in np.argsort(-area)[:2])
    if area[second] < 0.25 * area[first]:
        return triangles, None
    shells = {k: _filled(points, triangles[part == k]) for k in (first, second)}
    if any(s is None for s in shells.values()):
        return triangles, None
    volume = {k: abs(s.volume_ml()) for k, s in shells.items() if s is not None}
    inner, outer = sorted((first, second), key=lambda k: volume[k])
    inside = _share_inside(shells[outer], points[np.unique(triangles[part == inner])])
    gap, _ = nearest(points[np.unique(triangles[part == outer])], points[np.unique(triangles[part == inner])])
    if inside < 0.9 or np.median(gap) > 10.0:
        return triangles, None
    notes.append(
        f"two shells, one in the other: the inner ({volume[inner]:.0f} mL) is the endocardium, the outer "
        f"({volume[outer]:.0f} mL) the epicardium, {np.median(gap):.1f} mm away (median)"
    )
    return triangles[part == inner], triangles[part == outer]


def _sides(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, FloatArray]:
    a, b, c = (points[triangles[:, i]] for i in range(3))
    return b - a, c - a


def _filled(points: FloatArray, triangles: IntArray) -> Surface | None:
    """The triangles with their rims closed by fans; None where they are no oriented manifold."""
    triangles, manifold = _orient(triangles, [])
    if not manifold:
        return None
    everything = [triangles]
    for rim in paths.loops(paths.open_edges(triangles)):
        points, cap = clipping.fill_rim(points, rim, triangles)
        everything.append(cap)
    cells = np.vstack(everything)
    return compact(Surface(points, cells, np.zeros(len(cells), dtype=np.int64)))


def _share_inside(closed: Surface | None, points: FloatArray) -> float:
    """Share of points (k, 3) inside a closed surface."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

    from lacli.anatomy.pictures import polydata

    assert closed is not None
    cloud = vtk.vtkPolyData()
    cells = vtk.vtkPoints()
    cells.SetData(numpy_to_vtk(np.ascontiguousarray(points), deep=True))
    cloud.SetPoints(cells)
    enclosed = vtk.vtkSelectEnclosedPoints()
    enclosed.SetInputData(cloud)
    enclosed.SetSurfaceData(polydata(closed))
    enclosed.Update()
    return float(vtk_to_numpy(enclosed.GetOutput().GetPointData().GetArray("SelectedPoints")).mean())


def _largest(points: FloatArray, triangles: IntArray, notes: list[str]) -> IntArray:
    count, part = paths.triangle_components(triangles)
    if count == 1:
        return triangles
    a, b, c = (points[triangles[:, i]] for i in range(3))
    area = np.bincount(part, weights=0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1), minlength=count)
    best = int(np.argmax(area))
    if area[best] < 0.5 * area.sum():
        # a soup: nothing is connected; all of it is kept for the voxels to judge
        return triangles
    order = np.argsort(-area)
    if area[order[1]] > 0.25 * area[best]:
        raise AnatomyError(
            f"the surface falls in {count} unconnected parts, the two largest of {area[best]:.0f} and {area[order[1]]:.0f} mm2; "
            "join them, or delete what is not the left atrium."
        )
    notes.append(f"{count - 1} smaller unconnected parts ({area.sum() - area[best]:.0f} mm2 of {area.sum():.0f}) were dropped")
    return triangles[part == best]


def _orient(triangles: IntArray, notes: list[str]) -> tuple[IntArray, bool]:
    """Neighbours turned the same way; False where an edge has more than two triangles or the turn contradicts itself."""
    _, count, of = paths.edge_table(triangles)
    if (count > 2).any():
        notes.append(f"{int((count > 2).sum())} non-manifold edges were found")
        return triangles, False
    from collections import deque

    # (t, 3): whether a triangle runs each of its sides in the edge's sorted direction
    forward = triangles[:, [0, 1, 2]] < triangles[:, [1, 2, 0]]
    left, right = paths.side_pairs(of)[0].T
    differs = forward.ravel()[left] == forward.ravel()[right]
    if not differs.any():
        return triangles, True
    neighbours: list[list[tuple[int, bool]]] = [[] for _ in range(len(triangles))]
    for a, b, d in zip((left // 3).tolist(), (right // 3).tolist(), differs.tolist(), strict=True):
        neighbours[a].append((b, d))
        neighbours[b].append((a, d))
    turn = np.full(len(triangles), -1, dtype=np.int8)
    for seed in range(len(triangles)):
        if turn[seed] >= 0:
            continue
        turn[seed] = 0
        queue = deque([seed])
        while queue:
            here = queue.popleft()
            for there, d in neighbours[here]:
                wanted = turn[here] ^ int(d)
                if turn[there] < 0:
                    turn[there] = wanted
                    queue.append(there)
                elif turn[there] != wanted:
                    notes.append("the surface has no two sides (a Moebius band)")
                    return triangles, False
    flips = min(int((turn == 1).sum()), int((turn == 0).sum()))
    notes.append(f"{flips} triangles were turned to match their neighbours")
    return np.where((turn == 1)[:, None], triangles[:, ::-1], triangles), True


def _closed(points: FloatArray, triangles: IntArray, loops: list[IntArray], notes: list[str]) -> tuple[Surface, list[Candidate]]:
    """Caps over all loops, those of openings with labels of their own; and the openings, widest first."""
    points, ragged = closing.even(points, triangles, [loop for loop in loops if len(loop) > 6])
    if ragged:
        notes.append(f"{len(ragged)} ragged rims were smoothed")
    # of the circle of the same area: a ragged rim is no longer than a smooth one
    length = [float(np.sqrt(4.0 * np.pi * np.linalg.norm(area_vector(points[loop])))) for loop in loops]
    order = sorted(range(len(loops)), key=lambda k: -length[k])
    wide = [k for k in order if length[k] >= OPENING_MM]
    small = len(loops) - len(wide)
    if small:
        notes.append(f"{small} holes were filled")
    if wide:
        notes.append(f"{len(wide)} rims of {OPENING_MM:g} mm or more were found")
    middle = points[np.unique(triangles)].mean(axis=0)
    rims = []
    for k, i in enumerate(wide):
        ring = points[loops[i]]
        rims.append(of_ring(ring, ring.mean(axis=0) - middle, RIM, cap=closing.CAP + k))
    points, triangles, label = closing.close(points, triangles, [loops[i] for i in order])
    label = np.where(label >= closing.CAP + len(wide), 0, label)
    return compact(Surface(points, triangles, label)), rims


def _outward(rim: Candidate, surface: Surface) -> Candidate:
    """The rim's direction as its cap's normal has it, or away from the surface's middle where it has no cap."""
    if rim.cap:
        sense = np.sign(surface.area_vectors()[surface.label == rim.cap].sum(axis=0) @ rim.direction) or 1.0
    else:
        sense = np.sign((rim.centre - surface.points.mean(axis=0)) @ rim.direction) or 1.0
    return replace(rim, direction=sense * rim.direction)
