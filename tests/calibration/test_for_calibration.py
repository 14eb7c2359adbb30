"""``lacli tradeoff``: what it refuses before anything runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from shapes import hollow_cube
from typer.testing import CliRunner

from lacli.cli.main import build
from lacli.contracts.bundle import save

TARGETS = "[targets.esv_ml]\nmean = 90.0\nsd = 4.0\n"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    save(hollow_cube(), tmp_path / "la")
    (tmp_path / "scene.toml").write_text('[anatomy]\nbundle = "la"\n')
    (tmp_path / "targets.toml").write_text(TARGETS)
    return tmp_path


def lacli(place: Path, *arguments: object) -> Any:
    return CliRunner().invoke(build({"tradeoff"}), ["tradeoff", str(place / "scene.toml"), *map(str, arguments)])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--for", "speed"], "--for speed: must be features or calibration"),
        (["--for", "calibration"], "--for calibration and --targets go together"),
        (["--targets", "targets.toml"], "--for calibration and --targets go together"),
        (["--for", "calibration", "--targets", "none.toml"], "no such targets file"),
    ],
)
def test_what_cannot_be_is_refused(place: Path, arguments: list[str], words: str) -> None:
    given = [str(place / a) if a.endswith(".toml") else a for a in arguments]
    assert words in str(lacli(place, *given, "--out", place / "runs").exception)
    assert not (place / "runs").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--set", "loads.esp_mmhg=60"], "esp_mmhg 60"),
        (["--set", "numerics.engine=script"], "need the compiled engine"),
        (["--finer", "nowhere"], "nowhere: not an anatomy bundle"),
    ],
)
def test_a_calibration_that_cannot_be_weighed_is_one_message(place: Path, more: list[str], words: str) -> None:
    given = [str(place / a) if a == "nowhere" else a for a in more]
    shown = lacli(place, "--for", "calibration", "--targets", place / "targets.toml", "--out", place / "runs", *given)
    assert words in str(shown.exception)
