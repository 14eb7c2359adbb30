"""The program as a whole: what the system refuses is one message."""

from __future__ import annotations

import sys

import pytest
from typer.testing import CliRunner

from lacli.cli import main


def test_marks_of_ours_do_not_show() -> None:
    for words in (["doctor"], ["verify", "law"]):
        text = CliRunner().invoke(main.build({words[0]}), words).stdout
        assert "ok" in text and "[/]" not in text and "[bold" not in text


@pytest.mark.parametrize("words", ["simulate {}", "emulate --inputs {} --outputs y.csv", "mesh {}.stl", "design -n 4 --out {}"])
def test_a_path_the_system_refuses_is_one_message(
    words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["lacli", *words.format("x" * 300).split()])
    code = main._code_of_the_command()
    told = capsys.readouterr().err
    # the call is written as it should be, the system does not take the name: 1, as for a file that is missing
    assert code == 1 and "lacli: xxx" in told and "File name too long" in told
    assert "Traceback" not in told
