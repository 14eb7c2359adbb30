"""Uniform samples of a region of the box, however small: nested levels, a moving population, no bounding box.

Subset simulation (Au and Beck 2001): a population uniform in the box is driven through a falling sequence of levels
t_1 > t_2 > ... > 1 of a function whose value is below 1 inside the region. At each level the points above it are
replaced by copies of points below, and all are moved by Markov steps that leave the uniform distribution on
{level < t} unchanged, until they have forgotten where they were copied from. The region's volume is the product
of the shares that survived.

Where the level is the largest of several smooth values, polynomials of these guide the steps: a walker goes a long way
under the polynomials' level, which costs next to nothing, and where it arrives is accepted with the probability that makes
the target exactly uniform again (surrogate transition, Liu 2001, section 9.4.3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import LacliError
from lacli.base.threads import single_threaded
from lacli.inference.box import Box
from lacli.inference.polynomial import Polynomial, fit_polynomial

Level = Callable[[FloatArray], FloatArray]
Below = Callable[[FloatArray, float], BoolArray]
Values = Callable[[FloatArray], FloatArray]

_SURVIVE = 0.25  # share of the population below the next level
_FADED = 0.3  # correlation with the start below which a level's moves stop
_FORGOTTEN = 0.3  # the same between two states that are kept
_MAX_STEPS = 400
_DETOUR = 40  # cheap steps before a dear one
# a guide whose level is off by more than this (standard deviation, relative to the level) is refused too often to pay
_GUIDE_ERROR = 0.15
_SMALLEST = 1e-14  # volume at which a region counts as empty


class EmptyRegionError(LacliError):
    """No point of the box is in the region."""

    def __init__(self, message: str, lowest: float, best: FloatArray) -> None:
        super().__init__(message)
        self.lowest = lowest
        self.best = best


@dataclass(frozen=True)
class RegionSample:
    """points (count, d), uniform in the region; level (count,) of each; volume: the region's share of the (constrained)
    box, volume_sd its standard error; acceptance of the last level's moves; correlation: largest over the inputs between
    consecutive states of a walker in ``points``; evaluations of the level function."""

    points: FloatArray
    level: FloatArray
    volume: float
    volume_sd: float
    acceptance: float
    correlation: float
    evaluations: int


@single_threaded
def sample_region(
    level: Level,
    box: Box,
    count: int,
    seed: int = 0,
    walkers: int = 2000,
    tick: Callable[[float], None] | None = None,
    below: Below | None = None,
    start: FloatArray | None = None,
    values: Values | None = None,
) -> RegionSample:
    """``count`` points uniform on {level < 1} within the box.

    level: (m, d) -> (m,); below(x, t): whether level(x) < t, where that is cheaper than the level itself; values:
    (m, d) -> (m, q), signed, smooth, whose largest modulus is the level: with it the steps are guided.
    walkers: size of the population. tick(t) is called with each level. Raises EmptyRegionError if the levels stop
    falling before 1. start (m, d): points already known to be uniform in the region (and m >= walkers); the levels are
    then skipped and the volume is NaN.
    """
    rng = np.random.default_rng(seed)
    population = _Population(level, below or (lambda x, t: level(x) < t), values, box, rng, walkers)
    volume, relative = 1.0, 0.0
    if start is not None and len(start) >= walkers:
        population.x = start[rng.permutation(len(start))[:walkers]]
        population.measure()
        population.restart(np.arange(walkers), 1.0)
        population.forget(_FORGOTTEN)
        volume = float("nan")
    past: list[float] = []
    while start is None or len(start) < walkers:
        t = max(1.0, float(np.quantile(population.value, _SURVIVE)))
        if tick is not None:
            tick(t)
        alive = np.flatnonzero(population.value < t)
        share = len(alive) / walkers
        volume *= share
        past.append(t)
        if volume < _SMALLEST or (share > 0.99 and t > 1.0) or _stalled(past, volume):
            lowest = int(population.value.argmin())
            raise EmptyRegionError(
                f"no point of the box is in the region (nearest: level {population.value[lowest]:.3g}, must be below 1).",
                float(population.value[lowest]), population.x[lowest],
            )  # fmt: skip
        # copies are correlated until they have moved; the factor covers what remains of that
        relative += (1.0 - share) / (share * walkers) * (1.0 + 2.0 * _FADED)
        copies = alive[rng.permutation(walkers) % len(alive)] if share < 1.0 else np.arange(walkers)
        population.restart(copies, t)
        # on the way a copy's memory fades from level to level; at the end it has to be gone
        population.forget(_FADED if t > 1.0 else 0.1)
        if t <= 1.0:
            break
    kept, levels = [population.x.copy()], [population.value.copy()]
    correlation = 0.0
    while sum(map(len, kept)) < count:
        population.restart(np.arange(walkers), 1.0)
        correlation = max(correlation, population.forget(_FORGOTTEN))
        kept.append(population.x.copy())
        levels.append(population.value.copy())
    x = np.vstack(kept)
    pick = np.sort(rng.permutation(len(x))[:count])
    return RegionSample(
        points=x[pick], level=np.concatenate(levels)[pick], volume=volume, volume_sd=volume * float(np.sqrt(relative)),
        acceptance=population.acceptance, correlation=correlation, evaluations=population.evaluations,
    )  # fmt: skip


def _stalled(levels: Sequence[float], volume: float) -> bool:
    """Whether the levels, of which the last leaves ``volume``, have settled above 1: each of the last three fell by no more than
    the one before, and at that pace the volume would be gone before they were half way down."""
    falls = -np.diff(levels[-4:])
    if len(falls) < 3 or levels[-1] <= 1.0 or (np.diff(falls) > 0).any():
        return False
    left = np.log(volume / _SMALLEST) / -np.log(_SURVIVE)
    return bool(left * falls[-1] < 0.5 * (levels[-1] - 1.0))


class _Population:
    """Walkers moved in two halves: each half's steps are differences of two members of the other, which stand still.

    The step is symmetric given the other half, so accepting every step that stays below the level leaves the uniform
    distribution unchanged (differential evolution Monte Carlo, ter Braak 2006, on an indicator).
    """

    def __init__(
        self, level: Level, below: Below, values: Values | None, box: Box, rng: np.random.Generator, walkers: int
    ) -> None:
        self.level, self.below, self.values, self.box, self.rng = level, below, values, box, rng
        self.x = box.uniform(walkers, rng)
        self.value = np.full(walkers, np.inf)
        self.guide: _Guide | None = None
        self.t = np.inf
        self.measure()
        self.start = self.x
        self.acceptance = 1.0
        self.evaluations = walkers

    def restart(self, chosen: NDArray[np.int64], t: float) -> None:
        """Continue from the chosen walkers at level t."""
        self.x, self.value, self.t = self.x[chosen], self.value[chosen], t
        self.start = self.x.copy()

    def measure(self) -> None:
        """Find the walkers' levels; fit a guide where the values behind them are known."""
        if self.values is None:
            self.value = self.level(self.x)
        else:
            values = self.values(self.x)
            self.value = np.abs(values).max(1)
            self.guide = _fit_guide(self.x, values, self.box)

    def forget(self, target: float) -> float:
        """Move until the correlation of the walkers with where they started is below target; return it."""
        accepted, proposed, correlation = 0, 0, 1.0
        for step in range(1, _MAX_STEPS + 1):
            accepted += self._sweep(local=step % 2 == 0)
            proposed += len(self.x)
            if (step % 4 == 0 or self.guide is not None) and (correlation := self._correlation()) < target:
                break
        self.acceptance = accepted / proposed
        if self.guide is None or self.t > 1.0:  # with a guide the levels are known, and in the region it has settled
            self.measure()
        return correlation

    def _correlation(self) -> float:
        a, b = self.start - self.start.mean(0), self.x - self.x.mean(0)
        return float(((a * b).sum(0) / np.sqrt((a**2).sum(0) * (b**2).sum(0))).max())

    def _sweep(self, local: bool) -> int:
        """One step for every walker; returns how many were accepted."""
        order = self.rng.permutation(len(self.x))
        half = len(order) // 2
        accepted = 0
        for mine, other in ((order[:half], order[half:]), (order[half:], order[:half])):
            x, rest = self.x[mine], self.x[other]
            if self.guide is None:
                new, possible = self._local(x, rest) if local else self._global(x, rest)
                possible &= self.box.contains(new)
            else:
                new, possible = self._detour(x, rest, self.guide)
            rows = np.flatnonzero(possible)
            self.evaluations += len(rows)
            if self.guide is None:
                rows = rows[self.below(new[rows], self.t)]
            else:  # most arrive below the level: trying to see soon that they do not would not pay
                value = self.level(new[rows])
                good = value < self.t
                rows = rows[good]
                self.value[mine[rows]] = value[good]
            self.x[mine[rows]] = new[rows]
            accepted += len(rows)
        return accepted

    def _detour(self, x: FloatArray, rest: FloatArray, guide: _Guide) -> tuple[FloatArray, BoolArray]:
        """End points of chains under the guide's log density s, and whether they pass the part of the acceptance that is not
        the level's: a uniform number below s(x) / s(y)."""
        y = x.copy()
        begin = value = guide.log_density(x, self.t)
        # the kind of a step is drawn: a fixed order of two kinds would not be the same forth and back, as the acceptance needs
        for local in self.rng.random(_DETOUR) < 0.25:
            new, possible = self._local(y, rest) if local else self._global(y, rest)
            rows = np.flatnonzero(possible & self.box.contains(new))
            proposed = guide.log_density(new[rows], self.t)
            good = np.log(self.rng.random(len(rows))) < proposed - value[rows]
            rows = rows[good]
            y[rows] = new[rows]
            value = value.copy()
            value[rows] = proposed[good]
        return y, np.log(self.rng.random(len(x))) < begin - value

    def _lengths(self, m: int) -> FloatArray:
        # around the optimal size for a d-dimensional body, spread over half a decade
        return 2.38 / np.sqrt(2 * self.box.d) * 10.0 ** self.rng.uniform(-0.4, 0.2, m)

    def _global(self, x: FloatArray, rest: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Steps along differences of any two of the other half; a tenth of length 1, which jump between separate parts."""
        m, rng = len(x), self.rng
        first = rng.integers(len(rest), size=m)
        second = (first + rng.integers(1, len(rest), size=m)) % len(rest)
        gamma = self._lengths(m)
        gamma[rng.random(m) < 0.1] = 1.0
        jitter = 1e-6 * (self.box.upper - self.box.lower) * rng.standard_normal(x.shape)
        return x + gamma[:, None] * (rest[first] - rest[second]) + jitter, np.ones(m, bool)

    def _local(self, x: FloatArray, rest: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Steps that follow a bent region: cells around random members of the other half, differences within a cell.

        A step that leaves its cell is refused, which keeps the step's distribution the same forth and back.
        """
        m, rng = len(x), self.rng
        spread = np.maximum(rest.std(0), 1e-300)
        centres = rest[rng.permutation(len(rest))[: max(2, len(rest) // (8 * (self.box.d + 1)))]] / spread
        cell = _nearest(rest / spread, centres)
        by_cell = np.argsort(cell, kind="stable")
        size = np.bincount(cell, minlength=len(centres))
        begin = np.cumsum(size) - size
        mine = _nearest(x / spread, centres)
        members = np.maximum(size[mine], 1)
        first = rng.integers(0, members)
        second = (first + rng.integers(1, np.maximum(members, 2))) % members
        last = len(rest) - 1
        a = rest[by_cell[np.minimum(begin[mine] + first, last)]]
        b = rest[by_cell[np.minimum(begin[mine] + second, last)]]
        new = x + self._lengths(m)[:, None] * (a - b)
        return new, (size[mine] > self.box.d + 1) & (_nearest(new / spread, centres) == mine)


@dataclass(frozen=True)
class _Guide:
    """Polynomials of the values, and the relative error of their level (standard deviation at points kept out)."""

    polynomial: Polynomial
    error: float

    def log_density(self, x: FloatArray, t: float) -> FloatArray:
        """0 (m,) where the polynomials' level is below t, falling outside as slowly as it is uncertain where that is."""
        beyond = np.abs(self.polynomial(x)).max(1) / t - 1.0
        return np.asarray(-np.maximum(beyond, 0.0) / max(self.error, 1e-3), float)


def _fit_guide(x: FloatArray, values: FloatArray, box: Box) -> _Guide | None:
    """A guide from the values (m, q) at the walkers x (m, d), None where polynomials do not follow them."""
    copies = np.random.default_rng(0).permutation(len(x))  # walkers of one origin are not side by side
    kept_out, used = copies[: len(x) // 5], copies[len(x) // 5 :]
    polynomial = fit_polynomial(x[used], values[used], box.lower, box.upper, np.zeros(box.d, bool))
    exact = np.abs(values[kept_out]).max(1)
    off = (np.abs(polynomial(x[kept_out])).max(1) - exact) / np.maximum(exact, np.median(exact))
    error = float(off.std())
    return _Guide(polynomial, error) if error < _GUIDE_ERROR else None


def _nearest(x: FloatArray, centres: FloatArray) -> NDArray[np.int64]:
    """Number of the nearest centre (c, d) for each point (m, d)."""
    return np.argmin((centres**2).sum(1) - 2.0 * (x @ centres.T), axis=1)
