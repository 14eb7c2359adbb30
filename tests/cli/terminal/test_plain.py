"""Help as it is written."""

from __future__ import annotations

from typing import Annotated

import typer
from typer.testing import CliRunner

from lacli.cli.terminal.plain import application


def test_brackets_in_help_are_letters_and_stay_so_when_help_is_asked_for_again() -> None:
    app = application(no_args_is_help=True)

    def thing(box: Annotated[str, typer.Option(help="Ranges ([box], name = [lower, upper]).")] = "") -> None:
        """Read the [bold] table [box]."""

    app.command(name="thing", short_help="Read the [bold] table [box].")(thing)
    app.command(name="other")(lambda: None)
    for _ in range(2):
        shown = CliRunner().invoke(app, ["thing", "--help"], env={"COLUMNS": "200", "TERMINAL_WIDTH": "200"}).stdout
        assert "Read the [bold] table [box]." in shown
        assert "Ranges ([box], name = [lower, upper])." in shown
        assert "\\[" not in shown
