"""History matching: implausibility, waves, the region not ruled out yet (NROY), and the next runs.

I(x)^2 = max over outputs of (E f(x) - mu)^2 / (Var f(x) + sigma^2). Where the targets' errors are correlated, the maximum
is over the components that are not as well: combinations w of outputs, the eigenvectors of the errors' correlation, with
(w (E f - mu))^2 / (sum w^2 Var f + w S w). Two targets that err together tell by their difference what neither tells alone.
A wave rules out what has I >= threshold; the region is what no wave has ruled out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from lacli.base.arrays import FloatArray
from lacli.base.threads import single_threaded
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.design import farthest
from lacli.inference.emulation.emulator_set import AnyEmulators
from lacli.inference.matching.nroy import RegionSample, sample_region

# a region smaller than this share of the sweep's points is measured by nested levels instead
_FEWEST_INSIDE = 400
_WALKERS = 2000
_LEAST_VARIANCE = 1e-9  # of a component, in the targets' own variances: rounding may leave less than nothing


@dataclass(frozen=True)
class Wave:
    """One wave: emulators of the outputs of ``targets`` (same order) and the threshold on I."""

    emulators: AnyEmulators
    targets: Targets
    threshold: float

    @cached_property
    def components(self) -> tuple[FloatArray, FloatArray]:
        """Weights (q, p) of the whitened components on the outputs, and variances (q,): combinations of targets whose
        errors are not correlated; none (q = 0) where those of the targets are not."""
        covariance, sd = self.targets.covariance, self.targets.sd
        if covariance is None or np.allclose(
            covariance, np.diag(np.diag(covariance)), rtol=0.0, atol=1e-12 * float(sd.max()) ** 2
        ):
            return np.empty((0, len(sd))), np.empty(0)
        variance, vectors = np.linalg.eigh(covariance / np.outer(sd, sd))
        return vectors.T / sd, np.maximum(variance, _LEAST_VARIANCE)

    def _whitened(self, mean: FloatArray, variance: FloatArray) -> FloatArray:
        """The components' signed implausibilities (m, q) from predicted mean and variance (m, p)."""
        weights, own = self.components
        return ((mean - self.targets.mean) @ weights.T) / np.sqrt(variance @ (weights**2).T + own)

    def signed(self, x: FloatArray) -> FloatArray:
        """(E f - mu) / sqrt(Var f + sigma^2) (m, p + q) of each output and each whitened component at x (m, d); Var f with the
        runs' own error."""
        return self.signed_of(*self.emulators.predict_truth(x))

    def signed_of(self, mean: FloatArray, variance: FloatArray) -> FloatArray:
        """The same from predicted mean and variance (m, p)."""
        alone = (mean - self.targets.mean) / np.sqrt(variance + self.targets.sd**2)
        return np.hstack([alone, self._whitened(mean, variance)])

    def implausibility(self, x: FloatArray) -> FloatArray:
        """I (m, p + q) of each output and component at x (m, d); the largest is the wave's implausibility."""
        return np.abs(self.signed(x))

    def level(self, x: FloatArray) -> FloatArray:
        """max over outputs and components of I / threshold (m,): below 1 where the wave rules nothing out."""
        return self.implausibility(x).max(1) / self.threshold

    def below(self, x: FloatArray, t: float) -> NDArray[np.bool_]:
        """Whether level(x) < t (m,), at a fraction of its cost.

        Outputs are tried one after another, the one that rules out most first, only at points still open, and with bounds
        of the variance; the variance itself is computed where the bounds leave the question open.
        """
        bound = t * self.threshold
        if len(x) <= 32:
            return self.level(x) < t
        open_ = np.arange(len(x))
        for j in self._order():
            rows = x[open_]
            mu, noise = self.targets.mean[j], self.targets.sd[j] ** 2 + self.emulators.error_variance(j, rows)
            m0, m1, v0, v1 = self.emulators.screen(j, rows)
            away = np.maximum(np.maximum(m0 - mu, mu - m1), 0.0)  # m0 <= mean <= m1
            out = away >= bound * np.sqrt(v1 + noise)
            sure = np.maximum(np.abs(m0 - mu), np.abs(m1 - mu)) < bound * np.sqrt(v0 + noise)
            unclear = np.flatnonzero(~(out | sure))
            if len(unclear):
                mean, variance = self.emulators.predict_one(j, rows[unclear])
                out[unclear] = np.abs(mean - mu) >= bound * np.sqrt(variance + noise[unclear])
            open_ = open_[~out]
            if not len(open_):
                break
        if len(open_) and len(self.components[1]):
            open_ = open_[(np.abs(self._whitened(*self.emulators.predict_truth(x[open_]))) < bound).all(axis=1)]
        result = np.zeros(len(x), bool)
        result[open_] = True
        return result

    def _order(self) -> list[int]:
        """Outputs from the one that rules out most of the training range to the one that rules out least."""
        if not hasattr(self, "_cached_order"):
            low, high = self.emulators.range()
            x = low + np.random.default_rng(0).random((512, len(low))) * (high - low)
            order = np.argsort(-np.median(self.implausibility(x)[:, : len(self.targets.names)], axis=0), kind="stable")
            object.__setattr__(self, "_cached_order", [int(j) for j in order])
        return self._cached_order  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Region:
    """What no wave has ruled out within the box; ``waves`` empty: the whole box."""

    box: Box
    waves: tuple[Wave, ...] = ()

    def level(self, x: FloatArray) -> FloatArray:
        """Largest level over the waves (m,); below 1 in the region."""
        value = np.zeros(len(x))
        for wave in self.waves:
            np.maximum(value, wave.level(x), out=value)
        return value

    def below(self, x: FloatArray, t: float) -> NDArray[np.bool_]:
        """Whether level(x) < t (m,)."""
        result = np.ones(len(x), bool)
        for wave in reversed(self.waves):  # the last wave rules out most
            rows = np.flatnonzero(result)
            result[rows] = wave.below(x[rows], t)
        return result

    def values(self, x: FloatArray) -> FloatArray:
        """Signed implausibilities over thresholds (m, q) of all outputs and waves; the largest modulus is the level."""
        return np.hstack([wave.signed(x) / wave.threshold for wave in self.waves])

    def contains(self, x: FloatArray) -> NDArray[np.bool_]:
        """Whether points (m, d) are in the box and not ruled out."""
        inside = self.box.contains(x)
        rows = np.flatnonzero(inside)
        inside[rows] = self.below(x[rows], 1.0)
        return inside

    def add(self, wave: Wave) -> Region:
        """The region with one more wave."""
        return Region(self.box, (*self.waves, wave))

    def sample(
        self,
        count: int,
        seed: int = 0,
        walkers: int = 2000,
        tick: Callable[[float], None] | None = None,
        start: FloatArray | None = None,
    ) -> RegionSample:
        """``count`` points uniform in the region and its volume; see ``nroy.sample_region``."""
        values = self.values if self.waves else None
        return sample_region(self.level, self.box, count, seed, walkers, tick, self.below, start, values)


@dataclass(frozen=True)
class Sweep:
    """A wave's sweep of the box: points (m, d) of a Latin hypercube, whether each is inside (m,), their share with its
    standard error."""

    points: FloatArray
    inside: NDArray[np.bool_]
    share: float
    share_sd: float


@single_threaded
def sweep(region: Region, count: int = 100_000, seed: int = 0) -> Sweep:
    """Evaluate the region on a Latin hypercube of ``count`` points."""
    points = region.box.from_unit(qmc.LatinHypercube(region.box.d, rng=np.random.default_rng(seed)).random(count))
    if region.box.ordered:
        points = points[region.box.contains(points)]
    inside = region.below(points, 1.0)
    share = float(inside.mean())
    return Sweep(points, inside, share, float(np.sqrt(max(share * (1.0 - share), 1.0 / len(points)) / len(points))))


@dataclass(frozen=True)
class Match:
    """A wave's result: a uniform sample of the region; its share of the box with standard error; change: the share of
    what the wave before would have left at this threshold that the new emulators rule out (NaN for a first wave)."""

    sample: RegionSample
    share: float
    share_sd: float
    change: float


@single_threaded
def match(
    region: Region,
    count: int = 10_000,
    sweep_points: int = 100_000,
    seed: int = 0,
    previous: Match | None = None,
    tick: Callable[[float], None] | None = None,
) -> Match:
    """Measure and sample the region.

    A first wave sweeps the box; where too little of it is left for that, nested levels measure. With the ``previous``
    wave's result the new share is the old one times the share of the old sample that is still inside: far more precise
    than two separate measurements, which is what a stop at 1 % change needs. Raises nroy.EmptyRegionError if nothing is left.
    """
    if previous is not None:
        old = previous.sample.points
        inside = region.contains(old)
        ratio = float(inside.mean())
        wave, before = region.waves[-1], region.waves[-2]
        same = before.level(old) * (before.threshold / wave.threshold) < 1.0
        change = 1.0 - float(inside[same].mean()) if same.any() else 1.0
        if inside.sum() >= _FEWEST_INSIDE:
            share = previous.share * ratio
            relative = (previous.share_sd / previous.share) ** 2 + (1.0 - ratio) / (ratio * len(old))
            start = old[inside] if inside.sum() >= _WALKERS else None
            return Match(region.sample(count, seed, _WALKERS, tick, start), share, share * float(np.sqrt(relative)), change)
    else:
        change = float("nan")
        swept = sweep(region, sweep_points, seed)
        rows = np.flatnonzero(swept.inside)
        if len(rows) >= count:
            points = swept.points[np.sort(np.random.default_rng(seed).permutation(rows)[:count])]
            direct = RegionSample(points, region.level(points), swept.share, swept.share_sd, 1.0, 0.0, len(swept.points))
            return Match(direct, swept.share, swept.share_sd, change)
        if len(rows) >= _FEWEST_INSIDE:
            start = swept.points[rows] if len(rows) >= _WALKERS else None
            return Match(region.sample(count, seed, _WALKERS, tick, start), swept.share, swept.share_sd, change)
    sample = region.sample(count, seed, _WALKERS, tick)
    return Match(sample, sample.volume, sample.volume_sd, change)


def next_runs(sample: RegionSample, count: int, existing: FloatArray) -> FloatArray:
    """``count`` points of the sample spread over it and away from runs done (existing (n, d)).

    Distances are in standard deviations of the sample, so that a thin region is filled along all its directions.
    """
    centre, spread = sample.points.mean(0), np.maximum(sample.points.std(0), 1e-300)
    return sample.points[farthest((sample.points - centre) / spread, count, (existing - centre) / spread)]


def ruled_out_by(wave: Wave, x: FloatArray) -> str:
    """The output that stands furthest from its target at x (1, d), and by how much, in words."""
    value = wave.implausibility(x)[0]
    j = int(value.argmax())
    mean, _ = wave.emulators.predict(x)
    if j >= len(wave.targets.names):
        weights = wave.components[0][j - len(wave.targets.names)] * wave.targets.sd
        most = np.argsort(-np.abs(weights))[:3]
        names = ", ".join(f"{wave.targets.names[k]} ({weights[k]:+.2f})" for k in most)
        return (
            f"targets whose errors go together differ among each other as those errors do not: mostly {names}"
            f" (implausibility of that combination {value[j]:.2f}, threshold {wave.threshold:g})"
        )
    return (
        f"{wave.targets.names[j]} is {mean[0, j]:.4g} where the target is {wave.targets.mean[j]:.4g} ± {wave.targets.sd[j]:.3g}"
        f" (implausibility {value[j]:.2f}, threshold {wave.threshold:g})"
    )
