"""Triangles cut along the zero of a field."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import icosphere

from lacli.geometry.isolines import edges_inside, snap, split
from lacli.geometry.surface import Surface, unique_edges


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda n: np.linalg.norm(n) > 0.2), st.floats(-6.0, 6.0))
def test_a_cut_keeps_the_area_and_no_triangle_has_both_signs(normal: tuple[float, float, float], offset: float) -> None:
    ball = icosphere(10.0, 2)
    value = ball.points @ (np.array(normal) / np.linalg.norm(normal)) - offset
    made, field = split(ball, value)
    corner = field[made.triangles]
    tiny = 1e-9
    assert not ((corner > tiny).any(axis=1) & (corner < -tiny).any(axis=1)).any()
    assert made.area_mm2() == pytest.approx(ball.area_mm2(), rel=1e-9)
    assert made.volume_ml() == pytest.approx(ball.volume_ml(), rel=1e-9)
    assert (field[len(ball.points) :] == 0.0).all()


def test_points_next_to_the_line_are_put_on_it_and_others_stay() -> None:
    square = Surface(
        np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, dtype=np.int64)
    )
    value = square.points[:, 0] - 0.2  # crosses the sides at a fifth of their length from the left
    made, field = snap(square, value, np.ones(4, bool))
    assert made.points[[0, 3], 0] == pytest.approx([0.2, 0.2]) and field[[0, 3]].tolist() == [0.0, 0.0]
    assert made.points[[1, 2]].tolist() == square.points[[1, 2]].tolist()
    held, _ = snap(square, value, np.zeros(4, bool))
    assert held.points.tolist() == square.points.tolist()
    far, _ = snap(square, square.points[:, 0] - 0.5, np.ones(4, bool))
    assert far.points.tolist() == square.points.tolist(), "half way is not next to it"


def test_an_edge_is_inside_where_all_its_triangles_are() -> None:
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    edges, _ = unique_edges(triangles)
    inside = edges_inside(triangles, np.array([True, False]))
    assert {tuple(e) for e in edges[inside].tolist()} == {(0, 1), (1, 2)}
