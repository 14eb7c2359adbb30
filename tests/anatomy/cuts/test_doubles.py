"""What cap and wall share beside the rim: a triangle twice goes, an edge twice is parted, and the surface is closed."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.anatomy.cuts.doubles import part_doubles
from lacli.geometry.surface import Surface, check, defects

UP = np.array([0.0, 0, 1])
# a square opening 0 1 2 3 of 1 mm2, and two points 1 mm under it
POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.7, 0.3, -1], [0.3, 0.7, -1]])
CAP = np.array([[0, 1, 2], [0, 2, 3]])
EAR = np.array([[2, 1, 0], [2, 0, 5], [3, 2, 5], [0, 3, 5]])  # the triangle 0 1 2 is wall, and lies in the opening
RIDGE = np.array([[1, 0, 4], [2, 1, 4], [0, 2, 4], [2, 0, 5], [3, 2, 5], [0, 3, 5]])  # the wall rises to the line 0 2


def closed(wall: np.ndarray) -> tuple[Surface, np.ndarray, np.ndarray]:
    middle, cap, stays = part_doubles(POINTS, CAP, wall, UP)
    triangles = np.vstack([wall[stays], cap])
    done = Surface(np.vstack([POINTS, middle]), triangles, np.zeros(len(triangles), dtype=np.int64))
    check(done)
    return done, cap, stays


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_a_triangle_of_both_goes(turn: int) -> None:
    assert defects(np.vstack([EAR, CAP])) == "2 edges used twice in one direction (non-manifold or turned triangles)"
    done, cap, stays = closed(np.roll(EAR, turn, axis=1))
    assert stays.tolist() == [False, True, True, True] and cap.tolist() == [[0, 2, 3]]
    assert 1000 * done.volume_ml() == pytest.approx(1 / 6)  # half the square, 1 mm high


def test_an_edge_of_both_is_parted_and_raised() -> None:
    assert defects(np.vstack([RIDGE, CAP])) == "2 edges used twice in one direction (non-manifold or turned triangles)"
    done, cap, stays = closed(RIDGE)
    assert stays.all() and len(cap) == 4
    rise = 0.2 * np.sqrt(2.0)
    assert done.points[6] == pytest.approx([0.5, 0.5, rise])
    assert 1000 * done.volume_ml() == pytest.approx(2 / 6 + rise / 3)  # two tetrahedra below, a pyramid above


def test_what_is_not_shared_stays_as_it_is() -> None:
    funnel = np.array([[1, 0, 4], [2, 1, 4], [3, 2, 4], [0, 3, 4]])
    middle, cap, stays = part_doubles(POINTS, CAP, funnel, UP)
    assert middle.shape == (0, 3) and (cap == CAP).all() and stays.all()
