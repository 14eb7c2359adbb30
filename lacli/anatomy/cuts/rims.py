"""Rims of the cuts: the strip of wall along each, as labels of the cavity surface."""

from __future__ import annotations

import numpy as np

from lacli.anatomy.remeshing.projection import border_edges
from lacli.base.arrays import FloatArray, IntArray
from lacli.contracts.labels import is_plane, is_ring, ring_beside
from lacli.geometry import isolines as isoline
from lacli.geometry.surface import WALL, Surface, nearest

RING_WIDTH_MM = 2.5


def rim_points(surface: Surface) -> dict[int, IntArray]:
    """Plane label -> ids of the points on its rim."""
    planes = np.where(is_plane(surface.label), surface.label, WALL)
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
    if not rims or np.any(is_ring(surface.label)):
        return surface
    near = {value: _distance(surface, ids) for value, ids in rims.items()}
    value = np.minimum.reduce(list(near.values())) - width_mm
    on_wall = np.ones(len(surface.points), dtype=bool)
    on_wall[surface.triangles[surface.label != WALL]] = False
    surface, value = isoline.snap(surface, value, on_wall)
    wall_edges = isoline.edges_inside(surface.triangles, surface.label == WALL)
    surface, everywhere = isoline.split(surface, value, wall_edges)
    points, triangles, label = surface.points, surface.triangles, surface.label
    inside = (label == WALL) & (everywhere[triangles].sum(axis=1) < 0)
    middle = points[triangles].mean(axis=1)
    names = np.array(list(rims))
    if inside.any():
        closest = np.argmin([nearest(points[ids], middle[inside])[0] for ids in rims.values()], axis=0)
        label = label.copy()
        label[inside] = ring_beside(names[closest])
    return Surface(points, triangles, label)


def _distance(surface: Surface, ids: IntArray) -> FloatArray:
    planes = np.where(is_plane(surface.label), surface.label, WALL)
    edges = border_edges(surface.triangles, planes)
    mine = edges[np.isin(edges, ids).all(axis=1)]
    a, b = surface.points[mine[:, 0]], surface.points[mine[:, 1]]
    samples = np.vstack([surface.points[ids]] + [a + s * (b - a) for s in (0.2, 0.4, 0.6, 0.8)])
    return nearest(samples, surface.points)[0]
