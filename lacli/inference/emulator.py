"""Emulators of a simulator's outputs: scales chosen by likelihood, a Gaussian process, a calibrated spread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lacli.inference import gp
from lacli.inference.table import RunTable
from lacli.inference.threads import single_threaded

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# an input that spans a ratio this large may act on a logarithmic scale (stiffness, exponents, springs)
_LOG_RATIO = 3.0
# calibration: this share of the cross-validation errors is to lie within two standard deviations
_TARGET_COVERAGE = 0.955
_RESCALE_BOUNDS = (0.25, 16.0)
CALIBRATION_FOLDS = 5
_SELECTION = 240
# splits times runs used for calibration: one split's quantile is too noisy an estimate where runs are few
_CALIBRATION_ERRORS = 500


@dataclass(frozen=True)
class Emulator:
    """One output's emulator.

    u = 2 (t(x) - low) / (high - low) - 1 with t = log where ``log_inputs`` (d,); the process models
    (T(y) - shift) / scale with T = log where ``log_output``. Its predictive variance is multiplied by ``inflation``,
    found by cross-validation within the training runs; held_out_r2 is R2 of the standardised output there.
    """

    output: str
    log_inputs: BoolArray
    low: FloatArray
    high: FloatArray
    log_output: bool
    shift: float
    scale: float
    inflation: float
    held_out_r2: float
    process: gp.GP

    def to_u(self, x: FloatArray) -> FloatArray:
        """Inputs (m, d) in their units -> the process's coordinates (m, d)."""
        return _coordinates(x, self.log_inputs, self.low, self.high)

    def predict(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m,) and variance (m,) of the simulator's output at x (m, d), in the output's units and its square."""
        mean, variance = self.process.predict(self.to_u(x))
        return self.to_output(mean, variance)

    def to_output(self, mean: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The process's mean and variance -> the output's (moments of a log-normal where the output is a logarithm)."""
        mean = self.shift + self.scale * mean
        variance = (self.inflation * self.scale**2) * variance
        if not self.log_output:
            return mean, variance
        mean = np.exp(mean + 0.5 * variance)
        return mean, np.expm1(variance) * mean**2


def _coordinates(x: FloatArray, log_inputs: BoolArray, low: FloatArray, high: FloatArray) -> FloatArray:
    t = np.array(x, float)
    t[:, log_inputs] = np.log(t[:, log_inputs])
    return 2.0 * (t - low) / (high - low) - 1.0


@dataclass(frozen=True)
class _Scaled:
    """Training data on one choice of scales, ready for the process."""

    u: FloatArray
    y: FloatArray
    noise: FloatArray
    low: FloatArray
    high: FloatArray
    shift: float
    scale: float
    log_inputs: BoolArray
    log_output: bool
    log_jacobian: float


def _scale(x: FloatArray, y: FloatArray, error_sd: FloatArray, log_inputs: BoolArray, log_output: bool) -> _Scaled:
    t = x.copy()
    t[:, log_inputs] = np.log(t[:, log_inputs])
    low, high = t.min(0), t.max(0)
    high = np.where(high > low, high, low + 1.0)  # a subset of the runs may hold an input still
    value = np.log(y) if log_output else y
    shift, scale = float(value.mean()), float(value.std()) or 1.0
    sd = error_sd / y if log_output else error_sd
    # log density of y rather than of the standardised value, so that scales can be compared
    jacobian = -len(y) * np.log(scale) - (np.log(y).sum() if log_output else 0.0)
    return _Scaled(
        u=2.0 * (t - low) / (high - low) - 1.0, y=(value - shift) / scale, noise=(sd / scale) ** 2,
        low=low, high=high, shift=shift, scale=scale, log_inputs=log_inputs, log_output=log_output,
        log_jacobian=float(jacobian),
    )  # fmt: skip


def _evidence(data: _Scaled, objective: float) -> float:
    """Log restricted likelihood of the raw output, comparable between input scales (Harville's basis correction)."""
    h = gp.basis(data.u)
    return -objective + 0.5 * float(np.linalg.slogdet(h.T @ h)[1]) + data.log_jacobian


@single_threaded
def fit_emulator(
    x: FloatArray, y: FloatArray, output: str = "y", error_sd: FloatArray | None = None, *, starts: int = 3, seed: int = 0
) -> Emulator:
    """Fit one output.

    x (n, d); y (n,); error_sd (n,) known noise, one standard deviation, or None. The scale of the output and of each
    input (linear or logarithmic) is the one of greater restricted likelihood. The same seed gives the same bits.
    """
    rng = np.random.default_rng(seed)
    noise_sd = np.zeros_like(y) if error_sd is None else error_sd
    d = x.shape[1]
    eligible = (x.min(0) > 0) & (x.max(0) > _LOG_RATIO * np.maximum(x.min(0), 1e-300))
    none = np.zeros(d, bool)
    input_scales = [none, eligible] if eligible.any() else [none]
    output_scales = [False, True] if y.min() > 0 else [False]
    start = gp.starting_points(d, starts, rng)
    # scales are chosen on at most _SELECTION runs (every few of a design in random order): the cost grows as n^3
    every = np.arange(0, len(x), max(1, -(-len(x) // _SELECTION)))
    sub = (x[every], y[every], noise_sd[every])
    best: tuple[float, _Scaled, FloatArray, float] | None = None
    for log_output in output_scales:
        for log_inputs in input_scales:
            data = _scale(*sub, log_inputs, log_output)
            theta, value = gp.maximise(data.u, data.y, data.noise, start[:1])
            evidence = _evidence(data, value)
            if best is None or evidence > best[0]:
                best = (evidence, data, theta, value)
    assert best is not None
    evidence, data, theta, value = best
    for j in np.flatnonzero(eligible):  # one pass: would this input do better on the other scale?
        flipped = data.log_inputs.copy()
        flipped[j] = not flipped[j]
        other = _scale(*sub, flipped, data.log_output)
        other_theta, other_value = gp.maximise(other.u, other.y, other.noise, [theta], max_iterations=8)
        if (other_evidence := _evidence(other, other_value)) > evidence:
            evidence, data, theta, value = other_evidence, other, other_theta, other_value
    data = _scale(x, y, noise_sd, data.log_inputs, data.log_output)
    theta, value = gp.maximise(data.u, data.y, data.noise, [theta, *start[1:]])
    # the order in which runs tell most: the first few already bound the variance from above (EmulatorSet.screen)
    order = gp.pivots(theta, data.u)
    emulator = Emulator(
        output=output, log_inputs=data.log_inputs, low=data.low, high=data.high, log_output=data.log_output,
        shift=data.shift, scale=data.scale, inflation=1.0, held_out_r2=0.0,
        process=gp.condition(theta, data.u[order], data.y[order], data.noise[order], value),
    )  # fmt: skip
    inflation, r2 = _calibration(data, theta, rng)
    return replace(emulator, inflation=inflation, held_out_r2=r2)


def folds(n: int, count: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """A random split of n runs into ``count`` parts of nearly equal size."""
    return [np.sort(part) for part in np.array_split(rng.permutation(n), min(count, n))]


def _calibration(data: _Scaled, theta: FloatArray, rng: np.random.Generator) -> tuple[float, float]:
    """Factor for the variance with which the stated share of held-out errors lies within two standard deviations; R2.

    Each part's hyperparameters are refitted without it: errors at fixed ones are too small, which is why an
    uncalibrated process claims 95 % and covers less.
    """
    n = len(data.y)
    z, squares = [], 0.0
    repeats = max(1, round(_CALIBRATION_ERRORS / n))
    for _ in range(repeats):
        for part in folds(n, CALIBRATION_FOLDS, rng):
            rest = np.setdiff1d(np.arange(n), part)
            u, y, noise = data.u[rest], data.y[rest], data.noise[rest]
            refitted, _ = gp.maximise(u, y, noise, [theta], max_iterations=12)
            mean, variance = gp.condition(refitted, u, y, noise).predict(data.u[part])
            error = data.y[part] - mean
            squares += float(error @ error)
            z.append(error / np.sqrt(variance + data.noise[part]))
    # the empirical quantile with n + 1 places, so that few runs lean to the wide side
    level = min(1.0, _TARGET_COVERAGE * (n + 1) / n)
    inflation = (np.quantile(np.abs(np.concatenate(z)), level) / 2.0) ** 2
    return float(np.clip(inflation, *_RESCALE_BOUNDS)), 1.0 - squares / (repeats * n)


def fit_emulators(table: RunTable, *, starts: int = 3, seed: int = 0, tick: Callable[[], None] | None = None) -> list[Emulator]:
    """An emulator for each output of the table, in its order; ``tick`` is called after each."""
    result = []
    for j, name in enumerate(table.outputs):
        result.append(fit_emulator(table.x, table.y[:, j], name, table.error_sd[:, j], starts=starts, seed=seed))
        if tick is not None:
            tick()
    return result
