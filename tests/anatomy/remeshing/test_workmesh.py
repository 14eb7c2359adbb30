"""A mesh in work: borders and corners by hand, points put back where they belong, turned triangles seen."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import HEIGHT, RIM, cut_ball

from lacli.anatomy.remeshing.projection import Reference
from lacli.anatomy.remeshing.workmesh import BORDER, CORNER, INNER, WorkMesh, project, turned

# an octahedron: 0 at the top, 1 - 4 around, 5 at the bottom
POINTS = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]])


def mesh(label: list[int]) -> WorkMesh:
    made = WorkMesh(POINTS.copy(), TRIANGLES, np.array(label), np.full(6, 2.0))
    made.refresh()
    return made


def test_kinds_of_points_by_hand() -> None:
    halves = mesh([0, 0, 0, 0, 21, 21, 21, 21])  # the border is the equator
    assert halves.kind.tolist() == [INNER, BORDER, BORDER, BORDER, BORDER, INNER]
    assert halves.is_border.sum() == 4
    three = mesh([0, 0, 22, 22, 21, 21, 21, 21])  # a second border over the top: from 3 to 1 by 0
    assert three.kind.tolist() == [BORDER, CORNER, BORDER, CORNER, BORDER, INNER]
    assert mesh([0] * 8).kind.tolist() == [INNER] * 6


def test_every_edge_has_two_wings_with_their_opposite_points() -> None:
    made = mesh([0] * 8)
    assert len(made.edges) == 12 and made.valence.tolist() == [4] * 6
    assert made.length == pytest.approx(np.full(12, np.sqrt(2))) and made.wanted == pytest.approx(np.full(12, 2.0))
    for edge, wings, opposite in zip(made.edges, made.wing, made.opposite, strict=True):
        for triangle, point in zip(wings, opposite, strict=True):
            assert set(TRIANGLES[triangle]) == {*edge.tolist(), int(point)}


def test_points_go_back_to_their_patch_and_the_border_s_to_the_border() -> None:
    ball = cut_ball()
    made = WorkMesh(ball.points.copy(), ball.triangles, ball.label, np.full(len(ball.points), 2.0))
    made.refresh()
    rng = np.random.default_rng(0)
    made.points += rng.normal(0, 0.2, made.points.shape)
    everything = np.arange(len(made.points))
    project(made, everything, Reference(ball))
    border = made.kind == BORDER
    assert made.points[border, 2] == pytest.approx(HEIGHT, abs=1e-9)
    assert np.hypot(*made.points[border, :2].T) == pytest.approx(RIM, abs=0.1)
    on_plane = np.unique(made.triangles[made.label == 21])
    assert made.points[on_plane, 2] == pytest.approx(HEIGHT, abs=1e-9)
    assert Reference(ball).distance(made.points).max() < 1e-6


def test_a_triangle_that_is_pushed_over_is_seen_and_a_shift_of_all_is_none() -> None:
    ball = cut_ball()
    made = WorkMesh(ball.points, ball.triangles, ball.label, np.full(len(ball.points), 2.0))
    made.refresh()
    every = np.arange(len(ball.triangles))
    assert not turned(made, ball.points + 3.0, every).any()
    moved = ball.points.copy()
    corner, other = ball.triangles[0, :2]
    moved[corner] += 2.2 * (ball.points[other] - ball.points[corner])  # past its neighbour
    found = np.flatnonzero(turned(made, moved, every))
    assert len(found) and (ball.triangles[found] == corner).any(axis=1).all()
