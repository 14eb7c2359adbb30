"""Where a closed valve may be: on the body, apart, clear of the vessels; and names that hold wherever it is."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import icosphere

from lacli.anatomy.openings.candidate import GUESS, RIM, Candidate
from lacli.anatomy.openings.closed_valve import APART_MM, CLEAR_MM, PLACES, VALVE_MM, name, places
from lacli.anatomy.openings.landmarks import LPS

BALL = icosphere(25.0, 3)


def vein(centre: tuple[float, float, float]) -> Candidate:
    at = np.array(centre)
    return Candidate(at, at / np.linalg.norm(at), 150.0, RIM, np.array([0.0, 0, 7]))


# LPS: left +x, back +y, up +z
VEINS = [vein((18, 14, 10)), vein((18, 14, -10)), vein((-18, 14, 10)), vein((-18, 14, -10))]


def test_places_lie_on_the_body_apart_and_clear_of_the_vessels() -> None:
    found = places(BALL, VEINS)
    centre = np.array([c.centre for c in found])
    assert 5 < len(found) <= PLACES
    assert np.linalg.norm(centre, axis=1) == pytest.approx(25.0)
    gaps = np.linalg.norm(centre[:, None] - centre[None], axis=2)[~np.eye(len(found), dtype=bool)]
    assert gaps.min() >= APART_MM
    for v in VEINS:
        assert np.linalg.norm(centre - v.centre, axis=1).min() > CLEAR_MM
    for c in found:
        assert c.source == GUESS and c.said == "mv" and c.diameter_mm == pytest.approx(VALVE_MM)
        assert c.direction @ (c.centre / 25.0) > 0.95  # out of the ball


def test_vessels_everywhere_leave_no_place() -> None:
    assert places(BALL, [vein(tuple(p)) for p in BALL.points[::3]]) == []


def test_veins_in_the_image_s_axes_get_their_names_and_a_valve_in_front_below() -> None:
    flat = Candidate(
        np.array([10.0, -20, -10]), np.array([0.4, -0.8, -0.4]) / np.sqrt(0.96), 700.0, GUESS, np.array([15.0, 0, 0])
    )
    found, valve = name(BALL, VEINS, flat, LPS)
    assert found is not None
    assert {found.best.names[n]: n for n in ("lspv", "lipv", "rspv", "ripv")} == {0: "lspv", 1: "lipv", 2: "rspv", 3: "ripv"}
    assert not found.best.mirrored and 0.5 < found.confidence <= 1.0
    assert valve.said == "mv" and valve.centre[1] < 0  # away from the veins
