"""``lacli validate``: a simulation, at the MAP for example, against the tracked motion, frame by frame."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lacli.api import validation as api
from lacli.cli.terminal.console import err, out, print_json, print_table
from lacli.cli.terminal.tables import Json

if TYPE_CHECKING:
    import pandas as pd

    from lacli.motion.check.validation import Validation


def command(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a simulation whose steps reach over the frames.")],
    motion: Annotated[Path, typer.Option("--motion", help="Folder of lacli track.")],
    targets: Annotated[
        Path | None, typer.Option(help="The targets that were calibrated to (TOML). Default: those of the motion's folder.")
    ] = None,
    folder: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for validation.csv, validation_kinds.csv, validation.png.")
    ] = Path("validation"),
    as_json: Json = False,
) -> None:
    """Simulated against tracked motion: root mean square difference by frame, those not used for the calibration apart.

    Displacements in mm, volumes in mL as change from end-diastole, strains without unit; in_sd is the difference over the
    standard deviation of the tracked motion. A run over the whole cycle needs frames and conduit in [outputs] of its scene.

    Example: lacli validate runs/4f1d9a --motion motion --targets calibration/targets.toml
    """
    found = api.validate(run, motion, targets=targets, out=folder)
    if as_json:
        print_json({"folder": str(folder), **document(found)})
        return
    frames, kinds = found.by_frame(), found.by_kind()
    print_table("RMS difference by frame", ["time", "used", *map(str, frames.columns[2:])], _rows(frames))
    print_table("RMS difference by kind of feature", ["kind", "unit", "used frames", "other frames"],
                [row[:4] for row in _rows(kinds)])  # fmt: skip
    if found.left_out:
        err.print(f"note: {found.left_out} tracked frames lie beyond the simulated part of the cycle.", highlight=False)
    if not found.used.any():
        err.print("note: no target stands at a simulated frame: none of it was used for a calibration.", highlight=False)
    out.print(f"written: {folder} (validation.csv, validation_kinds.csv, validation.png)", highlight=False, soft_wrap=True)


def document(found: Validation) -> dict[str, Any]:
    """Both tables as lists of rows, and how many tracked frames were beyond the simulation; null where there is no value."""
    return {
        "frames": [_plain(row) for row in found.by_frame().to_dict("records")],
        "kinds": [_plain(row) for row in found.by_kind().to_dict("records")],
        "frames_left_out": found.left_out,
    }


def _plain(row: dict[Any, Any]) -> dict[str, Any]:
    return {str(k): None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def _rows(table: pd.DataFrame) -> list[list[Any]]:
    return [["yes" if v is True else "no" if v is False else v for v in row] for row in table.astype(object).to_numpy().tolist()]
