"""landmarks.toml: what is in doubt is no answer until somebody confirms or changes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.anatomy.openings import landmarks
from lacli.anatomy.openings.landmarks import Landmarks, Opening
from lacli.base.documents import read_toml
from lacli.base.errors import AnatomyError


def opening(name: str, confirmed: bool, at: tuple[float, float, float] = (1.25, 2.5, -3.75)) -> Opening:
    centre, normal = np.array(at), np.array([0.6, 0.0, 0.8])
    return Opening(name, centre, normal, centre + 3.0 * normal, 12.0, 0.5, "branch", confirmed=confirmed)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "landmarks.toml"
    landmarks.write(Landmarks({"mv": opening("mv", False), "lspv": opening("lspv", False), "ripv": opening("ripv", True)}), path)
    return path


def rewritten(file: Path, name: str, **changes: object) -> Landmarks:
    document = read_toml(file, error=AnatomyError, missing="")
    document[name] |= changes
    file.write_text(tomli_w.dumps(document))
    return landmarks.read(file)


def test_what_is_in_doubt_and_unchanged_is_no_answer_and_is_named(file: Path) -> None:
    found = landmarks.read(file)
    assert set(found.openings) == {"ripv"}
    assert len(found.notes) == 1 and "mv, lspv not confirmed" in found.notes[0]


def test_a_corrected_opening_counts_and_the_others_stay_in_doubt(file: Path) -> None:
    found = rewritten(file, "mv", centre=[1.0, 2.5, -3.75])
    assert set(found.openings) == {"mv", "ripv"} and found.openings["mv"].centre[0] == 1.0
    assert "lspv not confirmed" in found.notes[0] and "mv" not in found.notes[0].split(": ")[1]


def test_a_turned_normal_counts_as_a_correction(file: Path) -> None:
    assert "mv" in rewritten(file, "mv", normal=[0.8, 0.0, 0.6]).openings


def test_a_confirmed_opening_counts_unchanged(file: Path) -> None:
    found = rewritten(file, "lspv", confirmed=True)
    assert set(found.openings) == {"lspv", "ripv"}


def test_numbers_rewritten_by_an_editor_are_no_change(file: Path) -> None:
    file.write_text(file.read_text().replace("1.25,", "1.2500,").replace("2.5,", "+2.50,"))
    assert set(landmarks.read(file).openings) == {"ripv"}


def test_a_word_for_confirmed_is_refused(file: Path) -> None:
    with pytest.raises(AnatomyError, match=r"mv\.confirmed must be true or false"):
        rewritten(file, "mv", confirmed="yes")


def test_doubt_without_a_check_sum_is_doubt(file: Path) -> None:
    assert "ripv" not in rewritten(file, "ripv", confirmed=False, centre=[9.0, 9.0, 9.0]).openings


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(-500, 500)] * 3), st.tuples(*[st.floats(-1, 1)] * 3))
def test_any_doubted_opening_is_known_again(tmp_path_factory: pytest.TempPathFactory, at: tuple, way: tuple) -> None:
    path = tmp_path_factory.mktemp("marks") / "l.toml"
    one = Opening("mv", np.array(at), np.array(way), np.array(at), 3.0, 0.1, "x", confirmed=False)
    landmarks.write(Landmarks({"mv": one}), path)
    assert landmarks.read(path).openings == {}
