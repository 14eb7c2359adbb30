"""``lacli doctor``: what is there, what is missing, the command that installs it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from lacli.api import mechanics
from lacli.cli.terminal.console import err, out, print_json

if TYPE_CHECKING:
    from lacli.mechanics.installation import Check as InstallationCheck

_COLOUR = {"ok": "green", "missing": "bold red", "advice": "yellow"}


def command(as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False) -> None:
    """Find FreeFEM, its plugins, BLAS, a compiler and gmsh; say what is missing and what installs it.

    Exit code 1 when something that simulations need is missing.

    Example: lacli doctor
    """
    with err.status("looking around"):
        checks = mechanics.doctor()
    ok = all(check.ok or not check.needed for check in checks)
    if as_json:
        print_json({"ok": ok, "checks": [{**vars(check), "state": check.state} for check in checks]})
    else:
        _show(checks, ok)
    if not ok:
        raise typer.Exit(1)


def _show(checks: Sequence[InstallationCheck], ok: bool) -> None:
    table = Table(header_style="bold")
    table.add_column("what", no_wrap=True)
    table.add_column("state", no_wrap=True)
    table.add_column("found", overflow="fold")
    for check in checks:
        table.add_row(check.name, Text(check.state, _COLOUR[check.state]), check.found)
    out.print(table)
    for check in checks:
        if check.fix:
            out.print(Text.assemble(f"{check.name}: ", (check.fix, "bold")), soft_wrap=True)
    out.print("Ready to simulate." if ok else "Something that simulations need is missing; see above.")
