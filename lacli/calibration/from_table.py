"""Calibration on runs done elsewhere: one table of their inputs and outputs, and the targets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from lacli.base.errors import UsageError
from lacli.base.processes.locks import working_on
from lacli.calibration.calibration import Calibration, Monitor, Settings, calibrate, calibration_identity, given_runs, obstacle
from lacli.contracts.features import parse
from lacli.contracts.identity import settle
from lacli.contracts.tables.columns import derivative_of, error_of
from lacli.contracts.tables.file import listed
from lacli.contracts.tables.table import input_values, is_bookkeeping, read_frame
from lacli.contracts.targets import Targets
from lacli.inference.box import RANGES, Box, table_box
from lacli.inference.runs import RunLog


def calibrate_table(
    path: Path, targets: Targets, box: Box | None, settings: Settings, folder: Path, fresh: bool, monitor: Monitor
) -> tuple[Path, Calibration]:
    """The folder of the calibration of a table, and the calibration: one wave, then the posterior; nothing is run.

    box None: published ranges of the inputs that have one, else the table's ranges of all its inputs that vary; what varies
    and is in no box is named in the first wave's notes. fresh: as ``settle``. Raises UsageError for a column that is missing,
    TableError for an input that is no number.
    """
    frame = read_frame(path)
    if box is None:
        box = _box_of(path, frame, targets)
    missing = [n for n in (*box.names, *targets.names) if n not in frame.columns]
    if missing:
        raise UsageError(f"{path}: no column {', '.join(missing)}; the columns are {', '.join(frame.columns)}.")
    said = _uncounted(path, frame, box, targets)
    log = RunLog(path, box.names, targets.names, None)
    given = frame[list(box.names)].to_numpy(float)
    _, first = np.unique(given, axis=0, return_index=True)
    given = given[np.sort(first)]
    identity = calibration_identity(box, targets, settings, given_runs(log, given, targets))
    folder = settle(folder, lambda place: obstacle(place, identity), fresh)
    with working_on(folder):
        return folder, calibrate(None, box, targets, settings, folder, log, given=given, said=said, monitor=monitor)


def _box_of(path: Path, frame: pd.DataFrame, targets: Targets) -> Box:
    others = _others(frame, targets)
    names = [n for n in others if n in RANGES] or others
    x = input_values(frame[names], f"--from-table {path}")
    still = np.ptp(x, axis=0) == 0
    return table_box([n for n, s in zip(names, still, strict=True) if not s], x[:, ~still])


def _others(frame: pd.DataFrame, targets: Targets) -> list[str]:
    """The columns that may be inputs: neither targets, nor bookkeeping, errors or derivatives of others."""
    columns = list(map(str, frame.columns))
    others = [n for n in columns if n not in targets.names and not is_bookkeeping(n)]
    return [n for n in others if error_of(n, columns) is None and derivative_of(n, columns) is None]


def _uncounted(path: Path, frame: pd.DataFrame, box: Box, targets: Targets) -> list[str]:
    """What is to be told of columns that vary, and of which it is not known that they are outputs, but are no inputs here."""
    found = [n for n in _others(frame, targets) if n not in box.names and not _is_feature(n) and frame[n].nunique() > 1]
    if not found:
        return []
    return [
        f"{path}: {listed(found)} {'varies' if len(found) == 1 else 'vary'} between the runs without being an input here: what"
        " the targets owe to it is taken for the emulators' own error. Give a box that names all inputs."
    ]


def _is_feature(name: str) -> bool:
    try:
        parse(name)
    except ValueError:
        return False
    return True
