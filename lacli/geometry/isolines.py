"""Cutting triangles along the zero of a field given at their points, without slivers."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.geometry.surface import Surface, unique_edges
from lacli.geometry.triangles import split_at


def snap(surface: Surface, value: FloatArray, movable: np.ndarray, share: float = 0.3) -> tuple[Surface, FloatArray]:
    """Movable points (n,) whose edge crosses zero within ``share`` of its length are moved there, along the edge.

    Returns the surface and the values, exactly 0 at the moved points.
    """
    edges, _ = unique_edges(surface.triangles)
    both = np.vstack([edges, edges[:, ::-1]])
    fa, fb = value[both[:, 0]], value[both[:, 1]]
    step = np.where(fa * fb < 0, fa / np.where(fa == fb, 1.0, fa - fb), np.inf)
    step[~movable[both[:, 0]]] = np.inf
    order = np.argsort(-step, kind="stable")  # the nearest crossing is written last
    best = np.full(len(surface.points), np.inf)
    other = np.zeros(len(surface.points), dtype=np.int64)
    best[both[order, 0]], other[both[order, 0]] = step[order], both[order, 1]
    close = np.flatnonzero(best < share)
    points, value = surface.points.copy(), value.copy()
    points[close] += best[close, None] * (surface.points[other[close]] - surface.points[close])
    value[close] = 0.0
    return Surface(points, surface.triangles, surface.label), value


def split(surface: Surface, value: FloatArray, allowed: np.ndarray | None = None) -> tuple[Surface, FloatArray]:
    """Triangles cut where the values change sign along an ``allowed`` (e,) edge; surface and values, 0 at new points."""
    edges, of_triangle = unique_edges(surface.triangles)
    fa, fb = value[edges[:, 0]], value[edges[:, 1]]
    crossed = fa * fb < 0
    if allowed is not None:
        crossed &= allowed
    share = (fa / np.where(crossed, fa - fb, 1.0))[crossed, None]
    crossing = surface.points[edges[crossed, 0]] * (1 - share) + surface.points[edges[crossed, 1]] * share
    new = np.full(len(edges), -1)
    new[crossed] = len(surface.points) + np.arange(int(crossed.sum()))
    triangles, label = split_at(surface.triangles, surface.label, new[of_triangle])
    result = Surface(np.vstack([surface.points, crossing]), triangles, label)
    return result, np.concatenate([value, np.zeros(len(crossing))])


def edges_inside(triangles: IntArray, member: np.ndarray) -> np.ndarray:
    """(e,) whether all triangles of an edge are members (t,)."""
    edges, of_triangle = unique_edges(triangles)
    inside = np.ones(len(edges), dtype=bool)
    inside[of_triangle[~member].ravel()] = False
    return inside
