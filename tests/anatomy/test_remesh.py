"""Remeshing: edge lengths, volume, borders and orientation on shapes that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import HEIGHT, RADIUS, RIM, cut_ball

from lacli.anatomy.cuts.cut import Cut, cut_open
from lacli.anatomy.cuts.rims import label_rings
from lacli.anatomy.remeshing.projection import border_edges
from lacli.anatomy.remeshing.remesh import remesh
from lacli.base.errors import AnatomyError
from lacli.geometry.surface import Surface, defects, unique_edges


def test_the_cut_ball_has_the_volume_of_the_formula() -> None:
    cap = np.pi * (RADIUS - HEIGHT) ** 2 * (3 * RADIUS - (RADIUS - HEIGHT)) / 3  # of the piece removed
    exact = (4 / 3 * np.pi * RADIUS**3 - cap) / 1000
    ball = cut_ball()
    assert ball.volume_ml() == pytest.approx(exact, rel=4e-3)  # inscribed triangles of 1.4 mm lose 3 h^2 / (8 R^2) or so
    plane = ball.label == 21
    assert ball.areas()[plane].sum() == pytest.approx(np.pi * RIM**2, rel=5e-3)
    assert ball.normals()[plane] == pytest.approx(np.broadcast_to([0, 0, 1.0], (plane.sum(), 3)), abs=1e-9)


@settings(max_examples=8, deadline=None)
@given(st.floats(1.5, 8.0))
def test_remeshing_keeps_shape_and_gets_the_size(size: float) -> None:
    ball = cut_ball()
    result = remesh(ball, size)
    assert defects(result.triangles) == ""
    assert result.volume_ml() == pytest.approx(ball.volume_ml(), rel=3e-3)
    edges, _ = unique_edges(result.triangles)
    length = np.linalg.norm(result.points[edges[:, 0]] - result.points[edges[:, 1]], axis=1)
    assert 0.75 * size < np.median(length) < 1.25 * size
    assert length.max() < 1.7 * size
    # no fold: every triangle of the wall looks away from the centre, every one of the plane upward
    wall = result.label == 0
    middle = result.points[result.triangles].mean(axis=1)
    radial = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", radial, result.normals())[wall].min() > 0.85
    assert result.normals()[~wall, 2].min() > 0.99
    # the rim is still the circle
    rim = result.points[np.unique(border_edges(result.triangles, result.label))]
    assert rim[:, 2] == pytest.approx(HEIGHT, abs=1e-6)
    assert np.hypot(rim[:, 0], rim[:, 1]) == pytest.approx(RIM, abs=0.1)


def test_rings_have_the_width_asked() -> None:
    ball = label_rings(cut_ball(), 2.5)
    assert set(np.unique(ball.label)) == {0, 11, 21}
    # chord of 2.5 mm from the rim down the sphere: polar angle from acos(14/20) by 2 asin(2.5/40)
    angle = np.arccos(HEIGHT / RADIUS) + 2 * np.arcsin(2.5 / (2 * RADIUS))
    area = 2 * np.pi * RADIUS**2 * (HEIGHT / RADIUS - np.cos(angle))
    assert ball.areas()[ball.label == 11].sum() == pytest.approx(area, rel=0.01)
    again = remesh(ball, 4.0)
    assert again.areas()[again.label == 11].sum() == pytest.approx(area, rel=0.02)


def test_the_remesher_refuses_what_it_cannot_do() -> None:
    ball = cut_ball()
    with pytest.raises(AnatomyError, match="positive"):
        remesh(ball, 0.0)
    with pytest.raises(AnatomyError, match="not closed"):
        remesh(Surface(ball.points, ball.triangles[:-3], ball.label[:-3]), 3.0)
    with pytest.raises(AnatomyError, match="does not cut"):
        cut_open(ball, Cut(np.array([0.0, 0, 50]), np.array([0.0, 0, 1]), 40.0, 22))
