"""Cutting along a field's zero: area is kept, the new points lie on the zero, nothing degenerates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapes import icosphere

from lacli.geometry.isolines import edges_inside, snap, split
from lacli.geometry.surface import Surface, check

TWO = Surface(np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]), np.array([[0, 1, 2], [0, 2, 3]]), np.array([4, 7]))


def sides(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    a, b, c = (surface.triangles[:, k] for k in range(3))
    return np.concatenate([a, b, c]), np.concatenate([b, c, a])


@given(st.floats(-8.5, 8.5), st.floats(0, np.pi), st.floats(0, 2 * np.pi))
def test_a_plane_parts_a_ball_without_a_gap(height: float, polar: float, azimuth: float) -> None:
    ball = icosphere(10.0, 2)
    normal = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    done, value = split(ball, ball.points @ normal - height)
    assert done.area_mm2() == pytest.approx(ball.area_mm2(), rel=1e-9)  # flat pieces of flat triangles
    assert np.abs(done.points[len(ball.points) :] @ normal - height).max(initial=0.0) < 1e-9
    a, b = sides(done)
    assert (value[a] * value[b] >= 0).all()  # no edge crosses any more
    check(done, "parted")  # still closed


def test_an_edge_is_cut_where_the_line_through_its_ends_is_zero() -> None:
    # x - 0.5 on a square of 2: edges 0-1 and 2-3 at a quarter, the diagonal at (0.5, 0.5)
    done, value = split(TWO, TWO.points[:, 0] - 0.5)
    new = done.points[4:]
    assert sorted(map(tuple, new.round(12).tolist())) == [(0.5, 0.0, 0.0), (0.5, 0.5, 0.0), (0.5, 2.0, 0.0)]
    assert (value[4:] == 0).all()
    assert {v: done.areas()[done.label == v].sum() for v in (4, 7)} == pytest.approx({4: 2.0, 7: 2.0})  # labels go along


def test_only_edges_that_are_allowed_are_cut() -> None:
    inside = edges_inside(TWO.triangles, TWO.label == 4)
    assert inside.tolist() == [True, False, False, True, False]  # 01, 02 (shared), 03, 12, 23
    done, _ = split(TWO, TWO.points[:, 0] - 0.5, inside)
    assert done.points[4:].tolist() == [[0.5, 0.0, 0.0]]


def test_a_point_near_the_zero_is_moved_along_its_edge_and_a_far_one_stays() -> None:
    # x - 0.5: the crossing is a quarter of an edge from points 0 and 3, three quarters from 1 and 2
    done, value = snap(TWO, TWO.points[:, 0] - 0.5, np.ones(4, dtype=bool))
    assert value[[0, 3]].tolist() == [0.0, 0.0] and value[[1, 2]].tolist() == [1.5, 1.5]
    assert done.points[[0, 3], 0] == pytest.approx([0.5, 0.5])
    assert (done.points[[1, 2]] == TWO.points[[1, 2]]).all()
    still, unchanged = snap(TWO, TWO.points[:, 0] - 0.5, np.array([False, True, True, False]))
    assert (still.points == TWO.points).all() and (unchanged == TWO.points[:, 0] - 0.5).all()
