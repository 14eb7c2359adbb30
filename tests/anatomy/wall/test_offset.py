"""Offsets of a cavity: exact on a ball, mitred at a rim, shortened where two sides are close."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import HEIGHT, RADIUS, cut_ball, icosphere

from lacli.anatomy.remeshing.projection import Reference, border_edges
from lacli.anatomy.wall.offset import MAX_MITRE, Offset, offset_surface, untangle
from lacli.anatomy.wall.polish import layer_quality
from lacli.geometry.prisms import split_prisms
from lacli.geometry.surface import Surface, unique_edges
from lacli.geometry.tetrahedra import volumes


def offset(surface: Surface, thickness: float, curved: bool = False) -> tuple[Offset, np.ndarray]:
    edges, _ = unique_edges(surface.triangles)
    made = offset_surface(surface, edges, Reference(surface), lambda points: np.full(len(points), thickness), None, curved)
    return made, edges


def cells(surface: Surface, made: Offset) -> np.ndarray:
    tets = split_prisms(surface.triangles, surface.triangles + len(surface.points), made.starts)
    return volumes(np.vstack([surface.points, surface.points + made.vector]), tets)


@pytest.mark.parametrize(("thickness", "subdivisions"), [(0.5, 3), (2.0, 3)])
def test_a_ball_s_offset_is_radial_and_as_long_as_asked(thickness: float, subdivisions: int) -> None:
    ball = icosphere(RADIUS, subdivisions)
    made, _ = offset(ball, thickness)
    assert made.vector == pytest.approx(ball.points / RADIUS * thickness, abs=0.02 * thickness)
    assert not made.thinned.any()
    outer = Surface(ball.points + made.vector, ball.triangles, ball.label)
    assert cells(ball, made).min() > 0
    assert cells(ball, made).sum() / 1000 == pytest.approx(outer.volume_ml() - ball.volume_ml(), rel=2e-3)


def test_straight_middles_are_the_means_of_the_ends_and_curved_ones_lie_on_the_surface() -> None:
    ball = icosphere(RADIUS, 3)
    straight, edges = offset(ball, 2.0)
    assert straight.middle == pytest.approx(ball.points[edges].mean(axis=1))
    assert straight.middle_vector == pytest.approx(straight.vector[edges].mean(axis=1))
    curved, _ = offset(ball, 2.0, curved=True)
    assert Reference(ball).distance(curved.middle).max() < 1e-9
    assert np.linalg.norm(curved.middle_vector, axis=1) == pytest.approx(2.0, rel=0.02)


def test_a_rim_s_offset_reaches_the_meeting_of_both_sides() -> None:
    ball = cut_ball()
    made, _ = offset(ball, 1.0)
    rim = np.unique(border_edges(ball.triangles, ball.label))
    # the plane looks up, the wall along the radius: at the rim they make acos(14 / 20), and half of it gives the mitre
    half = np.arccos(HEIGHT / RADIUS) / 2
    length = np.linalg.norm(made.vector[rim], axis=1)
    assert np.median(length) == pytest.approx(1 / np.cos(half), rel=0.03)
    assert length.max() < MAX_MITRE
    assert np.median(made.vector[rim, 2]) == pytest.approx(1.0, abs=0.05)  # the plane is moved by its thickness
    assert cells(ball, made).min() > 0


def test_two_sides_of_a_slit_are_kept_apart_and_said_to_be_thin() -> None:
    # two balls whose surfaces are 1 mm apart, walls of 2 mm asked
    one = icosphere(10.0, 3)
    other = Surface(one.points + np.array([21.0, 0, 0]), one.triangles + len(one.points), one.label)
    both = Surface(
        np.vstack([one.points, other.points]), np.vstack([one.triangles, other.triangles]), np.zeros(2 * len(one.label), int)
    )
    made, _ = offset(both, 2.0)
    tip = int(np.argmax(one.points[:, 0]))
    far = int(np.argmin(one.points[:, 0]))
    assert made.thinned[tip] and np.linalg.norm(made.vector[tip]) < 1.0
    assert not made.thinned[far] and np.linalg.norm(made.vector[far]) == pytest.approx(2.0, rel=0.02)


def test_a_wall_that_is_flat_for_its_cells_is_turned_but_not_thinned() -> None:
    # .3 mm on triangles of 5 mm; three of ten vectors are tilted by about 27 degrees (a half of a normal variate aside)
    ball = icosphere(RADIUS, 2)
    normal, rng = ball.points / RADIUS, np.random.default_rng(0)
    vector = normal + 0.5 * rng.normal(size=normal.shape) * (rng.random(len(normal)) < 0.3)[:, None]
    vector *= 0.3 / np.linalg.norm(vector, axis=1, keepdims=True)
    edges, _ = unique_edges(ball.triangles)
    evened, starts = untangle(ball, edges, vector, 1)
    assert np.linalg.norm(evened, axis=1) == pytest.approx(0.3, rel=1e-9)
    tets = split_prisms(ball.triangles, ball.triangles + len(normal), starts)
    assert layer_quality(ball.points, evened, tets, 1).min() > layer_quality(ball.points, vector, tets, 1).min()
