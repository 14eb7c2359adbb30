"""The parameter box: names with units, ranges, and orderings between inputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.documents import brief, read_toml
from lacli.base.errors import UsageError
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.parameters import QUANTITIES, judge, parameter_box

# published ranges of the left atrium's parameters, the table's
RANGES: dict[str, tuple[float, float]] = parameter_box()
CALIBRATION_INPUTS: tuple[str, ...] = tuple(name for name in RANGES if not name.startswith("c_"))
SENSITIVITY_INPUTS: tuple[str, ...] = tuple(RANGES)
OUTPUTS: tuple[str, ...] = ("esv_ml", "d_global_mm", *(f"d_{region}_mm" for region in BODY_REGIONS))
# beyond these, squares overflow, or points of the range are one number
_LARGEST, _NARROWEST = 1e100, 1e-12
_POINTS = 1 << 15  # by which a share of a box is measured, to .3 %
# (lower, upper): the first must stay below the second
_ORDERED = (("edp_mmhg", "esp_mmhg"),)


@dataclass(frozen=True)
class Box:
    """Ranges of d inputs; ``ordered``: pairs of column numbers (i, j) with input i < input j required."""

    names: tuple[str, ...]
    lower: FloatArray
    upper: FloatArray
    ordered: tuple[tuple[int, int], ...] = ()

    @property
    def d(self) -> int:
        """Number of inputs."""
        return len(self.names)

    def contains(self, x: FloatArray) -> BoolArray:
        """Whether points (m, d) are within the ranges and keep the orderings."""
        inside = ((x >= self.lower) & (x <= self.upper)).all(1)
        for i, j in self.ordered:
            inside &= x[:, i] < x[:, j]
        return np.asarray(inside, bool)

    def share_in_order(self) -> float:
        """The share of the ranges' points that keep the orderings."""
        if not self.ordered:
            return 1.0
        points = self.from_unit(np.random.default_rng(0).random((_POINTS, self.d)))
        return float(self.contains(points).mean())

    def from_unit(self, u: FloatArray) -> FloatArray:
        """Points of the unit cube (m, d) -> points of the box."""
        return self.lower + u * (self.upper - self.lower)

    def to_unit(self, x: FloatArray) -> FloatArray:
        """Points of the box (m, d) -> points of the unit cube."""
        return (x - self.lower) / (self.upper - self.lower)

    def uniform(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Independent uniform points (count, d) that keep the orderings."""
        found = np.empty((0, self.d))
        while len(found) < count:
            x = self.from_unit(rng.random((count, self.d)))
            found = np.vstack([found, x[self.contains(x)]])
        return found[:count]


def make_box(names: Sequence[str], lower: Sequence[float], upper: Sequence[float]) -> Box:
    """A checked box, with the orderings that apply to its names where the ranges overlap.

    Raises UsageError for an empty or reversed range, one beyond what is possible, or an ordering that no point keeps.
    """
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    if len(set(names)) != len(names):
        raise UsageError("box: an input is named twice.")
    for name, a, b in zip(names, low, high, strict=True):
        if not (math.isfinite(a) and math.isfinite(b) and a < b):
            raise UsageError(f"box: the range of {name} is [{a:g}, {b:g}]; the lower end must be below the upper one.")
        if max(abs(a), abs(b)) > _LARGEST or b - a <= _NARROWEST * max(abs(a), abs(b)):
            raise UsageError(f"box: the range of {name} is [{a:g}, {b:g}]: too large, or too narrow, to calculate with.")
        for end in (a, b) if name in QUANTITIES else ():
            verdict, words = judge(QUANTITIES[name], float(end))
            if verdict == "impossible":
                raise UsageError(f"box: {name}: {words}.")
    ordered = []
    for first, second in _ORDERED:
        if first in names and second in names:
            i, j = list(names).index(first), list(names).index(second)
            if low[i] >= high[j]:
                raise UsageError(f"box: {first} is never below {second} in these ranges.")
            if high[i] >= low[j]:
                ordered.append((i, j))
    return Box(tuple(names), low, high, tuple(ordered))


def published_box(names: Sequence[str] = CALIBRATION_INPUTS) -> Box:
    """The published ranges of the named inputs."""
    unknown = [name for name in names if name not in RANGES]
    if unknown:
        raise UsageError(f"no published range for {', '.join(unknown)}; give a box file. Known: {', '.join(RANGES)}.")
    return make_box(names, [RANGES[n][0] for n in names], [RANGES[n][1] for n in names])


def read_box(path: Path) -> Box:
    """Read ranges from TOML: ``[box]`` with ``name = [lower, upper]`` for each input.

    Raises UsageError with the key at fault.
    """
    path = Path(path)
    missing = "no such box file. Write [box] and a line `name = [lower, upper]` for each input"
    document = read_toml(path, error=UsageError, missing=missing)
    table = document.get("box", document)
    if not isinstance(table, dict) or not table:
        raise UsageError(f"{path}: no range in it. Write [box] and a line `name = [lower, upper]` for each input.")
    for name, pair in table.items():
        numbers = isinstance(pair, list) and len(pair) == 2
        if not numbers or not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in pair):
            raise UsageError(f"{path}: {name} needs [lower, upper], found {brief(pair)}.")
    return make_box(list(table), [pair[0] for pair in table.values()], [pair[1] for pair in table.values()])


def notes(box: Box) -> list[str]:
    """What of a box's ranges is possible but not plausible, a sentence each."""
    ends = [(n, float(v)) for n, *pair in zip(box.names, box.lower, box.upper, strict=True) for v in pair if n in QUANTITIES]
    return [f"box: {name}: {words}." for name, value in ends if (words := judge(QUANTITIES[name], value)[1])]


def table_box(names: Sequence[str], x: FloatArray) -> Box:
    """The box of a table of runs: the published range of a known input, else the range of its column in x (n, d)."""
    lower = [RANGES.get(name, (column.min(), 0))[0] for name, column in zip(names, x.T, strict=True)]
    upper = [RANGES.get(name, (0, column.max()))[1] for name, column in zip(names, x.T, strict=True)]
    return make_box(names, np.minimum(lower, x.min(0)).tolist(), np.maximum(upper, x.max(0)).tolist())
