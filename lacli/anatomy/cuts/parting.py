"""Parting a surface where a height is zero: points near it are put there, unless the rims then touch or cross."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.geometry import isolines as isoline
from lacli.geometry.surface import Surface

SHIFT_MM = 5e-4  # most that a plane is moved, so that no point lies in it


def part(surface: Surface, height: FloatArray, movable: BoolArray) -> tuple[Surface, BoolArray]:
    """The surface split where ``height`` (n,) is zero, ``movable`` (n,) points near it put there; and (t,) what is above."""
    surface, height = isoline.split(*isoline.snap(surface, height, movable))
    return surface, height[surface.triangles].sum(axis=1) > 0


def touching_points(triangles: IntArray) -> IntArray:
    """Ids of the points that rims of the triangles pass through more than once."""
    directed = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    size = int(triangles.max()) + 1
    alone = ~np.isin(directed[:, 0] * size + directed[:, 1], directed[:, 1] * size + directed[:, 0])
    start, count = np.unique(directed[alone, 0], return_counts=True)
    return np.asarray(start[count > 1])


def clear(height: FloatArray) -> FloatArray:
    """Heights (n,) mm over the plane moved by less than SHIFT_MM to where it is farthest from all points."""
    near = np.sort(height[np.abs(height) < SHIFT_MM])
    mark = np.concatenate([[-SHIFT_MM], near, [SHIFT_MM]])
    widest = int(np.argmax(np.diff(mark)))
    return np.asarray(height - (mark[widest] + mark[widest + 1]) / 2)
