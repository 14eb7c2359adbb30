"""What every command shares at the terminal."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lacli.api.progress import Progress
from lacli.cli.terminal import console


def test_a_document_is_json_whatever_numbers_it_holds(capsys: pytest.CaptureFixture[str]) -> None:
    console.print_json(
        {"a": np.array([1.5, np.nan]), 2: (np.int64(3), True, None), "path": Path("x/y"), "n": float("inf"), "t": np.float32(0.5)}
    )
    text = capsys.readouterr().out
    assert json.loads(text) == {"a": [1.5, None], "2": [3, True, None], "path": "x/y", "n": None, "t": 0.5}
    assert "NaN" not in text and "Infinity" not in text


def test_a_table_has_four_digits_and_shows_brackets_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    console.print_table("Title [bold]", ["name", "value (mm)"], [["[red]a[/red] :smile:", 1.234567], ["b", 12], ["c", "text"]])
    text = capsys.readouterr().out
    for words in ("Title [bold]", "value (mm)", "[red]a[/red] :smile:", "1.235", "12", "text"):
        assert words in text


def test_a_failure_is_one_line_on_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    console.fail(ValueError("x" * 300 + " [box]"))
    said = capsys.readouterr()
    assert said.out == "" and said.err == "lacli: " + "x" * 300 + " [box]\n"


def test_progress_leaves_nothing_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with console.stages() as show:
        for done in (0.0, 0.5, 1.0):
            show(Progress("meshing", done, 1.0, None))
            show(Progress("fibres", done, 2.0, None))
    with console.one_bar("begin") as one:
        one(Progress("drawing", 1.0, 1.0, None))
    assert capsys.readouterr() == ("", "")
