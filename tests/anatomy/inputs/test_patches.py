"""What tags say: known ones name the rims beside them, and a tagged patch without a rim is a candidate of its own."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import cut_ball, icosphere

from lacli.anatomy.inputs.patches import BODY_TAG, candidates, of_triangles
from lacli.anatomy.openings.candidate import PATCH, RIM, of_ring


def test_tags_of_another_meaning_are_none() -> None:
    ball = icosphere(20.0, 2)
    tag = np.full(len(ball.triangles), 1)
    assert of_triangles(ball.points, ball.triangles, tag) is None
    tag[:] = BODY_TAG
    assert of_triangles(ball.points, ball.triangles, tag) is None  # a body alone tells of no opening
    tag[0] = 13
    known = of_triangles(ball.points, ball.triangles, tag)
    assert known is not None and known.names == {13: "appendage"}


def test_a_patch_without_a_rim_is_a_candidate_at_its_border() -> None:
    ball = icosphere(20.0, 4)
    middle = ball.points[ball.triangles].mean(axis=1)
    tagged = of_triangles(ball.points, ball.triangles, np.where(middle[:, 2] > -12, 13, BODY_TAG))
    assert tagged is not None
    (found,) = candidates(ball, [], tagged)
    assert (found.source, found.said) == (PATCH, "appendage")
    assert found.centre == pytest.approx([0, 0, -12], abs=0.6)
    assert found.direction @ [0, 0, 1] > 0.99
    assert found.diameter_mm == pytest.approx(2 * 16, rel=0.05)  # 20^2 - 12^2 = 16^2
    assert found.length_mm == pytest.approx(32, abs=0.6)  # to the pole


def test_a_rim_is_named_by_the_tags_around_it() -> None:
    ball = cut_ball()
    middle = ball.points[ball.triangles].mean(axis=1)
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = np.column_stack([np.sqrt(204) * np.cos(angle), np.sqrt(204) * np.sin(angle), np.full(40, 14.0)])
    rim = of_ring(ring, np.array([0.0, 0, 1]), RIM, cap=21)
    tagged = of_triangles(ball.points, ball.triangles, np.where(middle[:, 2] > 8, 21, BODY_TAG))
    assert tagged is not None
    (found,) = candidates(ball, [rim], tagged)
    assert found.said == "lspv" and found.cap == 21
    # half of the rim beside one tag, half beside another: nobody is believed
    split = np.where(middle[:, 2] > 8, np.where(middle[:, 0] > 0, 21, 23), BODY_TAG)
    tagged = of_triangles(ball.points, ball.triangles, split)
    assert tagged is not None
    assert candidates(ball, [rim], tagged)[0].said == ""
