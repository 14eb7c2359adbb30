"""Triangles as arrays: their normals, their shape, cutting them."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray, IntArray


def area_normals(corner: FloatArray) -> FloatArray:
    """(k, 3): normal times twice the area, of triangles given by their corners (k, 3, 3)."""
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def shape_quality(corner: FloatArray) -> FloatArray:
    """Per triangle, twice its area over the squared longest edge times 2/sqrt(3): 1 equilateral, 0 flat."""
    longest = (np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2) ** 2).max(axis=1)
    return np.linalg.norm(area_normals(corner), axis=1) / np.maximum(longest, 1e-30) * (2.0 / np.sqrt(3.0))


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
