"""Prisms into tetrahedra, so that neighbours cut their common side alike."""

from __future__ import annotations

import numpy as np

from lacli.anatomy.surface import IntArray


def split_prisms(bottom: IntArray, top: IntArray) -> IntArray:
    """Prisms (p, 3) + (p, 3) -> tetrahedra (3p, 4), conformal: every side's diagonal starts at its smaller bottom id.

    ``bottom`` is oriented so that its normals point to ``top``; ``top`` must be numbered in the order of ``bottom``.
    """
    shift = np.argmin(bottom, axis=1)
    take = (shift[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(bottom, take, axis=1).T
    d, e, f = np.take_along_axis(top, take, axis=1).T
    # a is the smallest: diagonals a-e, a-f; on the side b-c the diagonal from the smaller of the two
    low_b = b < c
    first = np.column_stack([a, d, e, f])
    with_b = np.stack([np.column_stack([a, b, c, f]), np.column_stack([a, b, f, e])], axis=1)
    with_c = np.stack([np.column_stack([a, b, c, e]), np.column_stack([a, e, c, f])], axis=1)
    rest = np.where(low_b[:, None, None], with_b, with_c)
    return np.concatenate([first[:, None], rest], axis=1).reshape(-1, 4)
