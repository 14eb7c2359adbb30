"""Tables of runs: named inputs and outputs of any simulator, checked, with failures kept and counted."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import TableError, UsageError
from lacli.contracts.failures import MACHINE

STATUS = "status"
OK_STATUS = {"ok", "done", "success", "converged", "true", "1"}
ERROR_SUFFIX = "_discretisation_error"
_PARQUET = (".parquet", ".pq")
# before 3.1, pandas does not read every float's digits back to the same float on its own; since then the wish is deprecated
_EXACT: dict[str, Any] = {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}
# bookkeeping columns that are neither inputs nor outputs
IGNORED = {STATUS, "run", "run_id", "id", "key", "failure", "kind", "cpu_s", "wall_s", "wave", "Unnamed: 0"}
IGNORED |= {"attempts", "message", "peak_memory_mb"}


@dataclass(frozen=True)
class RunTable:
    """Finished runs, and the places where runs failed.

    x (n, d) inputs, y (n, p) outputs in the columns' own units; error_sd (n, p) each run's discretisation error
    (one standard deviation, 0 where unknown); failed_x (f, d) inputs of failed runs; notes: what was done to the
    table, in words for the user.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    x: FloatArray
    y: FloatArray
    error_sd: FloatArray
    failed_x: FloatArray
    notes: tuple[str, ...] = field(default=())

    @property
    def runs(self) -> int:
        """Number of finished runs."""
        return len(self.x)

    def select(self, outputs: Sequence[str]) -> RunTable:
        """The same runs with only the named outputs, in that order."""
        missing = [name for name in outputs if name not in self.outputs]
        if missing:
            raise UsageError(f"no output {_list(missing)} in the table; it has {_list(self.outputs)}.")
        j = [self.outputs.index(name) for name in outputs]
        return RunTable(self.inputs, tuple(outputs), self.x, self.y[:, j], self.error_sd[:, j], self.failed_x, self.notes)


def _list(names: Sequence[str]) -> str:
    return ", ".join(str(name) for name in names)


def read_frame(path: Path) -> pd.DataFrame:
    """Read a CSV or Parquet table.

    Raises TableError if the file is missing, empty or not a table with unique column names.
    """
    path = Path(path)
    if not path.is_file():
        raise TableError(f"{path}: no such table. Give a .csv or .parquet file with one run a row.")
    try:
        if path.suffix.lower() in _PARQUET:
            frame = pd.read_parquet(path)
        else:
            with warnings.catch_warnings():  # cells beyond the header's would be dropped, or else taken as names of the rows
                warnings.simplefilter("error", pd.errors.ParserWarning)
                frame = pd.read_csv(path, skipinitialspace=True, index_col=False, **_EXACT)
    except pd.errors.ParserWarning as error:
        raise TableError(
            f"{path}: the rows have more cells than the header line. Separate columns by commas, write decimals with points."
        ) from error
    except Exception as error:
        raise TableError(f"{path}: cannot be read as a table ({error}). Use CSV with a header line, or Parquet.") from error
    frame.columns = [str(name).strip() for name in frame.columns]
    if frame.empty or frame.shape[1] == 0:
        raise TableError(f"{path}: the table is empty. It needs a header line and one run a row.")
    twice = frame.columns[frame.columns.duplicated()].tolist()
    twice += [name for name in frame.columns if name.endswith(".1") and name[:-2] in frame.columns]
    if twice:
        raise TableError(f"{path}: column {_list(twice)} occurs twice. Rename or remove one.")
    headings = [name for name in frame.columns if _is_number(name)]
    if len(headings) == len(frame.columns):
        raise TableError(f"{path}: the first line holds numbers, not column names. Add a header line with names and units.")
    return frame


def finished(frame: pd.DataFrame) -> BoolArray:
    """Whether each row (n,) is marked as a run that ended well; all are where there is no status."""
    if STATUS not in frame.columns:
        return np.ones(len(frame), bool)
    return np.asarray(frame[STATUS].astype(str).str.strip().str.lower().isin(OK_STATUS), bool)


def ended_by_machine(frame: pd.DataFrame) -> BoolArray:
    """Whether each row (n,) is a run that the machine ended (killed, out_of_memory, ...): it has no result."""
    lost = np.zeros(len(frame), bool)
    for name in (STATUS, "kind", "failure"):
        if name in frame.columns:
            lost |= frame[name].astype(str).str.strip().str.lower().isin(list(MACHINE)).to_numpy(bool)
    return lost & ~finished(frame) if STATUS in frame.columns else lost


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(frame: pd.DataFrame, what: str) -> pd.DataFrame:
    """The frame as floats; text in a cell is an error that names the cell."""
    columns = {}
    for name in frame.columns:
        values = pd.to_numeric(frame[name], errors="coerce")
        bad = (
            values.isna() & frame[name].notna() & ~frame[name].astype(str).str.strip().str.lower().isin(["nan", "", "na", "none"])
        )
        if bad.any():
            row = int(np.flatnonzero(bad.to_numpy())[0])
            raise TableError(f"{what}: column {name}, row {row + 1} holds {frame[name].iloc[row]!r}, which is not a number.")
        columns[name] = values.astype(float)
    return pd.DataFrame(columns)


def input_values(frame: pd.DataFrame, where: str) -> FloatArray:
    """The inputs of runs as numbers (n, d). Raises TableError that names the cell that holds no finite one."""
    x = _numbers(frame, f"{where}: inputs").to_numpy(float)
    bad = np.argwhere(~np.isfinite(x))
    if len(bad):
        row, column = bad[0]
        raise TableError(
            f"{where}: input {frame.columns[column]} has no finite value in row {row + 1}"
            f" ({len(bad)} such cells). Fill it in or remove the run."
        )
    return x


def combine(
    inputs: pd.DataFrame,
    outputs: pd.DataFrame,
    *,
    output_names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
    where: str = "table",
) -> RunTable:
    """Check two frames with a row for each run and make a RunTable of them.

    A row fails if its ``status`` (in either frame) is not ok, or an output is missing or not finite: failures are
    kept as places where the simulator fails. Columns that never vary are set aside with a note; a row that repeats
    another in inputs and outputs is dropped with a note.

    Raises TableError for a missing input value, unequal lengths, names not found, or too few finished runs.
    """
    notes: list[str] = []
    if len(inputs) != len(outputs):
        raise TableError(f"{where}: {len(inputs)} rows of inputs but {len(outputs)} rows of outputs; each run needs one of each.")
    lost_rows = ended_by_machine(inputs) | ended_by_machine(outputs)
    if lost_rows.any():
        notes.append(
            f"{int(lost_rows.sum())} run(s) that the machine ended ({_list(list(MACHINE))}) are left out: they are no results."
        )
        inputs, outputs = inputs[~lost_rows], outputs[~lost_rows]
    status_ok = finished(inputs) & finished(outputs)
    x_frame = inputs[_named(inputs, input_names, f"{where}: input")]
    x = input_values(x_frame, where)
    y_frame = _numbers(outputs[_named(outputs, output_names, f"{where}: output")], f"{where}: outputs")
    shared = [name for name in y_frame.columns if name in x_frame.columns]
    if shared:
        raise TableError(f"{where}: {_list(shared)} is both an input and an output; name the outputs wanted.")
    y = y_frame.to_numpy(float)
    finite = np.isfinite(y).all(1)
    if (lost := int((status_ok & ~finite).sum())) > 0:
        notes.append(f"{lost} run(s) without a finite value for every output are counted as failed.")
    if (lost := int((~status_ok).sum())) > 0:
        notes.append(f"{lost} run(s) are marked as failed; the emulators are trained on the others.")
    ok = status_ok & finite
    error = np.zeros_like(y)
    for j, name in enumerate(y_frame.columns):
        if (column_name := name + ERROR_SUFFIX) in outputs.columns:
            values = pd.to_numeric(outputs[column_name], errors="coerce").to_numpy(float)
            error[:, j] = np.where(np.isfinite(values), np.abs(values), 0.0)
    failed_x, x, y, error = x[~ok], x[ok], y[ok], error[ok]
    if len(x):
        _, first = np.unique(np.hstack([x, y]), axis=0, return_index=True)
        if len(first) < len(x):
            notes.append(f"{len(x) - len(first)} repeated run(s) (same inputs, same outputs) are used once.")
            keep = np.sort(first)
            x, y, error = x[keep], y[keep], error[keep]
    names_x, names_y = list(x_frame.columns), list(y_frame.columns)
    if len(x):
        moving = np.ptp(x, axis=0) > 1e-12 * np.maximum(1e-300, np.abs(x).max(0))
        if not moving.all():
            notes.append(
                f"input {_list([n for n, m in zip(names_x, moving, strict=True) if not m])} never varies and is left out."
            )
            x, failed_x = x[:, moving], failed_x[:, moving]
            names_x = [n for n, m in zip(names_x, moving, strict=True) if m]
        varying = np.ptp(y, axis=0) > 1e-12 * np.maximum(1e-300, np.abs(y).max(0))
        if not varying.all():
            notes.append(
                f"output {_list([n for n, m in zip(names_y, varying, strict=True) if not m])} never varies and is left out."
            )
            y, error = y[:, varying], error[:, varying]
            names_y = [n for n, m in zip(names_y, varying, strict=True) if m]
        if not names_x or not names_y:
            raise TableError(
                f"{where}: {'no input' if not names_x else 'no output'} varies between the runs; there is nothing to learn."
            )
    needed = fewest_runs(len(names_x))
    if len(x) < needed:
        raise TableError(
            f"{where}: {len(x)} finished runs for {len(names_x)} inputs ({len(failed_x)} failed); at least {needed} are needed"
            " for a linear mean with cross-validation. Add runs with `lacli design`."
        )
    return RunTable(tuple(names_x), tuple(names_y), x, y, error, failed_x, tuple(notes))


def fewest_runs(d: int) -> int:
    """Runs without which a linear mean in d inputs cannot be cross-validated in five folds."""
    return int(np.ceil((d + 4) / 0.8))


def _named(frame: pd.DataFrame, names: Sequence[str] | None, what: str) -> list[str]:
    if names is None:
        return [name for name in frame.columns if name not in IGNORED and not name.endswith(ERROR_SUFFIX)]
    missing = [name for name in names if name not in frame.columns]
    if missing:
        raise TableError(f"{what} {_list(missing)} is not a column; the columns are {_list(list(frame.columns))}.")
    return list(names)


def read_runs(inputs: Path, outputs: Path, output_names: Sequence[str] | None = None) -> RunTable:
    """Read and check a table of inputs and a table of outputs with a row for each run, in the same order.

    Raises TableError as ``combine`` and ``read_frame`` do.
    """
    return combine(read_frame(inputs), read_frame(outputs), output_names=output_names, where=f"{inputs} and {outputs}")


def read_one(path: Path, input_names: Sequence[str], output_names: Sequence[str]) -> RunTable:
    """Read one table that holds inputs and outputs side by side (as ``lacli design --run`` and ``calibrate`` write)."""
    frame = read_frame(path)
    return combine(frame, frame, input_names=input_names, output_names=output_names, where=str(path))
