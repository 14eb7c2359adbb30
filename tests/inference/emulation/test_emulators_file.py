"""Where ``lacli emulate`` writes: never over what it reads, nor over files that are not its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lacli.base.errors import StorageError
from lacli.cli.main import build


@pytest.fixture
def place(tmp_path: Path) -> Path:
    x = np.random.default_rng(1).random((16, 2))
    np.savetxt(tmp_path / "x.csv", x, delimiter=",", header="a_kpa,b", comments="")
    np.savetxt(tmp_path / "y.csv", x.sum(1) ** 2, delimiter=",", header="d_mm", comments="")
    return tmp_path


def emulate(place: Path, out: str) -> object:
    tables = ["--inputs", str(place / "x.csv"), "--outputs", str(place / "y.csv"), "--out", str(place / out)]
    return CliRunner().invoke(build({"emulate"}), ["emulate", *tables, "--starts", "1", "--no-figures"]).exception


@pytest.mark.parametrize("name", ["x.csv", "y.csv", "notes.txt"])
def test_inputs_and_files_of_others_are_kept(place: Path, name: str) -> None:
    (place / "notes.txt").write_text("mine")
    before = (place / name).read_bytes()
    assert isinstance(emulate(place, name), StorageError)
    assert (place / name).read_bytes() == before


def test_a_picture_goes_with_the_emulators_it_was_of_and_no_other(place: Path) -> None:
    picture = place / "e.png"
    picture.write_text("mine")
    assert emulate(place, "e.npz") is None
    assert picture.read_text() == "mine"
    assert emulate(place, "e.npz") is None  # the picture beside emulators is of them
    assert not picture.exists()
