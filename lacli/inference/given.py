"""Emulators and boxes as a user's files give them: checked against one another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lacli.base.arrays import BoolArray
from lacli.base.errors import UsageError
from lacli.contracts.tables.table import RunTable
from lacli.inference.box import Box, make_box, read_box, table_box
from lacli.inference.emulation.emulator_set import AnyEmulators
from lacli.inference.emulation.scales import may_be_logarithmic


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
    check_logarithms(emulators, box, file)
    return box


def check_logarithms(emulators: AnyEmulators, box: Box, file: Path | None = None) -> None:
    """Raises UsageError where the box (d), in the emulators' order, reaches where one of them is not defined: an input whose
    logarithm it takes, at 0 or below. file: the box's, where it is of one."""
    for name, takes_log, start in zip(emulators.inputs, emulators.log_share > 0, box.lower, strict=True):
        if takes_log and start <= 0:
            raise UsageError(
                f"{file or 'the box'}: {name} starts at {start:g}; an emulator takes its logarithm: it must be positive. Or fit"
                f" the emulators for this box: `lacli emulate --box {file or 'FILE'}` (or --linear {name})."
            )


def logarithmic(table: RunTable, box: Box | None, linear: Sequence[str] = ()) -> BoolArray:
    """Inputs that may be taken as logarithms (d,): positive in the runs and in the box, and not named ``linear``.

    Raises UsageError for a name that is no input, and for a box of other inputs.
    """
    unknown = [name for name in linear if name not in table.inputs]
    if unknown:
        raise UsageError(f"--linear {', '.join(unknown)}: no input of the table; its inputs are {', '.join(table.inputs)}.")
    found: BoolArray = may_be_logarithmic(table.x)
    if box is not None:
        if box.names != table.inputs:
            raise UsageError(f"emulate: the box must hold exactly the inputs {', '.join(table.inputs)}, in this order.")
        found = found & may_be_logarithmic(np.vstack([table.x, box.lower, box.upper]))
    found &= np.array([name not in linear for name in table.inputs])
    return found
