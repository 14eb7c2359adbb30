"""Help texts are shown as they are written."""

from __future__ import annotations

import re

import pytest
import typer
from typer.testing import CliRunner

from lacli.cli import main
from lacli.cli.commands import commands


def test_every_text_in_brackets_survives(monkeypatch: pytest.MonkeyPatch) -> None:
    """All help texts of all commands: what stands in square brackets is on the screen."""
    monkeypatch.setenv("COLUMNS", "4000")
    monkeypatch.setenv("TERMINAL_WIDTH", "4000")
    app = main.build(set(commands()))
    seen = 0
    group = typer.main.get_command(app)
    for name in commands():
        if name not in group.commands:
            continue
        command = group.commands[name]
        texts = [command.help or "", *(getattr(p, "help", None) or "" for p in command.params)]
        wanted = {w for text in texts for w in re.findall(r"\[[^\[\]]+\]", text)}
        shown = CliRunner().invoke(app, [name, "--help"]).stdout
        for word in wanted:
            assert word in shown, (name, word)
        seen += len(wanted)
    assert seen >= 4  # [box] of four commands at least: else this tests nothing
