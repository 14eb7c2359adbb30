"""What the inference commands share: options for tables of runs, and emulators from them or from a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lacli.base.errors import UsageError
from lacli.cli.terminal.console import err, stages

if TYPE_CHECKING:
    from lacli.contracts.tables.table import RunTable
    from lacli.inference.emulation.emulator_set import AnyEmulators

Inputs = Annotated[Path | None, typer.Option("--inputs", help="Table of inputs (CSV or Parquet), one run a row.")]
Outputs = Annotated[
    Path | None, typer.Option("--outputs", help="Table of outputs of the same runs: paired by run_id, else in the same order.")
]
Names = Annotated[list[str] | None, typer.Option("--output", help="Only this output; may be repeated.")]
Emulators = Annotated[
    Path | None, typer.Option("--emulators", help="Emulators written by `lacli emulate`, instead of the tables.")
]
BoxFile = Annotated[Path | None, typer.Option("--box", help="Ranges of the inputs (TOML: [box], name = [lower, upper]).")]
Linear = Annotated[
    list[str] | None,
    typer.Option("--linear", help="Take this input as it is, never its logarithm (its range reaches 0); may be repeated."),
]
Fresh = Annotated[
    bool, typer.Option("--fresh", help="Where --out holds something else, start in a sub-folder of its own (fresh_1, ...).")
]
Retry = Annotated[bool, typer.Option("--retry", help="Try again what the machine has ended three times.")]
Warm = Annotated[
    bool,
    typer.Option(
        "--warm/--cold",
        help="Runs start from the nearest one that has ended, where they tell derivatives (the compiled engine, "
        "unloading by prestrain, no rest_sweeps); else they start cold, and a note says so.",
    ),
]
Workers = Annotated[int | None, typer.Option("--workers", min=1, help="Simulations side by side.")]
Scheduler = Annotated[str | None, typer.Option("--scheduler", help="Address of a Dask scheduler.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of all random numbers.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]


def read(inputs: Path | None, outputs: Path | None, names: list[str] | None) -> RunTable:
    """The table of runs that --inputs and --outputs name; its notes go to standard error."""
    from lacli.contracts.tables.table import read_runs

    if inputs is None or outputs is None:
        raise UsageError("give --inputs and --outputs (tables with a run in each row).")
    with err.status("reading the tables"):
        table = read_runs(inputs, outputs, names)
    for note in table.notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    return table


def fitted(
    inputs: Path | None,
    outputs: Path | None,
    names: list[str] | None,
    emulators: Path | None,
    seed: int,
    box_file: Path | None = None,
) -> tuple[AnyEmulators, RunTable | None]:
    """Emulators from a file, or fitted to the tables (then with the table): for the box of ``box_file``, if given."""
    from lacli.api.inference import fit
    from lacli.inference.emulation.emulator_set import load_emulators
    from lacli.inference.given import box_of_inputs, selected

    if emulators is not None:
        if inputs is not None or outputs is not None:
            raise UsageError("give either --emulators or --inputs and --outputs, not both.")
        loaded = load_emulators(emulators)
        return (selected(loaded, names, emulators) if names else loaded), None
    table = read(inputs, outputs, names)
    box = box_of_inputs(table.inputs, box_file) if box_file else None
    with stages() as show:
        return fit(table, box=box, seed=seed, progress=show), table


def warn(text: str) -> None:
    """A warning on standard error."""
    err.print(f"warning: {text}", highlight=False, soft_wrap=True)
