"""The program as a whole: what the system refuses is one message."""

from __future__ import annotations

import sys

import pytest

from lacli.cli import main


@pytest.mark.parametrize("words", ["simulate {}", "emulate --inputs {} --outputs y.csv", "mesh {}.stl", "design -n 4 --out {}"])
def test_a_path_the_system_refuses_is_one_message(
    words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["lacli", *words.format("x" * 300).split()])
    with pytest.raises(SystemExit) as ended:
        main.run()
    told = capsys.readouterr().err
    assert ended.value.code == 1 and "lacli: xxx" in told and "File name too long. Check that" in told
    assert "Traceback" not in told
