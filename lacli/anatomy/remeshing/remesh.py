"""Isotropic remeshing of a labelled surface: split, collapse, flip, relax, project, until the edges have the asked length.

After Botsch and Kobbelt (2004). Every pass changes a set of edges whose neighbourhoods do not touch, so that it is
array arithmetic; borders between labels are curves of their own, whose points stay on them.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lacli.anatomy.remeshing import bends
from lacli.anatomy.remeshing.collapse import collapse
from lacli.anatomy.remeshing.projection import Reference, border_edges
from lacli.anatomy.remeshing.workmesh import BORDER, CORNER, Asked, WorkMesh, project, turned
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.contracts.labels import is_plane
from lacli.geometry.surface import Surface, check, compact
from lacli.geometry.triangles import area_normals, shape_quality, split_at

MIN_EDGES_PER_RIM = 10


def remesh(surface: Surface, size_mm: float, passes: int = 8) -> Surface:
    """Isotropic triangles of edge length ``size_mm`` (mm) on the same surface.

    Borders between labels stay where they are; the result is closed and manifold, and its volume is the surface's (points
    move out by the mean height of the surface over their flat triangles). Raises AnatomyError where ``surface`` is
    not closed or the size is not positive.
    """
    on_surface = remesh_on(Reference(surface), size_mm, passes)
    return keep_volume(on_surface, surface.volume_ml())


def remesh_on(reference: Reference, size_mm: float, passes: int = 8) -> Surface:
    """As ``remesh``, all points on the reference (so that flat triangles enclose slightly less where it is convex)."""
    if not np.isfinite(size_mm) or size_mm <= 0:
        raise AnatomyError(f"The cell size must be a positive length in mm, got {size_mm}.")
    surface = compact(reference.surface)
    check(surface)
    asked = _size_field(surface, size_mm)
    mesh = WorkMesh(surface.points.copy(), surface.triangles.copy(), surface.label.copy(), asked(surface.points))
    for step in range(passes + 30):
        before = len(mesh.triangles)
        _split(mesh, reference, asked)
        collapse(mesh, reference, asked)
        for _ in range(3):
            _flip(mesh, by_angle=step % 2 == 1)
        _relax(mesh, reference)
        mesh.size = asked(mesh.points)
        if step >= passes and abs(len(mesh.triangles) - before) <= 0.01 * before:
            break
    for _ in range(3):
        _relax(mesh, reference)
        _flip(mesh, by_angle=True)
    return compact(Surface(mesh.points, mesh.triangles, mesh.label))


def keep_volume(surface: Surface, volume_ml: float) -> Surface:
    """Points off the borders moved along their normals, all equally far, so that the enclosed volume is ``volume_ml``."""
    n = len(surface.points)
    moving = np.ones(n)
    moving[border_edges(surface.triangles, surface.label)] = 0.0
    flat = np.zeros(n, dtype=bool)
    flat[surface.triangles[is_plane(surface.label)]] = True
    moving[flat] = 0.0
    points = surface.points
    for _ in range(4):
        now = Surface(points, surface.triangles, surface.label)
        vector = np.zeros((n, 3))
        for k in range(3):
            np.add.at(vector, surface.triangles[:, k], now.area_vectors() / 3.0)
        size = np.linalg.norm(vector, axis=1)
        missing = 1000.0 * (volume_ml - now.volume_ml())
        swept = float((moving * size).sum())
        if swept <= 0:
            break
        points = points + (missing / swept) * moving[:, None] * vector / np.maximum(size, 1e-30)[:, None]
    return Surface(points, surface.triangles, surface.label)


def _size_field(surface: Surface, size: float) -> Asked:
    """Asked edge length at points: ``size``, less near rims too short for it, and where the wall bends too tightly for it."""
    rims, bent = _near_rims(surface, size), bends.limits(surface, size)
    if bent is None:
        return rims
    return lambda points: np.minimum(rims(points), bent(points))


def _near_rims(surface: Surface, size: float) -> Asked:
    """Asked edge length at points: ``size``, less near rims too short for it."""
    planes = border_edges(surface.triangles, np.where(is_plane(surface.label), surface.label, 0))
    if len(planes) == 0:
        return lambda points: np.full(len(points), size)
    n = len(surface.points)
    graph = coo_matrix((np.ones(len(planes)), (planes[:, 0], planes[:, 1])), shape=(n, n))
    _, piece = connected_components(graph, directed=False)
    length = np.linalg.norm(surface.points[planes[:, 0]] - surface.points[planes[:, 1]], axis=1)
    total = np.bincount(piece[planes[:, 0]], weights=length, minlength=piece.max() + 1)
    ids = np.unique(planes)
    local = np.minimum(size, total[piece[ids]] / MIN_EDGES_PER_RIM)
    if np.all(local >= size):
        return lambda points: np.full(len(points), size)
    tree = cKDTree(surface.points[ids])

    def asked(points: FloatArray) -> FloatArray:
        distance, near = (np.asarray(x) for x in tree.query(points))
        return np.asarray(np.minimum(size, local[near] + 0.4 * distance), dtype=np.float64)

    return asked


def _split(mesh: WorkMesh, reference: Reference, asked: Asked) -> None:
    """Halve edges longer than 4/3 of the asked length."""
    vector = area_normals(mesh.points[mesh.triangles])
    expected = (np.linalg.norm(vector, axis=1) / mesh.size[mesh.triangles].mean(axis=1) ** 2).sum() / 0.87
    limit = len(mesh.triangles) + 6 * expected + 2000
    for _ in range(12):
        mesh.refresh()
        long = mesh.length > 4.0 / 3.0 * mesh.wanted
        if not long.any():
            return
        # in triangles with a longer edge than the marked one the longest is halved first: better shapes
        longest = np.zeros(len(long), dtype=bool)
        sides = mesh.length[mesh.of_triangle]
        longest[mesh.of_triangle[np.arange(len(sides)), sides.argmax(axis=1)]] = True
        marked = long & longest
        n = len(mesh.points)
        new = np.full(len(mesh.edges), -1)
        new[marked] = n + np.arange(int(marked.sum()))
        halved = mesh.length[marked]
        middle = mesh.points[mesh.edges[marked]].mean(axis=1)
        mesh.points = np.vstack([mesh.points, middle])
        mesh.triangles, mesh.label = split_at(mesh.triangles, mesh.label, new[mesh.of_triangle])
        mesh.size = np.append(mesh.size, asked(middle))
        mesh.refresh()
        project(mesh, np.arange(n, len(mesh.points)), reference)
        # where the surface turns sharply between the ends its closest point may be an end: keep the middle then
        aside = np.linalg.norm(mesh.points[n:] - middle, axis=1) > 0.3 * halved
        mesh.points[n:][aside] = middle[aside]
        if len(mesh.triangles) > limit:
            raise AnatomyError(
                "Remeshing does not settle: the surface is too rough for this cell size. Smooth it, or ask for smaller cells."
            )


def _flip(mesh: WorkMesh, by_angle: bool) -> None:
    """Turn edges where that evens the number of neighbours, or enlarges the smallest angle."""
    mesh.refresh()
    a, b = mesh.edges.T
    first, second = mesh.wing.T
    c, d = mesh.opposite.T
    # (a, b) must run along the first triangle
    t = mesh.triangles[first]
    forward = ((t == a[:, None]) & (np.roll(t, -1, axis=1) == b[:, None])).any(axis=1)
    a, b = np.where(forward, a, b), np.where(forward, b, a)
    p = mesh.points
    old_1, old_2 = np.stack([p[a], p[b], p[c]], axis=1), np.stack([p[b], p[a], p[d]], axis=1)
    new_1, new_2 = np.stack([p[c], p[a], p[d]], axis=1), np.stack([p[d], p[b], p[c]], axis=1)
    mean = area_normals(old_1) + area_normals(old_2)
    ok = ~mesh.is_border & (mesh.valence[a] > 3) & (mesh.valence[b] > 3) & (c != d)
    flat = []
    for corner in (new_1, new_2):
        n = area_normals(corner)
        flat.append(np.einsum("ij,ij->i", n, mean) / np.maximum(np.linalg.norm(n, axis=1) * np.linalg.norm(mean, axis=1), 1e-30))
    ok &= np.minimum(*flat) > 0.6
    q_old = np.minimum(shape_quality(old_1), shape_quality(old_2))
    q_new = np.minimum(shape_quality(new_1), shape_quality(new_2))
    if by_angle:
        gain = q_new - q_old
        ok &= gain > 0.02
    else:
        v = mesh.valence
        now = sum((v[x] - 6) ** 2 for x in (a, b, c, d))
        then = (v[a] - 7) ** 2 + (v[b] - 7) ** 2 + (v[c] - 5) ** 2 + (v[d] - 5) ** 2
        gain = (now - then).astype(float)
        ok &= (gain > 0) & (q_new > 0.3)
    candidate = np.flatnonzero(ok)
    if len(candidate) == 0:
        return
    rank = np.empty(len(candidate))
    rank[np.argsort(-gain[candidate], kind="stable")] = np.arange(len(candidate))
    best = np.full(len(p), np.inf)
    four = np.stack([a, b, c, d], axis=1)[candidate]
    for k in range(4):
        np.minimum.at(best, four[:, k], rank)
    chosen = candidate[(best[four] >= rank[:, None]).all(axis=1)]
    # no second edge between c and d
    size = len(p)
    keys = np.minimum(c, d)[chosen] * size + np.maximum(c, d)[chosen]
    existing = mesh.edges[:, 0] * size + mesh.edges[:, 1]
    chosen = chosen[~np.isin(keys, existing)]
    mesh.triangles[first[chosen]] = np.column_stack([c, a, d])[chosen]
    mesh.triangles[second[chosen]] = np.column_stack([d, b, c])[chosen]


def _relax(mesh: WorkMesh, reference: Reference) -> None:
    """Move points to the mean of their neighbours within the surface (or border), and project."""
    mesh.refresh()
    n = len(mesh.points)
    centre = mesh.points[mesh.triangles].mean(axis=1)
    vector = area_normals(mesh.points[mesh.triangles])
    weight = np.linalg.norm(vector, axis=1) / np.maximum(mesh.size[mesh.triangles].mean(axis=1) ** 2, 1e-30)
    total = np.zeros((n, 3))
    normal = np.zeros((n, 3))
    mass = np.zeros(n)
    for k in range(3):
        np.add.at(total, mesh.triangles[:, k], weight[:, None] * centre)
        np.add.at(normal, mesh.triangles[:, k], vector)
        mass += np.bincount(mesh.triangles[:, k], weights=weight, minlength=n)
    goal = total / np.maximum(mass, 1e-30)[:, None]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    step = goal - mesh.points
    step -= np.einsum("ij,ij->i", step, normal)[:, None] * normal
    border = mesh.edges[mesh.is_border]
    along = np.zeros((n, 3))
    for k in range(2):
        np.add.at(along, border[:, k], mesh.points[border[:, 1 - k]] / 2.0)
    step = np.where((mesh.kind == BORDER)[:, None], along - mesh.points, step)
    step[mesh.kind == CORNER] = 0.0
    old = mesh.points.copy()
    before, long_before = shape_quality(old[mesh.triangles]), _longest(old, mesh.triangles)
    factor = np.full(n, 0.7)
    for _ in range(4):
        mesh.points = old + factor[:, None] * step
        project(mesh, np.flatnonzero((mesh.kind != CORNER) & (factor > 0)), reference)
        mesh.points[factor == 0] = old[factor == 0]
        moved, mesh.points = mesh.points, old
        bad = turned(mesh, moved, np.arange(len(mesh.triangles)))
        quality = shape_quality(moved[mesh.triangles])
        bad |= (quality < 0.1) & (quality < 0.9 * before)
        # a point that was put on another side of a fold: its edges are far longer than before
        after = _longest(moved, mesh.triangles)
        bad |= (after > 1.4 * mesh.size[mesh.triangles].mean(axis=1)) & (after > 1.02 * long_before)
        if not bad.any():
            mesh.points = moved
            return
        factor[np.unique(mesh.triangles[bad])] *= 0.0
    mesh.points = old


def _longest(points: FloatArray, triangles: IntArray) -> FloatArray:
    """Longest side (t,) mm of each triangle."""
    corner = points[triangles]
    return np.asarray(np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1))
