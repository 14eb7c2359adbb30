"""The example in Python runs, cell by cell, and finds what it was made from."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from typing import Any

import pytest

import lacli
import lacli.types

FILE = Path(__file__).resolve().parents[2] / "examples" / "api.py"
CELLS = re.split(r"^# %%(?: \[markdown\])?\n", FILE.read_text(encoding="utf-8"), flags=re.MULTILINE)


def _run(cells: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setattr(sys, "argv", [str(FILE), str(folder)])
    names: dict[str, Any] = {"__name__": "__main__"}
    for cell in cells:
        exec(compile(cell, str(FILE), "exec"), names)
    return names


def _first(word: str) -> int:
    return next(i for i, cell in enumerate(CELLS) if word in cell and not cell.startswith("#"))


def test_the_cells_before_the_first_simulation_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = _run(CELLS[: _first("lacli.simulate(")], tmp_path, monkeypatch)
    assert names["scene"].materials.alpha.roof == 2.0 == names["truth"]["alpha_roof"]
    assert names["scene"].materials.alpha.posterior == 1.0 == names["truth"]["alpha_posterior"]
    assert names["atrium"].report["cavity_volume_ml"] > 40.0


def test_every_name_of_the_library_in_it_is_public() -> None:
    used = {
        node.attr
        for node in ast.walk(ast.parse(FILE.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "lacli"
    }
    assert used <= {*lacli.__all__, "types"}
    assert set(re.findall(r"lacli\.types\.(\w+)", FILE.read_text(encoding="utf-8"))) <= set(lacli.types.__all__)
    assert {"synthesize", "simulate", "design", "emulate", "match", "posterior"} <= used


@pytest.mark.slow
def test_the_example_finds_its_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, freefem: object) -> None:
    names = _run(CELLS, tmp_path, monkeypatch)
    assert names["runs"].failed == 0
    assert 0.0 < names["left"].match.share < 0.5
    for row in names["answer"].summary:
        assert row["low95"] <= names["truth"][row["input"]] <= row["high95"]
