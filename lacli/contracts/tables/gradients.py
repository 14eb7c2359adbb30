"""Derivatives of outputs by inputs as columns of a table of runs: ``d<output>/d<input>``, in the output's unit over the input's.

Whether their units are the table's own is found from the table itself: between two runs the output changes by the mean of
the gradients at both, times the way between them, up to third order in it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import TableError
from lacli.contracts.tables import checks
from lacli.contracts.tables.columns import numbers
from lacli.contracts.tables.file import listed

# a column is refused where differences between runs say another factor than 1: so far from it, by so many standard errors,
# where gradients so corrected explain the differences between runs at all, and so much better than the column as it is
_FACTOR, _SURE, _EXPLAINED, _BETTER = 3.0, 6.0, 0.5, 3.0
# pairs of runs that are compared: each run with its nearest ones; of a large table, some of the runs
_NEAREST, _MOST_RUNS = 8, 400
# an input over a wider ratio than this is compared along its logarithm
_RATIO = 3.0
_FEWEST = 4


def name_of(output: str, given: str) -> str:
    """The name of the column that holds the derivative of an output by an input."""
    return f"d{output}/d{given}"


def gradient_columns(columns: Sequence[str], outputs: Sequence[str], inputs: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Columns that are derivatives: of which output, by which input."""
    named = {name_of(output, given): (output, given) for output in outputs for given in inputs}
    return {name: named[name] for name in columns if name in named}


def read_gradients(frame: pd.DataFrame, outputs: Sequence[str], inputs: Sequence[str], where: str) -> FloatArray | None:
    """(n, inputs, outputs) of the frame's rows, NaN where a derivative is not told; None where no column tells any.

    Raises TableError for a cell that is no number, and a value too large to calculate with.
    """
    found = gradient_columns(list(frame.columns), outputs, inputs)
    if not found:
        return None
    values = numbers(frame[list(found)], f"{where}: derivatives").to_numpy(float)
    checks.check_sizes(list(found), values, f"{where}: derivative")
    result = np.full((len(frame), len(inputs), len(outputs)), np.nan)
    for column, (output, given) in zip(values.T, found.values(), strict=True):
        result[:, list(inputs).index(given), list(outputs).index(output)] = np.where(np.isfinite(column), column, np.nan)
    return result


def check_gradients(
    x: FloatArray, y: FloatArray, gradients: FloatArray, inputs: Sequence[str], outputs: Sequence[str], where: str
) -> None:
    """Raises TableError where differences of the outputs y (n, p) between runs x (n, d) show that a column of the gradients
    (n, d, p) is in another unit, or of another sign.

    For each output the changes between neighbours are regressed on what each derivative says of them: a factor for each
    input, 1 where units agree, with a standard error that is robust to the gradients' own change on the way.
    """
    wrong = []
    for j, output in enumerate(outputs):
        factor, error, better = _factors(x, y[:, j], gradients[:, :, j])
        off = (np.abs(factor - 1.0) > _SURE * error) & (better > _BETTER)
        off &= (factor < 1.0 / _FACTOR) | (factor > _FACTOR)
        wrong += [(name_of(output, inputs[i]), float(factor[i]), float(error[i])) for i in np.flatnonzero(off).tolist()]
    if wrong:
        name, times, error_of = max(wrong, key=lambda found: abs(found[1] - 1.0) / found[2])
        others = [other for other, _, _ in wrong if other != name]
        also = f" So do {listed(others, 3)}." if others else ""
        raise TableError(
            f"{where}: {name} does not fit the runs: they differ by {times:.3g} (± {error_of:.1g}) times what it says.{also}"
            " A derivative is in the output's unit over the input's, at the run's own inputs. Correct or remove the column."
        )


def _factors(x: FloatArray, y: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of one output: the factor (d,) that differences of y (n,) say for each derivative (n, d), its standard error (d,),
    infinite where they say nothing, and how many times larger the factor 1 makes the sum of squares that is left (d,)."""
    d = x.shape[1]
    factor, error, better = np.ones(d), np.full(d, np.inf), np.ones(d)
    known = np.isfinite(gradient).any(0)
    rows = np.flatnonzero(np.isfinite(gradient[:, known]).all(1))
    if not known.any() or len(rows) < _FEWEST:
        return factor, error, better
    rows = rows[:: -(-len(rows) // _MOST_RUNS)]
    t, slope = _scaled(x[rows], np.where(known, gradient[rows], 0.0))
    here, there = _pairs(t)
    way = t[there] - t[here]
    said = 0.5 * (slope[here] + slope[there]) * way
    # inputs whose derivative is not told take part freely: as a linear effect
    columns = np.where(known, said, way)
    change = y[rows][there] - y[rows][here]
    size = np.sqrt((columns**2).mean(0))
    used = np.flatnonzero(size > 0)
    if len(used) == 0 or len(here) < 2 * len(used):
        return factor, error, better
    # what the trapezium leaves out grows as the cube of the way; below the usual one, noise in the values does not shrink
    length = np.sqrt((way**2).sum(1))
    weight = 1.0 / (length**3 + np.median(length) ** 3)
    a = columns[:, used] / size[used] * weight[:, None]
    b = change * weight
    normal = np.linalg.pinv(a.T @ a, rcond=1e-10, hermitian=True)
    solution = normal @ (a.T @ b)
    rest = b - a @ solution
    if (rest**2).sum() > (1.0 - _EXPLAINED) * (b**2).sum():
        return factor, error, better
    # pairs share runs: scores are summed by the run they start from, and by the one they lead to
    scores = np.zeros((len(rows), len(used)))
    np.add.at(scores, here, a * rest[:, None])
    np.add.at(scores, there, a * rest[:, None])
    # each pair stands in two runs, and a regression on few runs takes its own residuals for too small
    few = len(rows) / max(1, len(rows) - len(used))
    spread = normal @ (scores.T @ scores) @ normal * few
    keep = np.asarray(known, bool)[used] & (np.diag(normal) > 0)
    told = used[keep]
    factor[told] = (solution / size[used])[keep]
    # with one factor fixed, the others as they then are best
    left = np.maximum((rest**2).sum(), 1e-12 * (b**2).sum())
    better[told] = 1.0 + (((solution - size[used]) ** 2) / np.maximum(np.diag(normal), 1e-300))[keep] / left
    error[told] = np.maximum((np.sqrt(np.diag(spread)) / size[used])[keep], 1e-12)
    return factor, error, better


def _scaled(x: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inputs (n, d) on the unit range, wide positive ones by their logarithm, and the gradient (n, d) by these."""
    logarithmic = (x > 0).all(0) & (x.max(0) > _RATIO * np.maximum(x.min(0), 1e-300))
    t = np.where(logarithmic, np.log(np.where(logarithmic, x, 1.0)), x)
    width = np.maximum(np.ptp(t, axis=0), 1e-300)
    return (t - t.min(0)) / width, gradient * np.where(logarithmic, x, 1.0) * width


def _pairs(t: FloatArray) -> tuple[IntArray, IntArray]:
    """Each run (n, d) with its nearest ones, every pair once, none of the same place."""
    from scipy.spatial import cKDTree

    count = min(_NEAREST + 1, len(t))
    distance, near = cKDTree(t).query(t, count)
    here = np.repeat(np.arange(len(t)), count)
    there = near.ravel()
    apart = distance.ravel() > 1e-9
    pairs = np.unique(np.sort(np.c_[here, there][apart], axis=1), axis=0)
    return pairs[:, 0], pairs[:, 1]
