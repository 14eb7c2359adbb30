"""Isotropic remeshing of a labelled surface: split, collapse, flip, relax, project, until the edges have the asked length.

After Botsch and Kobbelt (2004). Every pass changes a set of edges whose neighbourhoods do not touch, so that it is
array arithmetic; borders between labels are curves of their own, whose points stay on them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lacli.anatomy.projection import Reference, border_edges
from lacli.anatomy.surface import FloatArray, IntArray, Surface, check, compact, unique_edges
from lacli.errors import AnatomyError

INNER, BORDER, CORNER = 0, 1, 2
MIN_EDGES_PER_RIM = 10
Asked = Callable[[FloatArray], FloatArray]  # points (k, 3) mm -> wanted edge length (k,) mm


@dataclass
class _Mesh:
    """Work state: points, triangles, labels, and what follows from them."""

    points: FloatArray
    triangles: IntArray
    label: IntArray
    size: FloatArray  # asked edge length per point
    refusals: FloatArray = field(default_factory=lambda: np.zeros(0))  # collapses refused so far, per point

    def refresh(self) -> None:
        """Edges, their triangles, and whether points are inside a patch, on a border, or fixed."""
        self.edges, self.of_triangle = unique_edges(self.triangles)
        e = len(self.edges)
        order = np.argsort(self.of_triangle.ravel(), kind="stable")
        self.wing = (order // 3).reshape(e, 2)  # the two triangles of each edge
        self.opposite = self.triangles[order // 3, (order % 3 + 2) % 3].reshape(e, 2)
        self.is_border = self.label[self.wing[:, 0]] != self.label[self.wing[:, 1]]
        n = len(self.points)
        count = np.bincount(self.edges[self.is_border].ravel(), minlength=n)
        self.kind = np.where(count == 0, INNER, np.where(count == 2, BORDER, CORNER))
        self.valence = np.bincount(self.edges.ravel(), minlength=n)
        self.length = np.linalg.norm(self.points[self.edges[:, 0]] - self.points[self.edges[:, 1]], axis=1)
        self.wanted = self.size[self.edges].mean(axis=1)


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
    mesh = _Mesh(surface.points.copy(), surface.triangles.copy(), surface.label.copy(), asked(surface.points))
    for step in range(passes + 30):
        before = len(mesh.triangles)
        _split(mesh, reference, asked)
        _collapse(mesh, reference, asked)
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
    flat[surface.triangles[surface.label >= 21]] = True
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
    """Asked edge length at points: ``size``, less near rims too short for it."""
    planes = border_edges(surface.triangles, np.where(surface.label >= 21, surface.label, 0))
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


def _project(mesh: _Mesh, ids: IntArray, reference: Reference) -> None:
    """Put points back: those inside a patch on it, those of a border on the border; corners stay."""
    kind = mesh.kind[ids]
    label = np.zeros(len(mesh.points), dtype=np.int64)
    label[mesh.triangles.ravel()] = np.repeat(mesh.label, 3)
    inner = ids[kind == INNER]
    for value in np.unique(label[inner]):
        which = inner[label[inner] == value]
        mesh.points[which] = reference.closest(mesh.points[which], int(value))
    on_border = np.zeros(len(mesh.points), dtype=bool)
    on_border[ids[kind == BORDER]] = True
    if on_border.any():
        edges = mesh.edges[mesh.is_border]
        pair = np.sort(mesh.label[mesh.wing[mesh.is_border]], axis=1)
        pairs = np.full((len(mesh.points), 2), -1)
        for k in range(2):
            pairs[edges[:, k]] = pair
        chosen = np.flatnonzero(on_border)
        for low, high in np.unique(pairs[chosen], axis=0):
            which = chosen[(pairs[chosen, 0] == low) & (pairs[chosen, 1] == high)]
            mesh.points[which] = reference.closest_on_border(mesh.points[which], (int(low), int(high)))


def _split(mesh: _Mesh, reference: Reference, asked: Asked) -> None:
    """Halve edges longer than 4/3 of the asked length."""
    vector = _normal(mesh.points[mesh.triangles])
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
        _project(mesh, np.arange(n, len(mesh.points)), reference)
        # where the surface turns sharply between the ends its closest point may be an end: keep the middle then
        aside = np.linalg.norm(mesh.points[n:] - middle, axis=1) > 0.3 * halved
        mesh.points[n:][aside] = middle[aside]
        if len(mesh.triangles) > limit:
            raise AnatomyError(
                "Remeshing does not settle: the surface is too rough for this cell size. Smooth it, or ask for smaller cells."
            )


def split_at(triangles: IntArray, label: IntArray, middle: IntArray) -> tuple[IntArray, IntArray]:
    """Triangles cut where ``middle`` (t, 3) gives a new point on side 01, 12, 20 (-1: none)."""
    count = (middle >= 0).sum(axis=1)
    out, labels = [triangles[count == 0]], [label[count == 0]]
    for wanted in (1, 2, 3):
        pick = count == wanted
        t, m, v = triangles[pick], middle[pick], label[pick]
        if wanted == 1:
            turn = np.argmax(m >= 0, axis=1)  # the cut side becomes 01
        elif wanted == 2:
            turn = (np.argmin(m >= 0, axis=1) + 1) % 3  # the whole side becomes 20
        else:
            turn = np.zeros(len(t), dtype=np.int64)
        index = (turn[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(t, index, axis=1).T
        p, q, r = np.take_along_axis(m, index, axis=1).T
        if wanted == 1:
            pieces = [(a, p, c), (p, b, c)]
        elif wanted == 2:
            pieces = [(p, b, q), (a, p, q), (a, q, c)]
        else:
            pieces = [(a, p, r), (p, b, q), (r, q, c), (p, q, r)]
        for piece in pieces:
            out.append(np.column_stack(piece))
            labels.append(v)
    return np.vstack(out), np.concatenate(labels)


def _collapse(mesh: _Mesh, reference: Reference, asked: Asked) -> None:
    """Remove edges shorter than 4/5 of the asked length, an independent set at a time."""
    rng = np.random.default_rng(7)
    mesh.refusals = np.zeros(len(mesh.points))
    idle = 0
    for _ in range(120):
        mesh.refresh()
        short = mesh.length < 0.8 * mesh.wanted
        a, b = mesh.edges.T
        ka, kb = mesh.kind[a], mesh.kind[b]
        # a border shrinks along itself only; two borders are never pulled together
        allowed = mesh.is_border | (ka == INNER) | (kb == INNER)
        allowed &= ~((ka == CORNER) & (kb == CORNER))
        allowed &= (mesh.valence[mesh.opposite] > 3).all(axis=1)
        candidate = np.flatnonzero(short & allowed)
        if len(candidate) == 0:
            return
        candidate = candidate[_common_neighbours(mesh, candidate) == 2]
        # an edge that was refused must not stand in its neighbours' way again
        patience = mesh.refusals[mesh.edges[candidate]].min(axis=1) * mesh.size.max()
        chosen = _independent(mesh, candidate, patience + mesh.length[candidate] * (1 + 0.3 * rng.random(len(candidate))))
        if len(chosen) == 0:
            return
        done = _apply_collapse(mesh, chosen, reference, asked)
        idle = idle + 1 if done < max(1, 0.002 * len(mesh.edges)) else 0
        if idle > 3:
            return


def _common_neighbours(mesh: _Mesh, candidate: IntArray) -> IntArray:
    n = len(mesh.points)
    graph = coo_matrix((np.ones(len(mesh.edges)), (mesh.edges[:, 0], mesh.edges[:, 1])), shape=(n, n)).tocsr()
    graph = graph + graph.T
    a, b = mesh.edges[candidate].T
    return np.asarray(graph[a].multiply(graph[b]).sum(axis=1)).ravel().astype(np.int64)


def _independent(mesh: _Mesh, candidate: IntArray, priority: FloatArray) -> IntArray:
    """Those candidates that are the most urgent among all that touch their points' neighbourhoods."""
    n = len(mesh.points)
    rank = np.empty(len(candidate))
    rank[np.argsort(priority)] = np.arange(len(candidate))
    nearest = np.full(n, np.inf)
    for k in range(2):
        np.minimum.at(nearest, mesh.edges[candidate, k], rank)
    around = nearest.copy()
    np.minimum.at(around, mesh.edges[:, 0], nearest[mesh.edges[:, 1]])
    np.minimum.at(around, mesh.edges[:, 1], nearest[mesh.edges[:, 0]])
    a, b = mesh.edges[candidate].T
    return candidate[(around[a] >= rank) & (around[b] >= rank)]


def _apply_collapse(mesh: _Mesh, chosen: IntArray, reference: Reference, asked: Asked) -> int:
    a, b = mesh.edges[chosen].T
    # the point that stays: the one on a border or corner, else either, moved to the middle
    stay = np.where(mesh.kind[b] > mesh.kind[a], b, a)
    gone = np.where(stay == a, b, a)
    same = mesh.kind[a] == mesh.kind[b]
    # the middle first; where that was refused before, one end
    tired = same & (mesh.refusals[mesh.edges[chosen]].max(axis=1) > 0)
    swap = tired & (mesh.refusals[mesh.edges[chosen]].sum(axis=1) % 2 == 1)
    stay, gone = np.where(swap, gone, stay), np.where(swap, stay, gone)
    same &= ~tired
    target = np.where(same[:, None], (mesh.points[a] + mesh.points[b]) / 2, mesh.points[stay])
    moved = _Mesh(mesh.points.copy(), mesh.triangles, mesh.label, mesh.size)
    moved.edges, moved.kind, moved.is_border, moved.wing = mesh.edges, mesh.kind, mesh.is_border, mesh.wing
    moved.points[stay] = target
    _project(moved, stay[same], reference)
    target = moved.points[stay]
    position = mesh.points.copy()
    position[stay] = position[gone] = target
    owner = np.full(len(mesh.points), -1)
    owner[a] = owner[b] = np.arange(len(chosen))
    touched = owner[mesh.triangles]
    edge_of = touched.max(axis=1)
    both = (touched >= 0).sum(axis=1) == 2
    ring = np.flatnonzero((edge_of >= 0) & ~both)
    bad = _turned(mesh, position, ring)
    # worse than the worst that is there, and poor: refused
    star = np.flatnonzero(edge_of >= 0)
    poorest_before, poorest_after = np.full(len(chosen), np.inf), np.full(len(chosen), np.inf)
    np.minimum.at(poorest_before, edge_of[star], _quality(mesh.points[mesh.triangles[star]]))
    np.minimum.at(poorest_after, edge_of[ring], _quality(position[mesh.triangles[ring]]))
    worse = (poorest_after < 0.1) & (poorest_after < poorest_before)
    new = position[mesh.triangles[ring]]
    longest = np.linalg.norm(new - np.roll(new, 1, axis=1), axis=2).max(axis=1)
    before = np.linalg.norm(mesh.points[mesh.triangles[ring]] - np.roll(mesh.points[mesh.triangles[ring]], 1, axis=1), axis=2)
    bad |= longest > np.maximum(1.4 * mesh.size[mesh.triangles[ring]].mean(axis=1), before.max(axis=1) * 1.02)
    refused = worse
    refused[edge_of[ring][bad]] = True
    # two collapses may share an opposite point, and each takes one neighbour from it
    opposite = mesh.opposite[chosen]
    left = mesh.valence - np.bincount(opposite[~refused].ravel(), minlength=len(mesh.points))
    refused |= (left[opposite] < 3).any(axis=1)
    ok = ~refused
    np.add.at(mesh.refusals, mesh.edges[chosen[refused]].ravel(), 1.0)
    if not ok.any():
        return 0
    mesh.points[stay[ok]] = target[ok]
    mesh.refusals[stay[ok]] = 0.0
    mesh.size[stay[ok]] = asked(target[ok])
    to = np.arange(len(mesh.points))
    to[gone[ok]] = stay[ok]
    triangles = to[mesh.triangles]
    alive = (triangles[:, 0] != triangles[:, 1]) & (triangles[:, 1] != triangles[:, 2]) & (triangles[:, 2] != triangles[:, 0])
    used, local = np.unique(triangles[alive], return_inverse=True)
    mesh.points, mesh.size, mesh.refusals = mesh.points[used], mesh.size[used], mesh.refusals[used]
    mesh.triangles, mesh.label = local.reshape(-1, 3), mesh.label[alive]
    return int(ok.sum())


def _normal(corner: FloatArray) -> FloatArray:
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _quality(corner: FloatArray) -> FloatArray:
    """Twice the area over the squared longest edge times 2/sqrt(3): 1 equilateral, 0 flat."""
    longest = (np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2) ** 2).max(axis=1)
    return np.linalg.norm(_normal(corner), axis=1) / np.maximum(longest, 1e-30) * (2.0 / np.sqrt(3.0))


def _turned(mesh: _Mesh, position: FloatArray, which: IntArray) -> np.ndarray:
    """Triangles (of ids ``which``) that would face away from the surface around them if the points moved to ``position``.

    The surface's direction is the mean of the area-weighted normals at the triangle's points, wall and planes apart: thin
    triangles, whose own normals mean nothing, have no say in it.
    """
    vector = _normal(mesh.points[mesh.triangles])
    plane = mesh.label >= 21
    n = len(mesh.points)
    around = np.zeros((2 * n, 3))
    slot = mesh.triangles + n * plane[:, None]
    for d in range(3):
        around[:, d] = np.bincount(slot.ravel(), weights=np.repeat(vector[:, d], 3), minlength=2 * n)
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-30)
    expected = around[slot[which]].sum(axis=1)
    expected /= np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), 1e-30)
    new = _normal(position[mesh.triangles[which]])
    cosine = np.einsum("ij,ij->i", new, expected) / np.maximum(np.linalg.norm(new, axis=1), 1e-30)
    old = vector[which]
    before = np.einsum("ij,ij->i", old, expected) / np.maximum(np.linalg.norm(old, axis=1), 1e-30)
    return (cosine < 0.4) & (cosine < before)


def _flip(mesh: _Mesh, by_angle: bool) -> None:
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
    mean = _normal(old_1) + _normal(old_2)
    ok = ~mesh.is_border & (mesh.valence[a] > 3) & (mesh.valence[b] > 3) & (c != d)
    flat = []
    for corner in (new_1, new_2):
        n = _normal(corner)
        flat.append(np.einsum("ij,ij->i", n, mean) / np.maximum(np.linalg.norm(n, axis=1) * np.linalg.norm(mean, axis=1), 1e-30))
    ok &= np.minimum(*flat) > 0.6
    q_old = np.minimum(_quality(old_1), _quality(old_2))
    q_new = np.minimum(_quality(new_1), _quality(new_2))
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


def _relax(mesh: _Mesh, reference: Reference) -> None:
    """Move points to the mean of their neighbours within the surface (or border), and project."""
    mesh.refresh()
    n = len(mesh.points)
    centre = mesh.points[mesh.triangles].mean(axis=1)
    vector = _normal(mesh.points[mesh.triangles])
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
    before = _quality(old[mesh.triangles])
    factor = np.full(n, 0.7)
    for _ in range(4):
        mesh.points = old + factor[:, None] * step
        _project(mesh, np.flatnonzero((mesh.kind != CORNER) & (factor > 0)), reference)
        mesh.points[factor == 0] = old[factor == 0]
        moved, mesh.points = mesh.points, old
        bad = _turned(mesh, moved, np.arange(len(mesh.triangles)))
        quality = _quality(moved[mesh.triangles])
        bad |= (quality < 0.1) & (quality < 0.9 * before)
        if not bad.any():
            mesh.points = moved
            return
        factor[np.unique(mesh.triangles[bad])] *= 0.0
    mesh.points = old
