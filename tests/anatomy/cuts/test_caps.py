"""Plates and caps over openings: exact on flat rims, refused where a rim cannot be filled."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import icosphere

from lacli.anatomy.cuts.caps import crosses_itself, crossing_points, extrude_plate, harmonic_heights, rim_loops, triangulate_loop
from lacli.base.errors import AnatomyError
from lacli.geometry.tetrahedra import volumes
from lacli.geometry.triangles import area_normals

SQUARE = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
UP = np.array([0.0, 0, 1])


def flat(ring: np.ndarray) -> np.ndarray:
    return np.column_stack([ring, np.full(len(ring), 5.0)])


def test_a_rim_is_one_loop_along_its_triangles() -> None:
    # a square of two triangles: the rim goes round 0 1 2 3
    (loop,) = rim_loops(np.array([[0, 1, 2], [0, 2, 3]]))
    start = int(np.flatnonzero(loop == 0)[0])
    assert np.roll(loop, -start).tolist() == [0, 1, 2, 3]
    assert rim_loops(icosphere(1.0, 1).triangles) == []


def test_a_rim_that_touches_itself_is_refused() -> None:
    with pytest.raises(AnatomyError, match="touches itself"):
        rim_loops(np.array([[0, 1, 2], [0, 3, 4]]))  # two triangles that meet in one point


@pytest.mark.parametrize("turn", [1, -1])
def test_a_loop_is_filled_with_its_own_area_facing_the_normal(turn: int) -> None:
    points = flat(SQUARE)
    inner, triangles = triangulate_loop(points, np.arange(4)[::turn], UP)
    vector = area_normals(np.vstack([points, inner])[triangles])  # twice the area, along the normal
    assert vector[:, 2].min() > 0 and np.abs(vector[:, :2]).max() < 1e-12
    assert vector[:, 2].sum() / 2 == pytest.approx(16.0)
    assert np.abs(inner[:, 2] - 5.0).max(initial=0.0) < 1e-12


def test_curves_that_cross_touch_or_stand_still() -> None:
    assert not crosses_itself(SQUARE)
    assert crosses_itself(SQUARE[[0, 2, 1, 3]])  # a bow tie
    assert crosses_itself(SQUARE[[0, 1, 1, 2, 3]])  # a side without length
    assert crosses_itself(np.array([[0.0, 0], [4, 0], [4, 4], [2, 0], [0, 4]]))  # a corner on a side
    # of six corners those of the two sides that meet, 1 2 and 3 4
    assert crossing_points(np.array([[0.0, 2], [0, 0], [4, 4], [4, 0], [0, 4], [-2, 3]])).tolist() == [1, 2, 3, 4]
    with pytest.raises(AnatomyError, match="crosses itself"):
        triangulate_loop(flat(SQUARE), np.array([0, 2, 1, 3]), UP)


def test_heights_are_the_mean_of_their_neighbours() -> None:
    fan = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    assert harmonic_heights(fan, np.array([1.0, 2, 3, 6]), 5).tolist() == pytest.approx([1, 2, 3, 6, 3])
    assert harmonic_heights(fan[:0], np.array([1.0, 2]), 2).tolist() == [1, 2]


def test_a_plate_over_a_round_opening_has_the_volume_of_a_disc() -> None:
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    points = np.column_stack([10 * np.cos(angle), 10 * np.sin(angle), np.zeros(24)])
    plate = extrude_plate(points, np.arange(24), np.empty((0, 3), dtype=np.int64), np.array([0.0, 0, -30]), 2.0)
    everything = np.vstack([points, plate.points])
    cells = volumes(everything, plate.tets)
    assert cells.min() > 0
    # a 24-gon of radius 10 has 12 sin(15 deg) 100 mm2; 2 mm thick, outward from the centre
    assert cells.sum() == pytest.approx(2 * 12 * np.sin(np.radians(15)) * 100, rel=1e-9)
    assert everything[:, 2].min() > -1e-9 and everything[:, 2].max() == pytest.approx(2.0)
    assert len(plate.annulus) == 0
