"""Prisms into tetrahedra, so that neighbours cut their common side alike."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray, IntArray


def split_prisms(bottom: IntArray, top: IntArray, starts: np.ndarray | None = None) -> IntArray:
    """Prisms (p, 3) + (p, 3) -> tetrahedra (3p, 4).

    ``bottom`` is oriented so that its normals point to ``top``. ``starts`` (p, 3): whether the diagonal of the side over
    corners 01, 12, 20 starts at that side's first corner on the bottom (never three alike; see shorter_diagonals); None:
    it starts at the smaller bottom id, which is conformal and never cyclic.
    """
    if starts is None:
        starts = bottom < np.roll(bottom, -1, axis=1)
    # a: the corner where both of its diagonals start
    both = starts & ~np.roll(starts, 1, axis=1)
    take = (np.argmax(both, axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(bottom, take, axis=1).T
    d, e, f = np.take_along_axis(top, take, axis=1).T
    from_b = np.take_along_axis(starts, take, axis=1)[:, 1]
    first = np.column_stack([a, d, e, f])
    with_b = np.stack([np.column_stack([a, b, c, f]), np.column_stack([a, b, f, e])], axis=1)
    with_c = np.stack([np.column_stack([a, b, c, e]), np.column_stack([a, e, c, f])], axis=1)
    rest = np.where(from_b[:, None, None], with_b, with_c)
    return np.concatenate([first[:, None], rest], axis=1).reshape(-1, 4)


def shorter_diagonals(
    points: FloatArray, vector: FloatArray, triangles: IntArray, edges: IntArray, of_triangle: IntArray
) -> np.ndarray:
    """(t, 3) ``starts`` for split_prisms: on each side of a prism the shorter diagonal, cycles undone at the least cost.

    points (n, 3) and vector (n, 3) mm: bottoms and the way to the tops; edges (e, 2) and of_triangle (t, 3) as from
    unique_edges.
    """
    low, high = edges.T
    tops = points + vector
    gain = np.linalg.norm(points[high] - tops[low], axis=1) - np.linalg.norm(points[low] - tops[high], axis=1)
    from_low = np.where(gain == 0, True, gain > 0)
    along = triangles < np.roll(triangles, -1, axis=1)
    cost = np.abs(gain)
    for step in range(200):
        starts = from_low[of_triangle] == along
        cyclic = np.flatnonzero(starts.all(axis=1) | ~starts.any(axis=1))
        if len(cyclic) == 0:
            return starts
        # undo the cheapest side of each; one that was turned before gets dearer, so that this ends
        side = of_triangle[cyclic, np.argmin(cost[of_triangle[cyclic]], axis=1)]
        side = np.unique(side)
        from_low[side] = ~from_low[side]
        cost[side] += 1.0 + step
    return along
