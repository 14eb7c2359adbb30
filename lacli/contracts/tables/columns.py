"""What the columns of a table of runs mean: status, labels of runs, errors of outputs, numbers."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence

import numpy as np
import pandas as pd

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import TableError
from lacli.base.notes import note
from lacli.contracts.failures import MACHINE, SCENE
from lacli.contracts.tables.absent import check_column

STATUS = "status"
ERROR_SUFFIX = "_discretisation_error"
SPREAD_SUFFIX = "_equilibria_spread"  # of two equilibria of a run, beside an output of that name; no output of its own
# columns beside an output of that name that tell its uncertainty, one standard deviation
ERROR_SUFFIXES = (ERROR_SUFFIX, "_error", "_err", "_sd", "_std", "_se", "_uncertainty")
# bookkeeping columns that are neither inputs nor outputs
_BOOKKEEPING = frozenset({"failure", "kind", "cpu_s", "wall_s", "wave", "attempts", "message", "peak_memory_mb"})
# labels of runs, the first that both tables have pairs them
LABELS = (
    "run_id", "run", "id", "key", "case", "case_id", "sim", "sim_id", "simulation", "sample", "sample_id", "job", "job_id",
    "index", "row", "no", "nr", "#",
)  # fmt: skip
_UNNAMED = re.compile(r"unnamed: \d+(_level_\d+)?|level_\d+|")
# words of schedulers and simulators, lower case, with _ for blanks and hyphens
DONE = frozenset(
    {"ok", "done", "success", "successful", "succeeded", "converged", "complete", "completed", "finished", "true", "yes", "1"}
)
FAILED = frozenset(
    {
        "failed", "fail", "failure", "error", "errored", "crash", "crashed", "diverged", "not_converged", "nonconverged",
        "unconverged", "aborted", "abort", "invalid", "rejected", "timeout", "timed_out", "inverted_element", "nan", "false",
        "no", "0", *SCENE,
    }
)  # fmt: skip
# what the machine ended, or has not begun: no result of the simulator's, nothing to learn from
UNFINISHED = frozenset(
    {
        "killed", "out_of_memory", "oom", "disk_full", "lost", "lost_worker", "cancelled", "canceled", "preempted", "node_fail",
        "boot_fail", "deadline", "revoked", "interrupted", "suspended", "pending", "queued", "running", "submitted", "waiting",
        "skipped", "not_run", "todo", "planned", "new", *MACHINE,
    }
)  # fmt: skip


def is_label(name: str) -> bool:
    """Whether a column of this name labels runs: run_id, case, index, the nameless column that pandas adds."""
    lower = name.strip().lower()
    return lower in LABELS or _UNNAMED.fullmatch(lower) is not None


def is_bookkeeping(name: str) -> bool:
    """Whether a column of this name is neither an input nor an output of a simulator."""
    return name.strip().lower() == STATUS or name in _BOOKKEEPING or name.endswith(SPREAD_SUFFIX) or is_label(name)


def error_of(name: str, names: Sequence[str]) -> str | None:
    """The output among ``names`` whose error a column of this name tells, None where it tells none."""
    return next((name.removesuffix(s) for s in ERROR_SUFFIXES if name.endswith(s) and name.removesuffix(s) in names), None)


def derivative_of(name: str, outputs: Collection[str]) -> tuple[str, str] | None:
    """The output among ``outputs`` of which a column named ``d<output>/d<input>`` is a derivative, and the input it is by."""
    parts = name[1:].split("/d") if name.startswith("d") else []
    splits = (("/d".join(parts[:i]), "/d".join(parts[i:])) for i in range(1, len(parts)))
    return next(((output, given) for output, given in splits if output in outputs and given), None)


def _word(value: object) -> str:
    if isinstance(value, (float, np.floating)) and float(value).is_integer():
        value = int(value)
    text = "_".join(re.split(r"[\s_\-]+", str(value).strip().lower().rstrip("+.!")))
    return "cancelled" if text.startswith("cancelled_by_") else text


def run_states(frame: pd.DataFrame, where: str) -> tuple[BoolArray, BoolArray] | None:
    """Whether each run is done (n,) and failed (n,) by the column ``status``; neither: never run, or ended by the machine.

    None where no column tells. Raises TableError that names a word which is not known, and those that are.
    """
    column = next((name for name in frame.columns if name.strip().lower() == STATUS), None)
    if column is None:
        return None
    words = [_word(value) for value in frame[column]]
    known = DONE | FAILED | UNFINISHED
    missing = frame[column].isna().to_numpy()
    for row, (word, empty) in enumerate(zip(words, missing, strict=True)):
        if empty or word not in known:
            told = "is empty" if empty else f"is {frame[column].iloc[row]!r}, a word that is not known here,"
            count = int(missing.sum()) if empty else words.count(word)
            raise TableError(
                f"{where}: {column} {told} in row {row + 1} ({count} such rows). Finished runs: {', '.join(sorted(DONE))};"
                f" failed: {', '.join(sorted(FAILED))}; never finished: {', '.join(sorted(UNFINISHED))}."
            )
    done, failed = (np.array([word in those for word in words]) for those in (DONE, FAILED))
    for name in {"kind", "failure"} & set(frame.columns):  # a run that is called failed, though the machine ended it
        failed &= ~np.array([_word(kind) in UNFINISHED for kind in frame[name]])
    return done, failed


def to_numbers(column: pd.Series) -> pd.Series:
    """The column as floats where its cells are numbers, NaN elsewhere; a whole number beyond all floats is infinite."""
    try:
        return pd.to_numeric(column, errors="coerce").astype(float)
    except OverflowError:
        return pd.to_numeric(column.map(_bounded), errors="coerce").astype(float)


def _bounded(value: object) -> object:
    try:
        return float(str(value)) if isinstance(value, (int, str)) else value
    except ValueError:
        return value


def numbers(frame: pd.DataFrame, what: str) -> pd.DataFrame:
    """The frame as floats; a cell or a column that holds no number is an error that names it."""
    columns = {}
    for name in frame.columns:
        column = frame[name]
        if isinstance(column.dtype, pd.CategoricalDtype):
            column = column.astype(column.cat.categories.dtype)
        kind = column.dtype.kind if isinstance(column.dtype, np.dtype) else ""
        if kind == "b" or pd.api.types.is_bool_dtype(column.dtype) or _holds_bool(column):
            raise TableError(f"{what}: column {name} holds True and False. Write 0 and 1 if it is a number, or remove it.")
        if (kind in "cmM" and kind) or pd.api.types.is_datetime64_any_dtype(column.dtype):
            told = {"c": "complex numbers", "m": "durations"}.get(kind, "dates")
            raise TableError(f"{what}: column {name} holds {told}, which are not numbers here. Convert or remove it.")
        try:
            values = to_numbers(column)
        except (TypeError, ValueError) as error:
            raise TableError(f"{what}: column {name} does not hold one number a cell ({error}).") from error
        bad = values.isna() & column.notna() & ~column.astype(str).str.strip().str.lower().isin(["nan", "", "na", "none"])
        if bad.any():
            row = int(np.flatnonzero(bad.to_numpy())[0])
            raise TableError(f"{what}: column {name}, row {row + 1} holds {column.iloc[row]!r}, which is not a number.")
        columns[name] = values.astype(float)
    return pd.DataFrame(columns, index=frame.index)


def _holds_bool(column: pd.Series) -> bool:
    if column.dtype != object:
        words = (
            column.dtype.kind not in "fiu" if isinstance(column.dtype, np.dtype) else pd.api.types.is_string_dtype(column.dtype)
        )
        if not words:
            return False
    return any(isinstance(v, (bool, np.bool_)) or (isinstance(v, str) and v.strip().lower() in ("true", "false")) for v in column)


def input_values(frame: pd.DataFrame, where: str, tell: Callable[[str], None] = note) -> FloatArray:
    """The inputs of runs as numbers (n, d); ``tell``: what is doubtful of them, a sentence.

    Raises TableError that names the cell that holds no finite number, a missing-value code, or what its quantity cannot be.
    """
    x = numbers(frame, f"{where}: inputs").to_numpy(float)
    bad = np.argwhere(~np.isfinite(x))
    if len(bad):
        row, column = bad[0]
        raise TableError(
            f"{where}: input {frame.columns[column]} has no finite value in row {row + 1}"
            f" ({len(bad)} such cells). Fill it in or remove the run."
        )
    for j, name in enumerate(frame.columns):
        check_column(str(name), x[:, j], f"{where}: input", "Correct it or remove the run.", tell)
    return x
