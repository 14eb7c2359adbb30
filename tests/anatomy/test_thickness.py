"""Wall thickness of spherical shells, where it is the difference of the radii."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import icosphere

from lacli.anatomy.wall import thickness
from lacli.anatomy.wall.shell import mesh_shell


@pytest.mark.parametrize("order", [1, 2])
def test_a_uniform_shell(order: int) -> None:
    got = thickness.of_bundle(mesh_shell(icosphere(20.0, 4), 2.0, 3.0, order=order))
    assert got.eikonal == pytest.approx(2.0, rel=0.01)
    assert got.laplace == pytest.approx(2.0, rel=0.01)


def test_a_graded_shell() -> None:
    ball = icosphere(20.0, 5)
    wall = 2.0 + 0.5 * ball.points[:, 2] / 20.0
    bundle = mesh_shell(ball, wall, 2.5)
    got = thickness.of_bundle(bundle)
    exact = 2.0 + 0.5 * bundle.points[got.ids, 2] / 20.0
    assert got.eikonal == pytest.approx(exact, rel=0.01)
    assert got.laplace == pytest.approx(exact, rel=0.01)
    assert np.ptp(got.eikonal) > 0.9  # the grading is seen, not averaged away


def test_eikonal_takes_the_nearest_way() -> None:
    # two plates, 3 and 5 mm over the point
    points = np.array([[0.0, 0, 0], [-9, -9, 3], [9, -9, 3], [0, 9, 3], [-9, -9, -5], [9, -9, -5], [0, 9, -5]])
    assert thickness.eikonal(points, np.array([0]), np.array([[1, 2, 3], [4, 5, 6]])) == pytest.approx([3.0])
