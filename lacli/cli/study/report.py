"""``lacli report``: one HTML page on a run or a patient."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.api import study
from lacli.cli.terminal.console import err, out, print_json
from lacli.cli.terminal.tables import Json


def command(
    folder: Annotated[Path, typer.Argument(help="A run (RUNS/<key> of simulate) or a patient (--out of calibrate).")],
    page: Annotated[Path, typer.Option("--out", help="The page, an .html file.")] = Path("report.html"),
    figures: Annotated[Path | None, typer.Option(help="Folder of the figures as PDF and SVG (default: beside the page).")] = None,
    run: Annotated[
        Path | None,
        typer.Option(help="Of a patient: a simulation that kept its fields, for 3D and transients."),
    ] = None,
    as_json: Json = False,
) -> None:
    """One HTML page on a run or a patient, with 3D, figures, errors and a methods paragraph; it opens without a network.

    Example: lacli report runs/64012adb19dec2ff --out run.html
    """
    with err.status("drawing"):
        made = study.write_report(folder, page, figures=figures, run=run)
    if as_json:
        print_json({"kind": made.kind, "page": made.page, "bytes": made.size, "figures": made.figures})
        return
    out.print(f"{made.page}: {made.size / 1e6:.1f} MB; figures as PDF and SVG in {made.figures}", highlight=False, soft_wrap=True)
