"""The mitral valve: from what faces the ventricle, from a flat patch, or opposite the veins; with what each is worth."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import HEIGHT, RADIUS, RIM, cut_ball, icosphere

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings.branches import Skeleton
from lacli.anatomy.openings.candidate import CONTACT, GUESS, Candidate
from lacli.anatomy.openings.candidate import RIM as RIM_SEEN
from lacli.anatomy.openings.mitral import (
    SHARP_DEG,
    border_turn_deg,
    lv_contact,
    mitral_from_contact,
    mitral_from_shape,
    of_contact,
)
from lacli.base.errors import AnatomyError
from lacli.geometry.surface import Surface

UP = np.array([0.0, 0, 1])


def labels(low: float, value: int = 3) -> Image:
    """Voxels of 1 mm, the ventricle from z = ``low`` up, within 12 mm of the axis."""
    axis = np.arange(61) - 30.0
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    return Image(
        np.where((z >= low) & (np.hypot(x, y) <= 12), value, 0).astype(np.uint8), np.ones(3), np.full(3, -30.0), np.eye(3)
    )


def vein(x: float, y: float) -> Candidate:
    return Candidate(np.array([x, y, -15.0]), -UP, 80.0, RIM_SEEN, np.array([5.0, 0, 0]))


VEINS = [vein(x, y) for x in (-9.0, 9.0) for y in (-9.0, 9.0)]


def test_the_patch_that_faces_the_ventricle_is_the_valve() -> None:
    ball = cut_ball()  # flat at z = 14
    contact = lv_contact(labels(15.0), 3, ball)
    assert contact is not None and contact[:, 2].min() > 11
    found = mitral_from_contact(ball, contact)
    assert found.normal @ UP > 0.999
    assert found.centre[:2] == pytest.approx([0, 0], abs=1.4)  # an edge of the ball
    assert HEIGHT - 1.5 < found.centre[2] < HEIGHT
    assert found.diameter_mm == pytest.approx(2 * 12, rel=0.1)  # the ventricle's disc
    assert (found.beyond - found.centre) @ UP > 0  # the cut takes something
    one = of_contact(ball, contact)
    assert one.source == CONTACT and one.diameter_mm == pytest.approx(found.diameter_mm)


def test_a_ventricle_that_is_far_or_not_there() -> None:
    ball = cut_ball()
    assert lv_contact(labels(23.0), 3, ball) is None
    with pytest.raises(AnatomyError, match=r"label 4 \(left ventricle\) has no voxel"):
        lv_contact(labels(15.0), 4, ball)
    with pytest.raises(AnatomyError, match=r"scattered points only; give \[mv\]"):
        mitral_from_contact(ball, ball.points[:1])


def test_without_a_ventricle_a_flat_patch_is_taken_and_said_to_be_no_more_than_likely() -> None:
    flat = mitral_from_shape(cut_ball(), Skeleton(np.zeros(3), 14.0, ()), VEINS)
    assert (flat.source, flat.confidence) == ("largest flat patch", 0.6)
    assert flat.normal @ UP > 0.999 and flat.diameter_mm == pytest.approx(2 * RIM, rel=0.05)
    round_ = mitral_from_shape(icosphere(RADIUS, 4), Skeleton(np.zeros(3), RADIUS, ()), VEINS)
    assert (round_.source, round_.confidence) == ("opposite the veins", 0.2)
    assert round_.normal == pytest.approx(UP, abs=1e-9)
    assert round_.centre == pytest.approx([0, 0, 0.75 * RADIUS], abs=0.2)


def patch(surface: Surface) -> Candidate:
    found = mitral_from_shape(surface, Skeleton(np.zeros(3), 14.0, ()), VEINS)
    assert found.source == "largest flat patch"
    area = np.pi * found.diameter_mm**2 / 4
    return Candidate(found.centre, found.normal, area, GUESS, np.array([found.diameter_mm / 2, 0, 0]))


def test_a_cut_has_a_sharp_border_and_a_body_that_happens_to_be_flat_has_none() -> None:
    # the ball's own normal at the cut is acos(14 / 20) = 46 degrees off the axis, and 10 more 3.5 mm beyond
    cut = border_turn_deg(cut_ball(), patch(cut_ball()))
    assert cut == pytest.approx(56, abs=3) and cut > SHARP_DEG
    # a ball of 120 mm is flat within .9 mm over 15 mm each way: 7 degrees, and 3.5 mm beyond 9
    ball = icosphere(120.0, 6)
    assert border_turn_deg(ball, patch(ball)) == pytest.approx(9, abs=2)
    # nothing flat there: no border
    assert border_turn_deg(ball, vein(0.0, 0.0)) == 0.0
