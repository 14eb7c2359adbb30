"""Emulators and boxes as a user's files give them: checked against one another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lacli.base.errors import UsageError
from lacli.contracts.tables.table import RunTable
from lacli.inference.box import Box, make_box, read_box, table_box
from lacli.inference.emulation.emulator_set import AnyEmulators


def selected(emulators: AnyEmulators, names: Sequence[str], file: Path) -> AnyEmulators:
    """The emulators of the named outputs, in that order. Raises UsageError where ``file`` has none of one."""
    missing = [name for name in names if name not in emulators.outputs]
    if missing:
        raise UsageError(f"{file}: no emulator of {', '.join(missing)}; there are {', '.join(emulators.outputs)}.")
    return emulators.select(names)


def box_of_inputs(names: Sequence[str], file: Path) -> Box:
    """The box in the file, its inputs in this order. Raises UsageError where they are others."""
    box = read_box(file)
    if set(names) != set(box.names):
        raise UsageError(f"{file}: must hold exactly the inputs {', '.join(names)}.")
    order = [box.names.index(name) for name in names]
    return make_box(names, box.lower[order].tolist(), box.upper[order].tolist())


def box_of(emulators: AnyEmulators, file: Path | None, table: RunTable | None = None) -> Box:
    """The box of the inputs: the file's, else published ranges of known inputs and the runs' ranges of others.

    Raises UsageError where the file's inputs are not the emulators', or reach where an emulator is not defined.
    """
    low, high = emulators.range()
    if file is None:
        return table_box(emulators.inputs, table.x if table is not None else np.vstack([low, high]))
    box = box_of_inputs(emulators.inputs, file)
    logged = emulators.log_share > 0
    for name, takes_log, start in zip(emulators.inputs, logged, box.lower, strict=True):
        if takes_log and start <= 0:
            raise UsageError(
                f"{file}: {name} starts at {start:g}; an emulator takes its logarithm: it must be positive. Or fit the emulators"
                f" for this box: `lacli emulate --box {file}` (or --linear {name})."
            )
    return box
