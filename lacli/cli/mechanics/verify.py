"""``lacli verify``: what the simulator computes beside what is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table
from rich.text import Text

from lacli.api import mechanics
from lacli.cli.terminal.console import one_bar, out, print_json

if TYPE_CHECKING:
    from lacli.verification.problems import Check


def command(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="Which: law, patch, pressure, spring, sphere, beam, ellipsoid, unload, prestrain. Default: all.", metavar="NAME"
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
) -> None:
    """Run the verification problems: computed, reference, error, tolerance.

    Exit code 1 when a check fails. Errors are in mm for positions (beam, apices, unload, prestrain), relative otherwise.

    Example: lacli verify beam ellipsoid
    """
    with one_bar("verify") as show:
        checks = mechanics.verify(names or (), progress=show)
    if as_json:
        print_json([asdict(check) for check in checks])
    else:
        _show(checks)
    if not all(check.passed for check in checks):
        raise typer.Exit(1)


def _show(checks: Sequence[Check]) -> None:
    # a check to a line at 80 columns
    table = Table(title="Verification", title_justify="left", header_style="bold", box=None, padding=(0, 1, 0, 0))
    table.add_column("what", overflow="fold", max_width=34)
    for column in ("computed", "reference", "error", "asked", "", "CPU s"):
        table.add_column(column, justify="right", no_wrap=True)
    before = ""
    for check in checks:
        if check.name != before:
            unknowns = f" ({check.unknowns} unknowns)" if check.unknowns else ""
            table.add_row(Text.assemble((check.name, "bold"), unknowns))
            before = check.name
        numbers = f"{check.computed:.6g}", f"{check.reference:.6g}", f"{check.error:.1e}", f"{check.tolerance:.0e}"
        verdict = Text("ok", "green") if check.passed else Text("FAIL", "bold red")
        table.add_row(f"  {check.quantity}", *numbers, verdict, f"{check.cpu_s:.1f}")
    out.print(table)
    failed = sum(not check.passed for check in checks)
    out.print(f"{len(checks) - failed} of {len(checks)} checks passed." if failed else f"All {len(checks)} checks passed.")
