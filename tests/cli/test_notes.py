"""What is unusual in a scene is said by every command that takes one."""

from __future__ import annotations

import importlib
import inspect
import sys
from pathlib import Path

import pytest

from lacli.cli import main
from lacli.cli.commands import commands

SCENE = '[anatomy]\nbundle = "la"\n[loads]\nesp_mmhg = 90\n'
# how each command that takes a scene is called with one; a command that is new must be added here
CALLS = {
    "simulate": ["scene.toml"],
    "tradeoff": ["scene.toml"],
    "design": ["scene.toml", "--run", "-n", "2", "--input", "alpha_roof"],
    "calibrate": ["scene.toml", "--synthetic-truth", "--out", "out"],
    "cohort": ["participants.csv", "--scene", "scene.toml", "--out", "study"],
}  # fmt: skip


def takes_a_scene(module: str) -> bool:
    return any("scene" in name for name in inspect.signature(importlib.import_module(module).command).parameters)


def test_every_command_with_a_scene_is_tried_here() -> None:
    assert {name for name, one in commands().items() if takes_a_scene(one.module)} == set(CALLS)


@pytest.mark.parametrize("name", CALLS)
def test_an_unusual_value_is_told(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command ends at once, for there is no bundle; what is unusual was said before."""
    (tmp_path / "scene.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lacli", name, *CALLS[name]])
    assert main._code_of_the_command() in (1, 2)
    told = capsys.readouterr().err
    notes = [line for line in told.splitlines() if line.startswith("note: ")]
    assert any("esp_mmhg" in line and "90" in line for line in notes), told
    assert "Traceback" not in told and sum(line.startswith("lacli: ") for line in told.splitlines()) == 1
