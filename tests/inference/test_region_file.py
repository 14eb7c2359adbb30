"""A matched region as a file: what is read is what was written, and nothing else is taken."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from lacli.base.errors import InputError
from lacli.inference.box import make_box
from lacli.inference.matching.file import load_match, save_match
from lacli.inference.matching.matching import Match
from lacli.inference.matching.nroy import RegionSample

BOX = make_box(("a", "b"), (0.0, 0.0), (1.0, 2.0))
FOUND = Match(
    RegionSample(np.array([[0.5, 1.0], [0.1, 1.9]]), np.array([0.2, 0.9]), 0.3, 0.01, 0.4, 0.1, 5000), 0.3, 0.01, np.nan
)


def test_a_region_comes_back_as_it_was(tmp_path: Path) -> None:
    save_match(tmp_path / "m.npz", FOUND, "made from this")
    again = load_match(tmp_path / "m.npz", BOX)
    assert (again.sample.points == FOUND.sample.points).all() and (again.sample.level == FOUND.sample.level).all()
    assert dataclasses.astuple(again)[1:3] == dataclasses.astuple(FOUND)[1:3] and np.isnan(again.change)
    assert again.sample.evaluations == 5000 and isinstance(again.sample.evaluations, int)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"share": 0.0}, "share of the box is 0"),
        ({"share": 1.5}, "share of the box is 1.5"),
        ({"sample": dataclasses.replace(FOUND.sample, points=np.array([[0.5, 9.0], [0.1, 1.0]]))}, "out of the box"),
        ({"sample": dataclasses.replace(FOUND.sample, points=np.array([[0.5], [0.1]]))}, "2 inputs are expected"),
        ({"sample": dataclasses.replace(FOUND.sample, level=np.array([0.2, 1.9]))}, "level"),
    ],
)
def test_what_is_no_region_of_the_box_is_refused(tmp_path: Path, change: dict[str, object], words: str) -> None:
    save_match(tmp_path / "m.npz", dataclasses.replace(FOUND, **change), "made from this")
    with pytest.raises(InputError, match=words):
        load_match(tmp_path / "m.npz", BOX)


def test_a_file_that_was_edited_is_refused(tmp_path: Path) -> None:
    save_match(tmp_path / "m.npz", FOUND, "made from this")
    arrays = dict(np.load(tmp_path / "m.npz"))
    arrays["numbers"][5] = 0.9
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(InputError, match="Remove it to match anew"):
        load_match(tmp_path / "m.npz", BOX)
