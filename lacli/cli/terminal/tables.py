"""What the inference commands share: options for tables of runs, and emulators from them or from a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lacli.base.errors import UsageError
from lacli.cli.terminal.console import err, progress

if TYPE_CHECKING:
    from lacli.base.arrays import FloatArray
    from lacli.contracts.tables.table import RunTable
    from lacli.inference.box import Box
    from lacli.inference.emulation.emulator_set import EmulatorSet

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
) -> tuple[EmulatorSet, RunTable | None]:
    """Emulators from a file, or fitted to the tables (then with the table): for the box of ``box_file``, if given."""
    from lacli.api.inference import logarithmic
    from lacli.inference.emulation.emulator import fit_emulators
    from lacli.inference.emulation.emulator_set import EmulatorSet, load_emulators

    if emulators is not None:
        if inputs is not None or outputs is not None:
            raise UsageError("give either --emulators or --inputs and --outputs, not both.")
        loaded = load_emulators(emulators)
        return (selected(loaded, names, emulators) if names else loaded), None
    table = read(inputs, outputs, names)
    may_log = logarithmic(table, box_of_inputs(table.inputs, box_file) if box_file else None, ())
    with progress() as bar:
        task = bar.add_task("emulators", total=len(table.outputs))
        result = fit_emulators(table, seed=seed, tick=lambda: bar.advance(task), may_log=may_log)
    return EmulatorSet(table.inputs, tuple(result)), table


def selected(emulators: EmulatorSet, names: Sequence[str], file: Path) -> EmulatorSet:
    """The emulators of the named outputs, in that order. Raises UsageError where ``file`` has none of one."""
    missing = [name for name in names if name not in emulators.outputs]
    if missing:
        raise UsageError(f"{file}: no emulator of {', '.join(missing)}; there are {', '.join(emulators.outputs)}.")
    return emulators.select(names)


def box_of_inputs(names: Sequence[str], file: Path) -> Box:
    """The box in the file, its inputs in this order. Raises UsageError where they are others."""
    from lacli.inference.box import make_box, read_box

    box = read_box(file)
    if set(names) != set(box.names):
        raise UsageError(f"{file}: must hold exactly the inputs {', '.join(names)}.")
    order = [box.names.index(name) for name in names]
    return make_box(names, box.lower[order].tolist(), box.upper[order].tolist())


def box_of(emulators: EmulatorSet, file: Path | None, table: RunTable | None = None) -> Box:
    """The box of the inputs: the file's, else published ranges of known inputs and the runs' ranges of others.

    Raises UsageError where the file's inputs are not the emulators', or reach where an emulator is not defined.
    """
    import numpy as np

    from lacli.inference.box import table_box

    low, high = emulators.range()
    if file is None:
        return table_box(emulators.inputs, table.x if table is not None else np.vstack([low, high]))
    box = box_of_inputs(emulators.inputs, file)
    logged = np.any([e.log_inputs for e in emulators.emulators], axis=0)
    for name, takes_log, start in zip(emulators.inputs, logged, box.lower, strict=True):
        if takes_log and start <= 0:
            raise UsageError(
                f"{file}: {name} starts at {start:g}; an emulator takes its logarithm: it must be positive. Or fit the emulators"
                f" for this box: `lacli emulate --box {file}` (or --linear {name})."
            )
    return box


def covered(box: Box, runs: FloatArray, points: FloatArray | None = None) -> float:
    """The share of the box (or of points of it) where no run has been, said on standard error; refused where it is nearly all."""
    from lacli.inference.sampling.coverage import check_coverage

    found = check_coverage(box, runs, points)
    if words := found.words():
        warn(words)
    return found.share


def warn(text: str) -> None:
    """A warning on standard error."""
    err.print(f"warning: {text}", highlight=False, soft_wrap=True)
