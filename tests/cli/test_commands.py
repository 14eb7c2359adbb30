"""The commands are found in their files, and their help is shown as written."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

from lacli.cli import main
from lacli.cli.commands import ORDER, commands


def test_the_line_of_help_is_the_first_of_the_function_s_docstring() -> None:
    found = commands()
    assert {"doctor", "simulate", "calibrate"} <= set(found)
    for name, one in found.items():
        documented = importlib.import_module(one.module).command.__doc__
        assert one.text == documented.strip().splitlines()[0], name
        assert one.text.endswith("."), f"{name}: the first line is a sentence"


def test_a_new_command_is_a_new_file(tmp_path: Path) -> None:
    (tmp_path / "anatomy").mkdir()
    (tmp_path / "mechanics").mkdir()
    (tmp_path / "anatomy" / "volume.py").write_text(
        'def command(\n    bundle: str,\n) -> None:\n    """Print the volume.\n\n    Example: lacli volume x\n    """\n'
    )
    (tmp_path / "mechanics" / "simulate.py").write_text('"""Scenes."""\n\n\ndef command() -> None:\n    """Run."""\n')
    (tmp_path / "shared.py").write_text('def commands() -> None:\n    """No command."""\n')
    found = {name: (one.module, one.text) for name, one in commands(tmp_path).items()}
    assert list(found.items()) == [
        ("simulate", ("lacli.cli.mechanics.simulate", "Run.")),
        ("volume", ("lacli.cli.anatomy.volume", "Print the volume.")),
    ]
    assert "volume" not in ORDER


@pytest.mark.parametrize("name", commands())
def test_help_shows_brackets_and_an_example(name: str) -> None:
    app = main.build({name})
    shown = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "300", "TERMINAL_WIDTH": "300"})
    assert shown.exit_code == 0
    letters = "".join(shown.stdout.replace("│", "").split())
    assert "Example:lacli" + name in letters
    command = typer.main.get_command(main.build({name})).commands[name]  # type: ignore[attr-defined]
    for parameter in command.params:
        text = getattr(parameter, "help", None) or ""
        assert "".join(text.split()) in letters, f"{name}: {parameter.name}"


def test_the_list_of_commands_shows_their_lines() -> None:
    shown = CliRunner().invoke(main.build(set()), ["--help"], env={"COLUMNS": "300", "TERMINAL_WIDTH": "300"})
    letters = "".join(shown.stdout.replace("│", "").split())
    for name, one in commands().items():
        assert name + "".join(one.text.split()) in letters
