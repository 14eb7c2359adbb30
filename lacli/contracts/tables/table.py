"""Tables of runs: named inputs and outputs of any simulator, checked, with failures kept and counted."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import TableError, UsageError
from lacli.contracts.tables import checks
from lacli.contracts.tables.absent import check_column
from lacli.contracts.tables.columns import (
    ERROR_SUFFIX,
    SPREAD_SUFFIX,
    STATUS,
    derivative_of,
    error_of,
    input_values,
    is_bookkeeping,
    is_label,
    numbers,
    run_states,
)
from lacli.contracts.tables.file import listed, read_frame
from lacli.contracts.tables.gradients import check_gradients, read_gradients
from lacli.contracts.tables.pairing import check_shared_columns, pair

__all__ = [
    "ERROR_SUFFIX",
    "SPREAD_SUFFIX",
    "STATUS",
    "RunTable",
    "combine",
    "fewest_runs",
    "input_values",
    "is_bookkeeping",
    "read_frame",
]
# an emulator's fit takes time as the cube of the runs, memory as the square: 2,000 take minutes and 0.2 GB an output
MOST_RUNS = 2_000
_THINNING_SEED = 0


@dataclass(frozen=True)
class RunTable:
    """Finished runs, and the places where runs failed.

    x (n, d) inputs, y (n, p) outputs in the columns' own units; error_sd (n, p) each run's discretisation error
    (one standard deviation, 0 where unknown); failed_x (f, d) inputs of failed runs; notes: what was done to the
    table, in words for the user; gradients (n, d, p): derivatives of the outputs by the inputs, in the output's unit over
    the input's, NaN where unknown; None where none are known.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    x: FloatArray
    y: FloatArray
    error_sd: FloatArray
    failed_x: FloatArray
    notes: tuple[str, ...] = field(default=())
    gradients: FloatArray | None = None

    @property
    def runs(self) -> int:
        """Number of finished runs."""
        return len(self.x)

    def rows(self, which: IntArray) -> RunTable:
        """Some of the finished runs, in that order."""
        gradients = None if self.gradients is None else self.gradients[which]
        return replace(self, x=self.x[which], y=self.y[which], error_sd=self.error_sd[which], gradients=gradients)

    def select(self, outputs: Sequence[str]) -> RunTable:
        """The same runs with only the named outputs, in that order."""
        missing = [name for name in outputs if name not in self.outputs]
        if missing:
            raise UsageError(f"no output {listed(missing)} in the table; it has {listed(self.outputs)}.")
        j = [self.outputs.index(name) for name in outputs]
        gradients = None if self.gradients is None else self.gradients[:, :, j]
        return RunTable(
            self.inputs, tuple(outputs), self.x, self.y[:, j], self.error_sd[:, j], self.failed_x, self.notes, gradients
        )


def combine(
    inputs: pd.DataFrame,
    outputs: pd.DataFrame,
    *,
    output_names: Sequence[str] | None = None,
    input_names: Sequence[str] | None = None,
    where: str = "table",
    most: int = MOST_RUNS,
) -> RunTable:
    """Check two frames with a row for each run and make a RunTable of them.

    Rows are paired by a label that both frames have (``table_pairing``). A run fails if its ``status`` (in either frame)
    says so, or an output is missing, not finite, or a mark of failure (1e20 where others are near 1): failures are kept as
    places where the simulator fails. Runs that never finished are left out. Columns that never vary are set aside with a
    note; a run that repeats another in inputs and outputs is used once, one that contradicts another is used and noted; of
    more than ``most`` runs, that many are drawn at random (the same every time). ``<output>_error`` or ``_sd`` beside an
    output is its error, ``d<output>/d<input>`` its derivative, checked against differences between the runs.

    Raises TableError for a missing input value, rows that do not pair, words of status that are not known, names not
    found, columns of no numbers, inputs that depend on each other, or too few finished runs.
    """
    notes: list[str] = []
    if inputs is not outputs:
        inputs, outputs, notes = pair(inputs, outputs, where)
    done = np.ones(len(inputs), bool)
    failed = np.zeros(len(inputs), bool)
    for frame in (inputs,) if inputs is outputs else (inputs, outputs):
        if (states := run_states(frame, where)) is not None:
            done &= states[0]
            failed |= states[1]
    x_frame = inputs[_inputs(inputs, input_names, set(outputs.columns), where, notes)]
    x = input_values(x_frame, where, notes.append)
    names = _outputs(outputs, output_names, list(x_frame.columns), where, notes)
    y_frame = numbers(outputs[names], f"{where}: outputs")
    shared = [name for name in y_frame.columns if name in x_frame.columns]
    if shared:
        raise TableError(f"{where}: {listed(shared)} is both an input and an output; name the outputs wanted.")
    check_shared_columns(inputs, outputs, where)
    y = y_frame.to_numpy(float)
    error = _errors(outputs, names, where, notes)
    gradients = read_gradients(outputs, names, list(x_frame.columns), where)
    ok = _finished(y, done, failed, names, notes)
    failed_x, rows = x[~ok & (done | failed)], np.flatnonzero(ok)
    checks.check_sizes(list(x_frame.columns), x, f"{where}: input")
    checks.check_sizes(names, y[rows], f"{where}: output")
    rows = _thinned(_once(x, y, rows, notes), most, notes)
    x, y, error = x[rows], y[rows], error[rows]
    gradients = None if gradients is None else gradients[rows]
    names_x = list(x_frame.columns)
    if len(x):
        moving = _varying("input", names_x, x, notes)
        x, failed_x, names_x = x[:, moving], failed_x[:, moving], [names_x[j] for j in moving]
        varying = _varying("output", names, y, notes)
        y, error, names = y[:, varying], error[:, varying], [names[j] for j in varying]
        gradients = None if gradients is None else gradients[:, moving][:, :, varying]
        if not names_x or not names:
            raise TableError(
                f"{where}: {'no input' if not names_x else 'no output'} varies between the runs; there is nothing to learn."
            )
    needed = fewest_runs(len(names_x))
    if len(x) < needed:
        raise TableError(
            f"{where}: {len(x)} finished runs for {len(names_x)} inputs ({len(failed_x)} failed); at least {needed} are needed"
            " for a linear mean with cross-validation. Add runs with `lacli design`."
        )
    checks.check_inputs(names_x, x, where, notes)
    if gradients is not None:
        gradients = _known_gradients(gradients, notes)
    if gradients is not None:
        check_gradients(x, y, gradients, names_x, names, where)
    return RunTable(tuple(names_x), tuple(names), x, y, error, failed_x, tuple(notes), gradients)


def _known_gradients(gradients: FloatArray, notes: list[str]) -> FloatArray | None:
    """The gradients (n, d, p), None where not one is known; runs that tell none are noted."""
    known = np.isfinite(gradients).any((1, 2))
    if not known.any():
        notes.append("the columns of derivatives are empty in every run that is used.")
        return None
    if not known.all():
        notes.append(f"{int((~known).sum())} run(s) tell no derivatives; their values are used.")
    return gradients


def fewest_runs(d: int) -> int:
    """Runs without which a linear mean in d inputs cannot be cross-validated in five folds."""
    return int(np.ceil((d + 4) / 0.8))


def _inputs(
    frame: pd.DataFrame, names: Sequence[str] | None, outputs: Collection[str], where: str, notes: list[str]
) -> list[str]:
    if names is not None:
        return _named(frame, names, f"{where}: input")
    _say_labels(frame, "input", notes)
    if strays := [name for name in frame.columns if derivative_of(name, outputs)]:
        raise TableError(f"{where}: {listed(strays, 3)} among the inputs: derivatives belong beside the outputs, in their table.")
    return [name for name in frame.columns if not is_bookkeeping(name)]


def _outputs(frame: pd.DataFrame, names: Sequence[str] | None, inputs: Sequence[str], where: str, notes: list[str]) -> list[str]:
    """The columns that are outputs: neither labels, nor errors or derivatives of others.

    Raises TableError for a derivative by what is no input, or of what is no output.
    """
    columns = [name for name in frame.columns if not is_bookkeeping(name)]
    there = set(columns)
    derivatives = {name: parts for name in columns if (parts := derivative_of(name, there)) is not None}
    for name, (_, given) in derivatives.items():
        if given not in inputs and given not in there:
            raise TableError(f"{where}: {name} is a derivative by {given}, which is no input; the inputs are {listed(inputs)}.")
    if lost := [name for name in columns if name not in derivatives and _by_an_input(name, inputs)]:
        raise TableError(f"{where}: {listed(lost, 3)}: a derivative of what is no output of the table. Correct or remove it.")
    if names is not None:
        return _named(frame, names, f"{where}: output")
    _say_labels(frame, "output", notes)
    return [name for name in columns if error_of(name, columns) is None and name not in derivatives]


def _by_an_input(name: str, inputs: Sequence[str]) -> bool:
    """Whether a column's name is that of a derivative by one of the inputs."""
    return any(name.startswith("d") and name.endswith(f"/d{given}") for given in inputs)


def _named(frame: pd.DataFrame, names: Sequence[str], what: str) -> list[str]:
    missing = [name for name in names if name not in frame.columns]
    if missing:
        raise TableError(f"{what} {listed(missing)} is not a column; the columns are {listed(list(frame.columns))}.")
    return list(dict.fromkeys(names))


def _say_labels(frame: pd.DataFrame, what: str, notes: list[str]) -> None:
    # run_id, run, id and key are no one's inputs; the others might be
    doubtful = [n for n in frame.columns if is_label(n) and n.lower() not in ("run_id", "run", "id", "key")]
    doubtful = [n for n in doubtful if not n.startswith("Unnamed") and frame[n].notna().any()]
    if doubtful:
        notes.append(f"column {listed(doubtful)} is taken as a label of the runs, not as an {what}; rename it if it is one.")


def _errors(frame: pd.DataFrame, names: Sequence[str], where: str, notes: list[str]) -> FloatArray:
    """Each run's own error (n, p), one standard deviation; 0 where none is told."""
    found = np.zeros((len(frame), len(names)))
    # one output's own column cannot be another's error: f and f_sd both named are two outputs
    columns = {name: output for name in frame.columns if name not in names and (output := error_of(name, names))}
    twice = next((o for o in columns.values() if list(columns.values()).count(o) > 1), None)
    if twice is not None:
        raise TableError(
            f"{where}: the error of {twice} is told twice ({listed([c for c, o in columns.items() if o == twice])})."
        )
    for name, output in columns.items():
        values = numbers(frame[[name]], f"{where}: errors")[name].to_numpy(float)
        known = np.isfinite(values)
        checks.check_sizes([name], values[:, None], f"{where}: error")
        check_column(name, values, f"{where}: error", "Correct it, or leave the cell empty.", notes.append)
        if (values[known] < 0).any():
            row = int(np.flatnonzero(known & (values < 0))[0])
            raise TableError(f"{where}: {name}, row {row + 1} holds a negative standard deviation of {output}. Correct it.")
        found[:, names.index(output)] = np.where(known, values, 0.0)
        missing = "" if known.all() else f"; {int((~known).sum())} run(s) tell none, which counts as 0"
        if not name.endswith(ERROR_SUFFIX) or missing:
            notes.append(f"{name} is read as the error of {output}, one standard deviation{missing}.")
    return found


def _finished(y: FloatArray, done: np.ndarray, failed: np.ndarray, names: Sequence[str], notes: list[str]) -> np.ndarray:
    """Whether each run (n,) gave a value for every output; what the others are is noted."""
    finite = np.isfinite(y).all(1)
    ok = done & ~failed & finite
    if (lost := int((done & ~failed & ~finite).sum())) > 0:
        notes.append(f"{lost} run(s) without a finite value for every output are counted as failed.")
    if (lost := int(failed.sum())) > 0:
        notes.append(f"{lost} run(s) are marked as failed; the emulators are trained on the others.")
    if (lost := int((~done & ~failed).sum())) > 0:
        notes.append(f"{lost} run(s) never finished (status); they are left out, and not counted as failed.")
    rows = np.flatnonzero(ok)
    stray = checks.stray_outputs(names, y[rows], rows.tolist(), notes)
    if stray.any():
        ok = ok.copy()
        ok[rows[stray]] = False
    return ok


def _once(x: FloatArray, y: FloatArray, rows: np.ndarray, notes: list[str]) -> np.ndarray:
    if not len(rows):
        return rows
    _, first = np.unique(np.hstack([x[rows], y[rows]]), axis=0, return_index=True)
    if len(first) < len(rows):
        notes.append(f"{len(rows) - len(first)} repeated run(s) (same inputs, same outputs) are used once.")
    if (other := len(first) - len(np.unique(x[rows], axis=0))) > 0:
        notes.append(f"{other} run(s) have the inputs of another and other outputs: all are used, how they differ as noise.")
    return rows[np.sort(first)]


def _thinned(rows: np.ndarray, most: int, notes: list[str]) -> np.ndarray:
    if len(rows) <= most:
        return rows
    notes.append(
        f"{most:,} of {len(rows):,} finished runs are used, drawn at random (the same every time): the time of a fit grows as"
        " their cube."
    )
    return rows[np.sort(np.random.default_rng(_THINNING_SEED).permutation(len(rows))[:most])]


def _varying(what: str, names: Sequence[str], values: FloatArray, notes: list[str]) -> list[int]:
    moves = np.ptp(values, axis=0) > 1e-12 * np.maximum(1e-300, np.abs(values).max(0))
    if not moves.all():
        notes.append(f"{what} {listed([n for n, m in zip(names, moves, strict=True) if not m])} never varies and is left out.")
    return np.flatnonzero(moves).tolist()


def read_runs(inputs: Path, outputs: Path, output_names: Sequence[str] | None = None, most: int = MOST_RUNS) -> RunTable:
    """Read and check a table of inputs and a table of outputs with a row for each run.

    Raises TableError as ``combine`` and ``read_frame`` do.
    """
    frames = read_frame(inputs), read_frame(outputs)
    return combine(*frames, output_names=output_names, where=f"{inputs} and {outputs}", most=most)


def read_one(path: Path, input_names: Sequence[str], output_names: Sequence[str]) -> RunTable:
    """Read one table that holds inputs and outputs side by side (as ``lacli design --run`` and ``calibrate`` write)."""
    frame = read_frame(path)
    return combine(frame, frame, input_names=input_names, output_names=output_names, where=str(path))
