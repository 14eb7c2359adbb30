"""Help as it is written: brackets in it, as in ``[box]``, are no marks of the terminal's."""

from __future__ import annotations

from typing import Any

import typer
from rich.markup import escape
from typer.core import TyperGroup


class PlainGroup(TyperGroup):
    """A group whose commands' help texts are shown letter by letter."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command = super().get_command(ctx, cmd_name)
        if command is not None and not hasattr(command, "shielded"):
            command.help = escape(command.help or "")
            command.short_help = escape(command.short_help or "")
            for parameter in command.params:
                if getattr(parameter, "help", None):
                    parameter.help = escape(parameter.help)  # type: ignore[attr-defined]
            command.shielded = True  # type: ignore[attr-defined]
        return command


def application(**settings: Any) -> typer.Typer:
    """A Typer application of such help."""
    return typer.Typer(cls=PlainGroup, rich_markup_mode="rich", **settings)
