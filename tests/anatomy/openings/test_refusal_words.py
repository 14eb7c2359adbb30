"""What a refusal says: which vein, where, what to give; and what it leaves is unconfirmed unless it was given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lacli.anatomy.openings import refusals
from lacli.anatomy.openings.candidate import GIVEN, RIM, Candidate
from lacli.anatomy.openings.landmarks import Landmarks, Opening
from lacli.anatomy.openings.naming import Naming, Reading

AXIS = np.array([0.0, 0, 5])
FIVE = [Candidate(np.array([10.0 * k, 0, 0]), np.array([0.0, 0, 1]), np.pi * 36, RIM, AXIS) for k in range(5)]
NAMES = {"mv": 0, "lspv": 1, "lipv": 2, "rspv": 3, "ripv": 4}
BEST = Reading(NAMES, None, False, 1.0)


def opening(name: str, confirmed: bool) -> Opening:
    return Opening(name, np.zeros(3), np.array([0.0, 0, 1]), np.array([0.0, 0, 2]), 12.0, 0.9, "found", confirmed=confirmed)


def test_too_few_openings_are_listed_with_kind_size_and_place() -> None:
    words = refusals.too_few(FIVE[:2])
    assert words.startswith("only 2 openings found (open rim, 12 mm wide at (0, 0, 0) mm; open rim, 12 mm wide at (10, 0, 0) mm)")
    assert "give the missing in landmarks.toml" in words
    assert refusals.too_few(FIVE[:1]).startswith("only 1 opening found")
    assert "(none)" in refusals.too_few([])


@pytest.mark.parametrize(("gone", "side", "mate"), [("lspv", "left", "LIPV"), ("ripv", "right", "RSPV")])
def test_a_missing_vein_is_named_with_its_mate_and_its_table(gone: str, side: str, mate: str) -> None:
    words = refusals.without(replace(BEST, missing=gone, names={n: i for n, i in NAMES.items() if n != gone}), FIVE)
    assert f"one vein was found on the {side}, {gone.upper()} is missing" in words
    assert f"common trunk with {mate}" in words and f"[{gone}]" in words


def test_doubts_name_what_differs_between_the_readings_and_nothing_else() -> None:
    swapped = replace(BEST, names={**NAMES, "lspv": 2, "lipv": 1})
    words = refusals.doubts(FIVE, Naming(BEST, swapped, 0.61))
    assert "LSPV at (10, 0, 0) mm or (20, 0, 0) mm, LIPV at (20, 0, 0) mm or (10, 0, 0) mm" in words
    assert "confidence 0.61" in words and "RSPV" not in words and "--landmarks" in words
    assert refusals.doubts(FIVE, Naming(BEST, None, 1.0)) == ""


def test_readings_are_unconfirmed_in_the_order_of_openings_and_what_was_given_stands() -> None:
    given = Landmarks({"mv": opening("mv", True)})
    cuts = lambda reading, _: {n: opening(n, True) for n in reversed(list(reading.names))}  # noqa: E731
    rows = refusals.readings(FIVE, Naming(BEST, replace(BEST, missing="ripv"), 0.6), cuts, given)
    assert [title for title, _ in rows] == ["first reading", "second reading: RIPV is missing"]
    first = rows[0][1].openings
    assert [n for n, o in first.items() if o.confirmed] == ["mv"]
    assert set(first) == set(NAMES)


def test_without_names_what_was_found_is_listed_but_not_what_was_given() -> None:
    ((title, found),) = refusals.readings([*FIVE[:2], replace(FIVE[2], source=GIVEN)], None, lambda reading, _: {})
    assert title == "found, without names" and list(found.openings) == ["extra1", "extra2"]
    one = found.openings["extra2"]
    assert one.centre.tolist() == [10, 0, 0] and one.beyond.tolist() == [10, 0, 2] and not one.confirmed and one.confidence == 0


def test_a_closed_valve_s_veins() -> None:
    assert "LSPV (10, 0, 0) mm" in refusals.veins(FIVE, Naming(BEST, None, 1.0), True)
    assert "(0.55 for the first reading)" in refusals.veins(FIVE, Naming(BEST, None, 0.55), False)
