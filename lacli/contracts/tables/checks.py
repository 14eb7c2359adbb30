"""Whether runs can be learnt from: values that stand apart, inputs that depend on each other, counters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import rankdata

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import TableError
from lacli.contracts.tables.absent import CODES, apart, codes

# beyond these, squares overflow or vanish
_LARGEST, _SMALLEST = 1e100, 1e-100
# distance from the median in interquartile ranges: of 100,000 draws of a normal distribution the farthest is at 3.3, of 1/u
# with u uniform (no variance) it is at some 4e4 in the mean of the worst, 40 at 100 runs
_APART, _FAR = 50.0, 1e4
# a missing-value code nearer than this may be a value
_CODE_APART = 5.0
# share of an input's variance that the others leave open
_DEPENDENT, _NEARLY = 1e-6, 1e-2
_FEWEST_RANKED = 10


def check_sizes(names: Sequence[str], values: FloatArray, what: str) -> None:
    """Raises TableError for a finite value too large or too small to calculate with."""
    size = np.abs(np.where(np.isfinite(values), values, 0.0))
    for j, name in enumerate(names):
        if size[:, j].max(initial=0.0) > _LARGEST:
            row = int(size[:, j].argmax())
            raise TableError(
                f"{what} {name} is {values[row, j]:g} in row {row + 1}: too large to calculate with. Check its unit."
            )
        if 0 < size[:, j].max(initial=0.0) < _SMALLEST:
            raise TableError(f"{what} {name} is nowhere above {_SMALLEST:g}: too small to calculate with. Check its unit.")


def distances(values: FloatArray) -> FloatArray:
    """How far values (n, p) lie from their column's median, in its interquartile ranges; 0 where that is 0 or too few rows."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        low, median, high = np.nanquantile(values, [0.25, 0.5, 0.75], axis=0)
        far = np.abs(values - median) / (high - low)
    far[:, ~(high > low)] = 0.0
    return np.where(np.isfinite(values) & np.isfinite(far), far, 0.0)


def stray_outputs(names: Sequence[str], y: FloatArray, rows: Sequence[int], notes: list[str]) -> BoolArray:
    """Runs (n,) of y (n, p) whose output is so far from the others' that it is a mark of failure, no value.

    rows: their numbers in the table. Values that stand apart, but not as far, are said and kept.
    """
    stray = np.zeros(len(y), bool)
    if len(y) < 8:
        return stray
    far = distances(y)
    for j, name in enumerate(names):
        # a third of the runs without a value makes the interquartile range itself that of the codes
        out = (far[:, j] > _FAR) | codes(y[:, j]) | apart(y[:, j])
        if out.any():
            i = int(np.flatnonzero(out)[0])
            notes.append(
                f"output {name} is {y[i, j]:.6g} in row {rows[i] + 1} ({int(out.sum())} such), far from all others: no value"
                " but a mark of failure, so the run is counted as failed."
            )
            stray |= out
        away = ((far[:, j] > _APART) | (np.isin(y[:, j], CODES) & (far[:, j] > _CODE_APART))) & ~out
        if away.any():
            i = int(np.argmax(np.where(away, far[:, j], 0.0)))
            notes.append(
                f"output {name} is {y[i, j]:.6g} in row {rows[i] + 1}, {far[i, j]:.3g} interquartile ranges from the median:"
                " it is used; remove the run if this is no result."
            )
    return stray


def check_inputs(names: Sequence[str], x: FloatArray, where: str, notes: list[str]) -> None:
    """Raises TableError for inputs (n, d), each varying, that stray or depend on each other; says what is doubtful."""
    if len(x) < 3:
        return
    far = distances(x)
    for j, name in enumerate(names):
        i = int(far[:, j].argmax())
        if far[i, j] > _FAR:
            raise TableError(
                f"{where}: input {name} is {x[i, j]:g} where half of the runs lie in"
                f" {np.quantile(x[:, j], 0.25):.4g} to {np.quantile(x[:, j], 0.75):.4g}. Correct or remove that run."
            )
        steps = np.diff(x[:, j])
        if len(x) >= 8 and (steps == 1.0).all() and x[0, j] in (0.0, 1.0):
            notes.append(f"input {name} counts the rows (1, 2, 3, ...): remove it if it is no input of the simulator.")
    _check_pairs(names, x, where)
    logarithmic = (x > 0).all(0) & (x.max(0) > 3.0 * np.maximum(x.min(0), 1e-300))
    _check_linear(names, x, where, "linearly dependent", notes)
    if logarithmic.sum() > 1:
        among = np.flatnonzero(logarithmic)
        _check_linear([names[int(j)] for j in among], np.log(x[:, among]), where, "dependent (their logarithms linearly)", notes)


def _check_pairs(names: Sequence[str], x: FloatArray, where: str) -> None:
    """Two inputs of the same order of runs are functions of one another."""
    if len(x) < _FEWEST_RANKED or len(names) < 2:
        return
    ranks = rankdata(x, axis=0)
    distinct = [len(np.unique(x[:, j])) >= min(len(x), _FEWEST_RANKED) for j in range(len(names))]
    centred = ranks - ranks.mean(0)
    centred /= np.sqrt((centred**2).sum(0))
    together = np.abs(centred.T @ centred)
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            if distinct[i] and distinct[j] and together[i, j] > 1.0 - 1e-10:
                linear = abs(float(np.corrcoef(x[:, i], x[:, j])[0, 1]))
                raise TableError(
                    f"{where}: inputs {names[i]} and {names[j]} are {'linearly ' if linear > 1 - _DEPENDENT else ''}dependent"
                    f" (correlation {linear:.6g}; one tells the other in every run). Leave one out."
                )


def _check_linear(names: Sequence[str], t: FloatArray, where: str, how: str, notes: list[str]) -> None:
    """Inputs that a linear mean cannot tell apart: a combination of them, standardised, hardly varies."""
    n, d = t.shape
    if d < 2 or n < d + 2:
        return
    z = (t - t.mean(0)) / t.std(0)
    _, _, vt = np.linalg.svd(z / np.sqrt(n), full_matrices=False)
    direction = vt[-1]
    # what the others leave open of the input with the largest part in the direction
    leading = int(np.abs(direction).argmax())
    rest = np.delete(np.arange(d), leading)
    coefficients, *_ = np.linalg.lstsq(z[:, rest], z[:, leading], rcond=1e-12)
    open_ = float(np.mean((z[:, leading] - z[:, rest] @ coefficients) ** 2)) * n / max(1, n - d)
    parts = {int(rest[k]) for k in range(d - 1) if abs(coefficients[k]) > 1e-2} | {leading}
    told = [str(names[j]) for j in sorted(parts)]
    text = f"{', '.join(told[:-1])} and {told[-1]}"
    correlation = f"correlation {np.sqrt(max(0.0, 1.0 - open_)):.6g}"
    if open_ < _DEPENDENT:
        raise TableError(f"{where}: inputs {text} are {how} ({correlation}): the others tell one of them. Leave one out.")
    if open_ < _NEARLY:
        notes.append(f"inputs {text} are nearly {how} ({correlation}): what each does alone can hardly be learnt.")
