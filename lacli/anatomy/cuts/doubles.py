"""What a cap over an opening shares with the wall beside its rim: no edge may belong to both but those of the rim."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.geometry.surface import unique_edges
from lacli.geometry.triangles import split_at

RISE = 0.2  # of a chord's length: so far its middle stands off the wall's edge


def part_doubles(points: FloatArray, cap: IntArray, wall: IntArray, normal: FloatArray) -> tuple[FloatArray, IntArray, BoolArray]:
    """New points (k, 3) mm numbered after ``points``, the cap (c, 3) that closes the wall, and which (t,) of the wall stay.

    A triangle that the wall and the cap both have, turned the opposite way, encloses nothing: both go. Another edge across the
    opening that is the wall's too is cut in its middle, and that raised along the unit ``normal`` (3,), the cap's direction, so
    that there is room between the wall's edge and the cap.
    """
    beside = np.flatnonzero(np.isin(wall, cap).sum(axis=1) > 1)
    size = len(points)
    turned, own = _turned_keys(wall[beside][:, ::-1], size), _turned_keys(cap, size)
    stays = np.ones(len(wall), dtype=bool)
    stays[beside[np.isin(turned, own)]] = False
    if not stays.any():  # a wall that is nothing but its cap: left to whoever asks for a volume
        return np.empty((0, 3)), cap, np.ones(len(wall), dtype=bool)
    cap = cap[~np.isin(own, turned)]
    beside = beside[stays[beside]]
    if len(beside) == 0 or len(cap) == 0:
        return np.empty((0, 3)), cap, stays
    edges, of_triangle = unique_edges(cap)
    walls, _ = unique_edges(wall[beside])
    inside = np.bincount(of_triangle.ravel(), minlength=len(edges)) > 1
    doubled = inside & np.isin(edges[:, 0] * size + edges[:, 1], walls[:, 0] * size + walls[:, 1])
    if not doubled.any():
        return np.empty((0, 3)), cap, stays
    a, b = points[edges[doubled, 0]], points[edges[doubled, 1]]
    middle = (a + b) / 2 + RISE * np.linalg.norm(b - a, axis=1)[:, None] * normal
    new = np.full(len(edges), -1, dtype=np.int64)
    new[doubled] = size + np.arange(int(doubled.sum()))
    parted, _ = split_at(cap, np.zeros(len(cap), dtype=np.int64), new[of_triangle])
    return middle, parted, stays


def _turned_keys(triangles: IntArray, size: int) -> IntArray:
    """(t,) a number per triangle that tells its points and its turn, whichever point comes first."""
    first = np.argmin(triangles, axis=1)[:, None]
    a, b, c = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1).T
    return np.asarray((a * size + b) * size + c)
