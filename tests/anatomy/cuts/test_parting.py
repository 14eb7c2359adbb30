"""Parting at zero: which points rims share, and where a plane has no point in it."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import icosphere

from lacli.anatomy.cuts.parting import clear, part, touching_points
from lacli.geometry.surface import Surface, check

# a square of 2 mm in two triangles
TWO = Surface(np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]), np.array([[0, 1, 2], [0, 2, 3]]), np.array([4, 7]))


def test_points_that_rims_share() -> None:
    assert touching_points(np.array([[0, 1, 2], [0, 3, 4]])).tolist() == [0]  # two triangles that meet in a point
    assert touching_points(TWO.triangles).tolist() == []
    assert touching_points(icosphere(1.0, 1).triangles).tolist() == []


def test_a_plane_is_moved_into_the_widest_gap_between_points() -> None:
    # within half a thousandth of a mm the points leave gaps of 300, 200, 100 and 400 millionths: the last from 100 to 500
    height = 1e-6 * np.array([-200.0, 0.0, 100.0, 2000.0, -3000.0])
    assert clear(height) == pytest.approx(height - 300e-6, abs=1e-15)
    far = np.array([-1.0, 0.01, 3.0])
    assert (clear(far) == far).all()  # no point near: it stays


def test_a_point_that_may_not_move_is_not_put_on_zero() -> None:
    ball = icosphere(10.0, 2)
    height = ball.points[:, 2] - 3.0
    for movable in (np.ones(len(height), dtype=bool), np.zeros(len(height), dtype=bool)):
        parted, above = part(ball, height, movable)
        check(parted)
        at = (parted.points[parted.triangles, 2] - 3.0) * np.where(above, 1.0, -1.0)[:, None]
        assert at.min() > -1e-9  # each triangle on its own side
        kept = parted.points[: len(height)] == ball.points
        assert kept.all() == (not movable.any())
