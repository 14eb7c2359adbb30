"""Rims of the cuts: the strip of wall along each, as labels of the cavity surface."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy.projection import border_edges
from lacli.anatomy.remesh import split_at
from lacli.anatomy.surface import WALL, FloatArray, IntArray, Surface, unique_edges

RING_WIDTH_MM = 2.5


def rim_points(surface: Surface) -> dict[int, IntArray]:
    """Plane label -> ids of the points on its rim."""
    planes = np.where(surface.label >= 21, surface.label, WALL)
    edges = border_edges(surface.triangles, planes)
    on_border = np.unique(edges)
    return {
        int(value): np.intersect1d(on_border, np.unique(surface.triangles[surface.label == value]))
        for value in np.unique(planes[planes > 0])
    }


def label_rings(surface: Surface, width_mm: float = RING_WIDTH_MM) -> Surface:
    """The same surface, wall triangles within ``width_mm`` of a rim labelled 11 - 16; cut along that distance.

    Distance is straight, from the rim's points and its edges' middles. A surface that has such labels, or no planes, is
    returned as it is.
    """
    rims = rim_points(surface)
    if not rims or np.any((surface.label >= 11) & (surface.label <= 16)):
        return surface
    near = {value: _distance(surface, ids) for value, ids in rims.items()}
    value = np.minimum.reduce(list(near.values())) - width_mm
    surface, value = _snapped(surface, value)
    wall = surface.label == WALL
    edges, of_triangle = unique_edges(surface.triangles)
    fa, fb = value[edges[:, 0]], value[edges[:, 1]]
    in_wall = np.ones(len(edges), dtype=bool)
    in_wall[of_triangle[~wall].ravel()] = False
    cut = (fa * fb < 0) & in_wall
    share = (fa / np.where(cut, fa - fb, 1.0))[cut, None]
    crossing = surface.points[edges[cut, 0]] * (1 - share) + surface.points[edges[cut, 1]] * share
    n = len(surface.points)
    new = np.full(len(edges), -1)
    new[cut] = n + np.arange(int(cut.sum()))
    triangles, label = split_at(surface.triangles, surface.label, new[of_triangle])
    points = np.vstack([surface.points, crossing])
    everywhere = np.concatenate([value, np.zeros(len(crossing))])
    inside = (label == WALL) & (everywhere[triangles].sum(axis=1) < 0)
    middle = points[triangles].mean(axis=1)
    names = np.array(list(rims))
    trees = [cKDTree(points[ids]) for ids in rims.values()]
    if inside.any():
        closest = np.argmin([tree.query(middle[inside])[0] for tree in trees], axis=0)
        label = label.copy()
        label[inside] = names[closest] - 10
    return Surface(points, triangles, label)


def _snapped(surface: Surface, value: FloatArray, share: float = 0.3) -> tuple[Surface, FloatArray]:
    """Wall points near the curve value = 0 moved along an edge onto it, so that it cuts off no slivers; and the values."""
    edges, of_triangle = unique_edges(surface.triangles)
    wall = np.zeros(len(surface.points), dtype=bool)
    wall[surface.triangles[surface.label == WALL]] = True
    wall[surface.triangles[surface.label != WALL]] = False
    both = np.vstack([edges, edges[:, ::-1]])
    fa, fb = value[both[:, 0]], value[both[:, 1]]
    step = np.where(fa * fb < 0, fa / np.where(fa == fb, 1.0, fa - fb), np.inf)
    step[~wall[both[:, 0]]] = np.inf
    order = np.argsort(-step, kind="stable")
    best = np.full(len(surface.points), np.inf)
    other = np.zeros(len(surface.points), dtype=np.int64)
    best[both[order, 0]], other[both[order, 0]] = step[order], both[order, 1]
    close = np.flatnonzero(best < share)
    points, value = surface.points.copy(), value.copy()
    points[close] += best[close, None] * (surface.points[other[close]] - surface.points[close])
    value[close] = 0.0
    return Surface(points, surface.triangles, surface.label), value


def _distance(surface: Surface, ids: IntArray) -> FloatArray:
    planes = np.where(surface.label >= 21, surface.label, WALL)
    edges = border_edges(surface.triangles, planes)
    mine = edges[np.isin(edges, ids).all(axis=1)]
    a, b = surface.points[mine[:, 0]], surface.points[mine[:, 1]]
    samples = np.vstack([surface.points[ids]] + [a + s * (b - a) for s in (0.2, 0.4, 0.6, 0.8)])
    distance: FloatArray = cKDTree(samples).query(surface.points)[0]
    return distance
