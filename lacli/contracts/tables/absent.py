"""Numbers that stand for none: missing-value codes, and what lies so far outside a column that it is no value of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import TableError
from lacli.contracts.parameters import QUANTITIES, judge

_NINES = tuple(10.0**k - 1.0 for k in range(3, 11))
# what programs write where they have no value: nines, the ends of whole numbers, CF conventions and netCDF, Fortran and CDO
CODES: tuple[float, ...] = (
    *(-n for n in _NINES), *_NINES,
    -999.25, -999.9, -9999.9, -32768.0, 32767.0, -2147483648.0, 2147483647.0, -(2.0**63), 2.0**63,
    9.969209968386869e36, 9.96921e36, float(np.float32(9.96921e36)), -1.7e308,
    *(sign * 10.0**k for k in (20, 25, 30, 31, 33, 34, 35, 36, 37, 38, 99) for sign in (1.0, -1.0)),
    *(sign * float(np.float32(10.0**k)) for k in (20, 30, 35, 36) for sign in (1.0, -1.0)),
    3.4028234663852886e38, -3.4028234663852886e38, -1.7976931348623157e308, 1.7976931348623157e308,
)  # fmt: skip
# a column that holds more kinds of codes than this holds a scale that happens to be made of nines
_MOST_KINDS = 2
# gaps in ranges of all other values: beyond the first it is told, beyond the second no column of one quantity is so
_TOLD, _REFUSED = 10.0, 1e4
# the same for the logarithms in columns of positive numbers
_IN_DECADES = {_TOLD: 1.0, _REFUSED: 3.0}
_FEWEST = 8
# of the others' size, at least, is what no column of one quantity has: rows at one end of a box are alike to the last digits
_LEAST_GAP = 0.5


def is_code(value: float) -> bool:
    """Whether the number alone can only be a missing-value code: no quantity here is negative nines, or as large as 1e20."""
    return value in CODES and (value < 0 or value >= 2.0**63)


def codes(values: FloatArray) -> BoolArray:
    """The rows (n,) whose value is a missing-value code, and farther from the others than these from each other and from 0."""
    code = np.isin(values, CODES)
    others = values[np.isfinite(values) & ~code]
    if not code.any() or not others.size or len(np.unique(values[code])) > _MOST_KINDS:
        return np.zeros(len(values), bool)
    with np.errstate(over="ignore"):
        span = max(float(np.ptp(others)), float(np.abs(others).max()))
        return np.asarray(code & ((values < others.min() - span) | (values > others.max() + span)))


def apart(values: FloatArray, times: float = _REFUSED) -> BoolArray:
    """The rows (n,), fewer than half, that a gap of more than ``times`` the range of all others parts from these.

    In a column of positive numbers the gap of the logarithms must be larger than their range too: what spans decades has
    wide gaps at its upper end. What is refused is apart by the others' size, too: a search leaves many rows at the end of a box,
    which differ by rounding alone.
    """
    found = np.zeros(len(values), bool)
    known = values[np.isfinite(values)]
    if len(known) < _FEWEST:
        return found
    for sign in (1.0, -1.0):
        v = np.sort(sign * known)
        cut = _first_gap(v, times, least=_LEAST_GAP * np.abs(v[:-1]) if times == _REFUSED else 0.0)
        if cut is not None and sign > 0 and v[0] > 0:
            cut = _first_gap(np.log(v), _IN_DECADES[times], cut)
        if cut is not None:
            found |= sign * values > v[cut]
    return found & np.isfinite(values)


def _first_gap(v: FloatArray, times: float, at: int | None = None, least: FloatArray | float = 0.0) -> int | None:
    """The number of the last value below the first such gap in the upper half of sorted values; ``at``: only there; ``least``
    (n - 1,): of the gap itself."""
    with np.errstate(over="ignore"):
        gap = np.diff(v)
        wide = (gap > times * (v[:-1] - v[0])) & (v[:-1] > v[0]) & (gap > least)
    wide[: (len(v) - 1) // 2] = False
    where = np.flatnonzero(wide)
    if at is not None:
        return at if at in where else None
    return int(where[0]) if len(where) else None


def check_column(name: str, values: FloatArray, where: str, remedy: str, tell: Callable[[str], None]) -> None:
    """Raises TableError where cells of a column (n,) of measured or chosen numbers are none; tells what is doubtful.

    A known quantity is held against its possible and plausible range. where: "runs.csv: input"; remedy: what to do, a sentence.
    """
    for mask, words in ((codes(values), "a mark of a missing value"), (apart(values), "no value of this column")):
        if mask.any():
            raise TableError(f"{where} {name} is {_at(values, mask)}: {words}, {_rest(values, mask)}. {remedy}")
    judged = _judged(name, values, where, remedy, tell)
    if not judged and (mask := apart(values, _TOLD)).any():
        tell(f"{where} {name} is {_at(values, mask)}, {_rest(values, mask)}: it is used; correct or remove it if it is no value.")


def _judged(name: str, values: FloatArray, where: str, remedy: str, tell: Callable[[str], None]) -> bool:
    """Whether a known quantity was told to be odd. Raises TableError where a value is not possible."""
    if name not in QUANTITIES:
        return False
    quantity = QUANTITIES[name]
    odd: list[tuple[int, str]] = []
    for row in np.flatnonzero(np.isfinite(values)).tolist():
        verdict, words = judge(quantity, float(values[row]))
        if verdict == "impossible":
            raise TableError(f"{where} {name}, row {row + 1}: {words}. {remedy}")
        if verdict == "odd":
            odd.append((row, words))
    if odd:
        row, words = odd[0]
        tell(f"{where} {name}, row {row + 1}: {words}{f' ({len(odd)} such rows)' if len(odd) > 1 else ''}.")
    return bool(odd)


def _at(values: FloatArray, mask: BoolArray) -> str:
    rows = np.flatnonzero(mask)
    more = f" ({len(rows)} such rows)" if len(rows) > 1 else ""
    return f"{values[rows[0]]:.6g} in row {rows[0] + 1}{more}"


def _rest(values: FloatArray, mask: BoolArray) -> str:
    others = values[~mask & np.isfinite(values)]
    return f"where the others lie in {others.min():.4g} to {others.max():.4g}"
