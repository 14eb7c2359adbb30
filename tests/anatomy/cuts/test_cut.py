"""Flat cuts of closed surfaces: the volume left is the shape's own, wherever the plane meets points, edges or triangles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import icosphere

from lacli.anatomy.cuts.cut import Cut, cut_open
from lacli.anatomy.cuts.parting import SHIFT_MM
from lacli.base.errors import AnatomyError
from lacli.contracts.labels import PLANES
from lacli.geometry.surface import Surface, check
from lacli.synthetic.atrium import GRID_MM, isosurface
from lacli.synthetic.shape import draw

RADIUS, LABEL = 10.0, 25
BALL = icosphere(RADIUS, 3)
OFF = st.sampled_from([0.0, 1e-15, -1e-12, 1e-12, -1e-9, 1e-9, -1e-6, 1e-6])
SPECK = st.sampled_from([1e-1, 1e-2, 3e-3, 1e-3])
AROUND, ALONG, WIDE, THICK = 24, 16, 10.0, 4.0  # a torus about z: points round the axis and round the tube, radii mm


def torus() -> Surface:
    u, v = np.meshgrid(2 * np.pi * np.arange(AROUND) / AROUND, 2 * np.pi * np.arange(ALONG) / ALONG, indexing="ij")
    r = WIDE + THICK * np.cos(v)
    points = np.stack([r * np.cos(u), r * np.sin(u), THICK * np.sin(v)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(AROUND), np.arange(ALONG), indexing="ij")

    def at(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a % AROUND * ALONG + b % ALONG).ravel()

    one = np.column_stack([at(i, j), at(i + 1, j), at(i + 1, j + 1)])
    two = np.column_stack([at(i, j), at(i + 1, j + 1), at(i, j + 1)])
    triangles = np.vstack([one, two])
    return Surface(points, triangles, np.zeros(len(triangles), dtype=np.int64))


def with_speck(ball: Surface, face: int, size: float) -> Surface:
    """The same surface, one of its triangles divided about a tiny one of ``size`` mm (at most half of it) in its middle."""
    a, b, c = ball.triangles[face]
    middle = ball.points[[a, b, c]].mean(axis=0)
    share = min(0.5, size / float(np.linalg.norm(ball.points[a] - middle)))
    tiny = middle + share * (ball.points[[a, b, c]] - middle)
    p, q, r = len(ball.points) + np.arange(3)
    parts = [[p, q, r], [a, b, p], [b, q, p], [b, c, q], [c, r, q], [c, a, r], [a, p, r]]
    triangles = np.vstack([np.delete(ball.triangles, face, axis=0), parts])
    return Surface(np.vstack([ball.points, tiny]), triangles, np.zeros(len(triangles), dtype=np.int64))


def cut_ball_ml(height: float) -> float:
    """Volume (mL) of a ball of RADIUS below a plane at that height (mm) over its middle."""
    return np.pi * (2 * RADIUS**3 / 3 + RADIUS**2 * height - height**3 / 3) / 1000.0


def assert_ball_is_cut(ball: Surface, centre: np.ndarray, direction: np.ndarray) -> None:
    done = cut_open(ball, Cut(centre, direction, 3 * RADIUS, LABEL))
    check(done, "ball")
    # the triangles enclose a little less than the ball; points that move onto the plane take a little more or less with them
    share = ball.volume_ml() / cut_ball_ml(RADIUS)
    assert done.volume_ml() == pytest.approx(share * cut_ball_ml(float(centre @ direction)), rel=0.02, abs=0.02)
    plane = done.points[np.unique(done.triangles[done.label == LABEL])]
    assert np.abs((plane - centre) @ direction).max() < SHIFT_MM


def way(polar: float, azimuth: float) -> np.ndarray:
    return np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])


@settings(max_examples=12, deadline=None)
@given(st.integers(0, len(BALL.points) - 1), OFF, st.floats(0, np.pi), st.floats(0, 2 * np.pi))
def test_a_plane_through_a_point_of_a_ball(point: int, off: float, polar: float, azimuth: float) -> None:
    direction = way(polar, azimuth)
    centre = BALL.points[point] + off * direction
    if centre @ direction < 0:
        direction = -direction
    if centre @ direction < 0.9 * RADIUS:
        assert_ball_is_cut(BALL, centre, direction)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, len(BALL.triangles) - 1), SPECK, OFF, st.floats(0, np.pi), st.floats(0, 6.3))
def test_a_plane_through_a_tiny_triangle(face: int, size: float, off: float, polar: float, azimuth: float) -> None:
    # the tiny triangle's three points are all put onto the plane: it would lie there twice, of the wall and of the plane
    ball, direction = with_speck(BALL, face, size), way(polar, azimuth)
    centre = ball.points[-3:].mean(axis=0) + off * direction
    if centre @ direction < 0:
        direction = -direction
    if centre @ direction < 0.9 * RADIUS:
        assert_ball_is_cut(ball, centre, direction)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, AROUND * ALONG - 1), OFF)
def test_a_plane_through_points_of_a_torus(point: int, off: float) -> None:
    """Planes across x outside the hole: one curve."""
    ring, direction = torus(), np.array([1.0, 0, 0])
    height = float(ring.points[point, 0]) + off
    if not WIDE - THICK + 1e-7 < height < WIDE + 0.8 * THICK:
        return
    done = cut_open(ring, Cut(np.array([height, 0, 0]), direction, 50.0, LABEL))
    check(done, "torus")
    # what is left of the torus: its sections across x, over y from 0 to the outer circle, twice for the two halves
    x = np.linspace(-WIDE - THICK, height, 1501)
    y = np.linspace(0, WIDE + THICK, 1501)
    tall = THICK**2 - (np.hypot(x[:, None], y[None]) - WIDE) ** 2
    exact = 4 * np.sqrt(np.maximum(tall, 0)).mean() * (x[-1] - x[0]) * y[-1] / 1000.0
    whole = 2 * np.pi**2 * WIDE * THICK**2 / 1000.0
    assert done.volume_ml() == pytest.approx(exact * ring.volume_ml() / whole, rel=0.02)


def test_a_plane_through_the_point_where_a_torus_s_section_meets_itself() -> None:
    # at the hole's side the section is an eight; a little farther out it is one curve, farther in two
    ring, direction = torus(), np.array([1.0, 0, 0])
    done = cut_open(ring, Cut((WIDE - THICK + 1e-9) * direction, direction, 50.0, LABEL))
    check(done, "torus")
    assert np.ptp(done.points[np.unique(done.triangles[done.label == LABEL]), 0]) < SHIFT_MM
    with pytest.raises(AnatomyError, match="in 2 closed curves, expected one"):
        cut_open(ring, Cut((WIDE - THICK - 1e-9) * direction, direction, 50.0, LABEL))


def test_a_plane_that_cuts_a_torus_in_two_curves_or_misses_is_refused() -> None:
    with pytest.raises(AnatomyError, match="in 2 closed curves, expected one"):
        cut_open(torus(), Cut(np.array([1.0, 0, 0]), np.array([1.0, 0, 0]), 50.0, LABEL))
    with pytest.raises(AnatomyError, match="does not cut the surface"):
        cut_open(BALL, Cut(np.array([0.0, 0, 20]), np.array([0.0, 0, 1]), 50.0, LABEL))


def test_a_vessel_of_an_atrium_whose_plane_meets_a_tiny_triangle() -> None:
    # three points of the surface within 0.005 mm lie within 0.001 mm of the plane: moved onto it, they were wall and plane
    shape = draw(45)
    cut = next(c for c in shape.cuts() if c.label == PLANES["lipv"])
    done = cut_open(isosurface(shape, GRID_MM), cut)
    check(done, "atrium of seed 45")
    # a round tube that tapers evenly, a little wider where it begins to flare into the body
    tube = shape.tubes["lipv"]
    along = tube.cut_mm / np.linalg.norm(tube.end - tube.start)
    radius = tube.radius_start + along * (tube.radius_end - tube.radius_start)
    assert done.areas()[done.label == cut.label].sum() / (np.pi * radius**2) == pytest.approx(1.0, abs=0.05)
