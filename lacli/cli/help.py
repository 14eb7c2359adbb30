"""Help texts as they are written: brackets in them are names of tables in TOML, no marks of the library that prints them."""

from __future__ import annotations

import copy
from typing import Any

from rich.markup import escape
from typer.core import TyperCommand


class PlainHelp(TyperCommand):
    """A command whose help keeps its square brackets."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help, brackets escaped in a copy (the texts themselves stay as they are)."""
        shown = copy.copy(self)
        shown.help = escape(self.help) if self.help else self.help
        shown.params = [copy.copy(parameter) for parameter in self.params]
        for parameter in shown.params:
            text = getattr(parameter, "help", None)
            if text:
                parameter.help = escape(text)  # type: ignore[attr-defined]
        TyperCommand.format_help(shown, ctx, formatter)
