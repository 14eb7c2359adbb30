"""Where in a box the runs tell something: parts that no run has visited are extrapolation, whatever an emulator says there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import UsageError
from lacli.inference.box import Box

_POINTS = 1 << 12
# runs of a design leave a margin at the ends: this share of their range, or two runs' worth, counts as theirs
_MARGIN = 0.02
# a part of the range where this many runs are expected, were they even, and none is, has been left out
_EXPECTED = 20.0
# share of the points asked of that is said, and that is refused
WORTH_SAYING, TOO_MUCH = 0.01, 0.95


@dataclass(frozen=True)
class Coverage:
    """share: of the points that lie where no run has been; beyond: for each input whose range in the runs is narrower than
    in the box (name, from, to in the runs, from, to in the box)."""

    share: float
    beyond: tuple[tuple[str, float, float, float, float], ...]

    def words(self, whole: str = "the box") -> str:
        """What a user must know; '' where (nearly) all is covered. whole: what the points were, in words."""
        if self.share <= WORTH_SAYING:
            return ""
        ranges = "; ".join(f"{name}: runs {a:.4g} to {b:.4g}, box {c:.4g} to {d:.4g}" for name, a, b, c, d in self.beyond)
        return (
            f"{self.share:.1%} of {whole} is where no run has been: the emulators extrapolate there"
            + (f" ({ranges})" if ranges else " (a part within the runs' range)") + "."
        )  # fmt: skip


def coverage(box: Box, runs: FloatArray, points: FloatArray | None = None) -> Coverage:
    """How much of the box, or of points (m, d) of it, lies where no run (n, d) has been."""
    if points is None:
        points = box.from_unit(qmc.Sobol(box.d, rng=np.random.default_rng(0)).random(_POINTS))
        points = points[box.contains(points)]
    low, high = _reach(runs)
    beyond = tuple(
        (name, float(runs[:, j].min()), float(runs[:, j].max()), float(box.lower[j]), float(box.upper[j]))
        for j, name in enumerate(box.names) if box.lower[j] < low[j] or box.upper[j] > high[j]
    )  # fmt: skip
    return Coverage(float(unvisited(points, runs).mean()) if len(points) else 0.0, beyond)


def check_coverage(box: Box, runs: FloatArray, points: FloatArray | None = None, remedy: str = "") -> Coverage:
    """As ``coverage``; raises UsageError where nearly all of it is extrapolation."""
    found = coverage(box, runs, points)
    if found.share > TOO_MUCH:
        raise UsageError(f"{found.words()} Narrow the box to the runs' ranges, or add runs.{remedy}")
    return found


@dataclass(frozen=True)
class Extrapolation:
    """Shares of the box and of the posterior that lie where no run has been, what a user must know of them, and whether the
    posterior is all but beyond the runs: then it is no answer."""

    box: float
    posterior: float
    warnings: tuple[str, ...]
    refused: bool


def extrapolation(covered: Coverage, samples: FloatArray, runs: FloatArray) -> Extrapolation:
    """Of a posterior's samples (m, d) by emulators of runs (n, d), in a box that is covered so."""
    strayed = float(unvisited(samples, runs).mean())
    words = f"{strayed:.1%} of the posterior lies where no run has been: the emulators extrapolate there."
    said = (covered.words(), words if strayed > WORTH_SAYING else "")
    return Extrapolation(covered.share, strayed, tuple(filter(None, said)), strayed > TOO_MUCH)


def unvisited(points: FloatArray, runs: FloatArray) -> BoolArray:
    """Whether each point (m, d) is out of the range of the runs (n, d), or in a part of one or two inputs' ranges that holds
    no run though many would be there if they were even."""
    low, high = _reach(runs)
    out = ((points < low) | (points > high)).any(1)
    n, d = runs.shape
    u, v = _even(runs, points)
    bins = int(n / _EXPECTED)
    if bins >= 2:
        for j in range(d):
            filled = np.bincount(_cell(u[:, j], bins), minlength=bins) > 0
            out |= ~filled[_cell(v[:, j], bins)]
    side = int(np.sqrt(n / _EXPECTED))
    if side >= 2:
        for j in range(d):
            for k in range(j):
                cells = _cell(u[:, j], side) * side + _cell(u[:, k], side)
                filled = np.bincount(cells, minlength=side * side) > 0
                out |= ~filled[_cell(v[:, j], side) * side + _cell(v[:, k], side)]
    return np.asarray(out, bool)


def _reach(runs: FloatArray) -> tuple[FloatArray, FloatArray]:
    width = np.ptp(runs, axis=0)
    margin = max(_MARGIN, 2.0 / len(runs)) * width
    return runs.min(0) - margin, runs.max(0) + margin


def _even(runs: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Runs and points in [0, 1] of the runs' ranges, on the scale, linear or logarithmic, on which the runs are more even."""
    u, v = np.empty_like(runs), np.empty_like(points)
    steps = (np.arange(len(runs)) + 0.5) / len(runs)
    for j in range(runs.shape[1]):
        x, y = runs[:, j], points[:, j]
        scaled = [((x - x.min()) / np.ptp(x), (y - x.min()) / np.ptp(x))]
        if x.min() > 0:
            a, b = np.log(x), np.log(np.maximum(y, 1e-300))
            scaled.append(((a - a.min()) / np.ptp(a), (b - a.min()) / np.ptp(a)))
        u[:, j], v[:, j] = min(scaled, key=lambda pair: np.abs(np.sort(pair[0]) - steps).max())
    return u, v


def _cell(u: FloatArray, count: int) -> np.ndarray:
    return np.clip((u * count).astype(np.int64), 0, count - 1)
