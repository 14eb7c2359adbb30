"""A scene as every command reads it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lacli.base.errors import SceneError
from lacli.cli.terminal.scenes import read_scene
from lacli.inference.box import Box


def test_what_is_possible_but_unusual_is_said_of_scene_and_box(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "scene.toml"
    file.write_text('[anatomy]\nbundle = "la"\n[loads]\nesp_mmhg = 15\n')
    assert read_scene(file).loads.esp_mmhg == 15
    assert capsys.readouterr() == ("", ""), "nothing to say of an ordinary scene"
    scene = read_scene(file, ["loads.esp_mmhg=150"], Box(("alpha_roof",), np.array([0.1]), np.array([30.0])))
    said = capsys.readouterr()
    assert scene.loads.esp_mmhg == 150
    assert said.out == ""
    notes = said.err.splitlines()
    assert any(line.startswith("note: loads.esp_mmhg") for line in notes)
    assert any("alpha_roof" in line for line in notes)


def test_an_unknown_key_is_one_error(tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    file.write_text('[anatomy]\nbundle = "la"\n')
    with pytest.raises(SceneError, match=r"loads\.edp: unknown key"):
        read_scene(file, ["loads.edp=3"])
