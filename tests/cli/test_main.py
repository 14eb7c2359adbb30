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


@pytest.mark.parametrize(
    ("words", "exit_code"),
    # 2 for a scene, which is part of the call, as where it is missing; 1 for data
    [("simulate {}", 2), ("emulate --inputs {} --outputs y.csv", 1), ("mesh {}.stl", 1), ("design -n 4 --out {}", 1)],
)
def test_a_path_the_system_refuses_is_one_message(
    words: str, exit_code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["lacli", *words.format("x" * 300).split()])
    code = main._code_of_the_command()
    told = capsys.readouterr().err
    assert code == exit_code and "lacli: xxx" in told and "File name too long" in told
    assert "Traceback" not in told
    if "--out" not in words:  # a file that is not there ends in the same code
        monkeypatch.setattr(sys, "argv", ["lacli", *words.format("absent").split()])
        assert main._code_of_the_command() == exit_code
