"""Where the wall's outer side is: the cavity surface's points moved outward, mitred at the rims, never through each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lacli.anatomy.coordinates.frame import unit
from lacli.anatomy.remeshing.projection import Reference, border_edges, side_of
from lacli.anatomy.wall.polish import layer_quality, polish
from lacli.base.arrays import FloatArray, IntArray
from lacli.geometry.prisms import shorter_diagonals, split_prisms
from lacli.geometry.surface import Surface, unique_edges

MAX_MITRE = 1.7
NORMAL_SMOOTHING_MM = 1.5
GOOD = 0.2
REACH = (0.3, 3.0)  # times the thickness: where an outer surface that is given is nearer or farther, it is another thing's


@dataclass(frozen=True)
class Offset:
    """vector (n, 3) mm: from each point of the surface to the outer side; middle (e, 3) mm: smooth middle of each edge on
    the surface, middle_vector (e, 3): from there outward; thinned (n,) bool: less than asked, to stay valid;
    starts (t, 3): the diagonals for split_prisms; unmet (n,) bool: the outer surface that was given is out of reach there, and
    the thickness holds."""

    vector: FloatArray
    middle: FloatArray
    middle_vector: FloatArray
    thinned: np.ndarray
    starts: np.ndarray
    unmet: np.ndarray


def offset_surface(
    surface: Surface,
    edges: IntArray,
    reference: Reference,
    thickness: Callable[[FloatArray], FloatArray],
    outer: Surface | None,
    curved: bool,
    layers: int = 1,
) -> Offset:
    """Offset of the remeshed ``surface`` (edges (e, 2) in unique_edges' order) by ``thickness(points)`` mm,
    to be cut in ``layers`` of cells.

    Directions are the reference's smoothed normals; a rim's points go along the bisector of wall and plane, longer by the
    mitre. A vector is shortened until its end is as far from the cavity as it should be (it is not where two
    sides of a fold or two vessels come close), then neighbours of poor cells are evened out.
    """
    sides = _sides_at_points(surface)
    asked = thickness(surface.points)
    nominal = _vectors(surface.points, sides, reference, asked)
    unmet = np.zeros(len(surface.points), dtype=bool)
    if outer is not None:
        nominal, unmet = _reach(surface.points, nominal, outer, sides)
    vector = _clear(surface.points, nominal, reference, asked)
    vector, starts = untangle(surface, edges, vector, layers)
    length, wanted = np.linalg.norm(vector, axis=1), np.linalg.norm(nominal, axis=1)
    ratio = length / wanted
    turned = np.einsum("ij,ij->i", vector, nominal) / (length * wanted) < 0.999
    chord = surface.points[edges].mean(axis=1)
    if not curved:
        return Offset(vector, chord, vector[edges].mean(axis=1), ratio < 0.95, starts, unmet)
    middle, edge_sides = _middles(surface, edges, chord, reference)
    free = _vectors(middle, edge_sides, reference, thickness(middle)) if outer is None else vector[edges].mean(axis=1)
    mean = vector[edges].mean(axis=1)
    # from a rim inward the mitre fades: the middle keeps the wall's thickness, and the chord's place along it
    fading = (sides[edges, 1] >= 0).sum(axis=1) == 1
    normal = unit(free)
    faded = mean + np.einsum("ij,ij->i", free - mean, normal)[:, None] * normal
    free = np.where(fading[:, None], faded, free)
    changed = (turned | (ratio < 0.98))[edges].any(axis=1) & ~fading
    mean *= (length[edges].mean(axis=1) / np.maximum(np.linalg.norm(mean, axis=1), 1e-12))[:, None]
    return Offset(vector, middle, np.where(changed[:, None], mean, free), ratio < 0.95, starts, unmet)


def _sides_at_points(surface: Surface) -> IntArray:
    """(n, 2): the side of each point, and a second one where it lies on a rim, else -1."""
    side = side_of(surface.label)
    low = np.full(len(surface.points), np.iinfo(np.int64).max)
    high = np.full(len(surface.points), -1)
    for k in range(3):
        np.minimum.at(low, surface.triangles[:, k], side)
        np.maximum.at(high, surface.triangles[:, k], side)
    return np.column_stack([low, np.where(high > low, high, -1)])


def _vectors(points: FloatArray, sides: IntArray, reference: Reference, thickness: FloatArray) -> FloatArray:
    """Outward vectors (k, 3) mm: thickness along the normal, or to the meeting of both sides' offsets on a rim."""
    first, second = np.zeros_like(points), np.zeros_like(points)
    for column, into in ((0, first), (1, second)):
        for value in np.unique(sides[:, column]):
            if value < 0:
                continue
            mine = sides[:, column] == value
            # planes are flat: their own triangles' normal; the wall's is smoothed over the scale of its noise
            into[mine] = reference.normals(points[mine], int(value), NORMAL_SMOOTHING_MM if value == 0 else 20.0)
    rim = sides[:, 1] >= 0
    direction = np.where(rim[:, None], unit(first + second), first)
    cosine = np.where(rim, np.einsum("ij,ij->i", direction, first), 1.0)
    return direction * (thickness * np.minimum(1.0 / np.maximum(cosine, 1e-3), MAX_MITRE))[:, None]


def _reach(points: FloatArray, vector: FloatArray, outer: Surface, sides: IntArray) -> tuple[FloatArray, np.ndarray]:
    """Vectors lengthened or shortened to meet the outer surface; unchanged on planes and where it is not met within REACH times
    their length, (n,) True there."""
    import pyvista as pv

    mesh = pv.PolyData.from_regular_faces(outer.points, outer.triangles)
    result, unmet = vector.copy(), np.zeros(len(points), dtype=bool)
    for i in np.flatnonzero((sides[:, 0] == 0) & (sides[:, 1] < 0)):
        hits, _ = mesh.ray_trace(points[i] + 0.05 * vector[i], points[i] + REACH[1] * vector[i], first_point=True)
        away = np.linalg.norm(hits.reshape(-1, 3)[0] - points[i]) if len(hits) else 0.0
        ratio = away / np.linalg.norm(vector[i])
        unmet[i] = ratio <= REACH[0]
        result[i] = vector[i] if unmet[i] else ratio * vector[i]
    return result, unmet


def _clear(points: FloatArray, vector: FloatArray, reference: Reference, thickness: FloatArray) -> FloatArray:
    """Vectors shortened until their ends keep 0.9 of their distance from the whole cavity surface."""
    scale = np.ones(len(points))
    target = np.minimum(thickness, np.linalg.norm(vector, axis=1))
    active = np.arange(len(points))
    for _ in range(8):
        end = points[active] + scale[active, None] * vector[active]
        active = active[reference.distance(end) < 0.88 * scale[active] * target[active]]
        if len(active) == 0:
            break
        scale[active] *= 0.85
    return scale[:, None] * vector


def untangle(surface: Surface, edges: IntArray, vector: FloatArray, layers: int) -> tuple[FloatArray, np.ndarray]:
    """Vectors evened out with their neighbours' where the cells between are poor, and shortened where that is not enough."""
    n = len(surface.points)
    bottom, top = surface.triangles, surface.triangles + n
    _, of_triangle = unique_edges(bottom)
    degree = np.maximum(np.bincount(edges.ravel(), minlength=n), 1)[:, None]
    height = np.linalg.norm(vector, axis=1) / layers
    starts = np.zeros(bottom.shape, dtype=bool)
    best, best_score = (vector, starts, np.zeros(3 * len(bottom))), -np.inf
    on_rim = np.zeros(n, dtype=bool)
    on_rim[border_edges(surface.triangles, side_of(surface.label))] = True
    for step in range(40):
        starts = shorter_diagonals(surface.points, vector, bottom, edges, of_triangle)
        tets = split_prisms(bottom, top, starts)
        quality = layer_quality(surface.points, vector, tets, layers)
        # a flat wall on long cells is poor by its proportions alone: ask for less there
        span = np.sqrt(np.repeat(surface.areas(), 3) * 2.3)
        fair = np.minimum(GOOD, 0.55 * np.repeat(height[bottom].mean(axis=1), 3) / span)
        poor = quality < fair
        score = float(quality.min())
        if score > best_score:
            best, best_score = (vector, starts, fair), score
        if not poor.any():
            return vector, starts
        bad, steep, tangled = np.zeros(n), np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        bad[np.unique(tets[poor] % n)] = 1.0
        # a wall that is flat for its cells is no better thinner: only what is inverted gives way there
        crowded = (fair >= GOOD) | (quality <= 0)
        steep[np.unique(tets[poor & crowded] % n)] = True
        tangled[np.unique(tets[(quality < 0.25 * fair) & crowded] % n)] = True
        total = np.zeros_like(vector)
        np.add.at(total, edges[:, 0], vector[edges[:, 1]])
        np.add.at(total, edges[:, 1], vector[edges[:, 0]])
        mean = total / degree
        keep = np.where(on_rim, 0.2, 0.5)[:, None] * bad[:, None]
        mixed = (1 - keep) * vector + keep * mean
        size = np.linalg.norm(mixed, axis=1)
        length = np.linalg.norm(vector, axis=1)
        around = np.zeros(n)
        np.add.at(around, edges[:, 0], length[edges[:, 1]])
        np.add.at(around, edges[:, 1], length[edges[:, 0]])
        # the mean vector is shorter than its parts where they spread: room for cells that are crowded, no more
        goal = (1 - keep[:, 0]) * length + keep[:, 0] * np.where(steep, np.linalg.norm(total, axis=1), around) / degree[:, 0]
        goal = np.where(steep, goal * (0.97 if step > 8 else 1.0), goal)
        if step > 4:  # what is still poor turns towards the triangle it sees worst, and gives way if inverted
            mixed += 0.15 * (bad * goal)[:, None] * _worst_seen(surface, mixed)
            size = np.linalg.norm(mixed, axis=1)
            goal[tangled] *= 0.93
        vector = mixed * (goal / np.maximum(size, 1e-12))[:, None]
    vector, starts, fair = best
    return polish(surface.points, vector, bottom, starts, fair * 1.02, layers), starts


def _worst_seen(surface: Surface, vector: FloatArray) -> FloatArray:
    """At each point the normal (n, 3) of that of its triangles which its vector is the least along."""
    normals = surface.normals()
    corner = surface.triangles.ravel()
    cosine = np.einsum("ij,ij->i", unit(vector)[corner], np.repeat(normals, 3, axis=0))
    order = np.argsort(-cosine, kind="stable")  # the smallest is written last
    worst = np.zeros_like(vector)
    worst[corner[order]] = np.repeat(normals, 3, axis=0)[order]
    return worst


def _middles(surface: Surface, edges: IntArray, chord: FloatArray, reference: Reference) -> tuple[FloatArray, IntArray]:
    """Smooth middles of the edges: on their patch of the reference, or on the border they run along; and their sides."""
    size = len(surface.points)
    label = np.zeros((len(edges), 2), dtype=np.int64)
    pairs = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    at = np.searchsorted(edges[:, 0] * size + edges[:, 1], pairs[..., 0] * size + pairs[..., 1])
    low, high = np.full(len(edges), np.iinfo(np.int64).max), np.full(len(edges), -1)
    for k in range(3):
        np.minimum.at(low, at[:, k], surface.label)
        np.maximum.at(high, at[:, k], surface.label)
    label = np.column_stack([low, high])
    middle = chord.copy()
    for a, b in np.unique(label, axis=0):
        mine = (label[:, 0] == a) & (label[:, 1] == b)
        if a == b:
            middle[mine] = reference.closest(chord[mine], int(a))
        else:
            middle[mine] = reference.closest_on_border(chord[mine], (int(a), int(b)))
    length = np.linalg.norm(surface.points[edges[:, 0]] - surface.points[edges[:, 1]], axis=1)
    far = np.linalg.norm(middle - chord, axis=1) > 0.25 * length
    middle[far] = chord[far]
    side = np.sort(side_of(label), axis=1)
    return middle, np.column_stack([side[:, 0], np.where(side[:, 1] > side[:, 0], side[:, 1], -1)])
