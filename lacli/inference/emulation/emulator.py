"""Emulators of a simulator's outputs: scales chosen by likelihood, a Gaussian process, a calibrated spread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.threads import single_threaded
from lacli.contracts.tables.table import RunTable
from lacli.inference.emulation import gp
from lacli.inference.emulation.scales import OutputScale, Scaled, choose_scales, coordinates, may_be_logarithmic, scale

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
    (T(y) - shift) / scale, T the output's scale. Its predictive variance is multiplied by ``inflation``, found by
    cross-validation within the training runs; held_out_r2 is R2 of the output there. error_sd: root mean square of the
    runs' known errors, in the output's units: part of what separates a simulation from the truth, though not of predict.
    """

    output: str
    log_inputs: BoolArray
    low: FloatArray
    high: FloatArray
    output_scale: OutputScale
    shift: float
    scale: float
    inflation: float
    held_out_r2: float
    error_sd: float
    process: gp.GP

    def to_u(self, x: FloatArray) -> FloatArray:
        """Inputs (m, d) in their units -> the process's coordinates (m, d)."""
        return coordinates(x, self.log_inputs, self.low, self.high)

    def predict(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m,) and variance (m,) of the simulator's output at x (m, d), in the output's units and its square."""
        mean, variance = self.process.predict(self.to_u(x))
        return self.output_scale.moments(self.shift + self.scale * mean, (self.inflation * self.scale**2) * variance)

    def left_out_ise(self) -> float:
        """Share of the runs within two standard deviations of what is said of them when each is left out, hyperparameters as they
        are (independent standard errors)."""
        error, variance = self.process.leave_one_out()
        y = self.process.y
        mean, spread = self.output_scale.moments(
            self.shift + self.scale * (y - error), (self.inflation * self.scale**2) * variance
        )
        truth = self.output_scale.backward(self.shift + self.scale * y)
        return float((np.abs(truth - mean) < 2.0 * np.sqrt(spread)).mean())


@single_threaded
def fit_emulator(
    x: FloatArray,
    y: FloatArray,
    output: str = "y",
    error_sd: FloatArray | None = None,
    *,
    starts: int = 3,
    seed: int = 0,
    may_log: BoolArray | None = None,
) -> Emulator:
    """Fit one output.

    x (n, d); y (n,); error_sd (n,) known noise, one standard deviation, or None; may_log (d,): inputs that may be taken on a
    logarithmic scale, by the runs where None. The scales of the output and of each
    input are those of greatest restricted likelihood (``scales``). The same seed gives the same bits.
    """
    rng = np.random.default_rng(seed)
    noise_sd = np.zeros_like(y) if error_sd is None else error_sd
    start = gp.starting_points(x.shape[1], starts, rng)
    # scales are chosen on at most _SELECTION runs (every few of a design in random order): the cost grows as n^3
    every = np.arange(0, len(x), max(1, -(-len(x) // _SELECTION)))
    choice = choose_scales(x[every], y[every], noise_sd[every], start[0], may_be_logarithmic(x) if may_log is None else may_log)
    data = scale(x, y, noise_sd, choice.data.log_inputs, choice.data.output)
    theta, value = gp.maximise(data.u, data.y, data.noise, [choice.theta, *start[1:]])
    # the order in which runs tell most: the first few already bound the variance from above (EmulatorSet.screen)
    order = gp.pivots(theta, data.u)
    inflation, r2 = _calibration(data, theta, rng)
    return Emulator(
        output=output, log_inputs=data.log_inputs, low=data.low, high=data.high, output_scale=data.output,
        shift=data.shift, scale=data.scale, inflation=inflation, held_out_r2=r2,
        error_sd=float(np.sqrt(np.mean(noise_sd**2))),
        process=gp.condition(theta, data.u[order], data.y[order], data.noise[order], value),
    )  # fmt: skip


def folds(n: int, count: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """A random split of n runs into ``count`` parts of nearly equal size."""
    return [np.sort(part) for part in np.array_split(rng.permutation(n), min(count, n))]


def _calibration(data: Scaled, theta: FloatArray, rng: np.random.Generator) -> tuple[float, float]:
    """Factor for the variance with which the stated share of held-out errors, in the output's units, lies within two
    standard deviations; R2.

    Each part's hyperparameters are refitted without it: errors at fixed ones are too small, which is why an
    uncalibrated process claims 95 % and covers less.
    """
    n = len(data.y)
    held_out, means, variances = [], [], []
    repeats = max(1, round(_CALIBRATION_ERRORS / n))
    for _ in range(repeats):
        for part in folds(n, CALIBRATION_FOLDS, rng):
            rest = np.setdiff1d(np.arange(n), part)
            u, y, noise = data.u[rest], data.y[rest], data.noise[rest]
            refitted, _ = gp.maximise(u, y, noise, [theta], max_iterations=12)
            mean, variance = gp.condition(refitted, u, y, noise).predict(data.u[part])
            held_out.append(part)
            means.append(mean)
            variances.append(variance + data.noise[part])
    y = data.y[np.concatenate(held_out)]
    needed = _needed_inflation(data, y, np.concatenate(means), np.concatenate(variances))
    # the empirical quantile with n + 1 places, so that few runs lean to the wide side
    level = min(1.0, _TARGET_COVERAGE * (n + 1) / n)
    inflation = float(np.clip(np.quantile(np.sqrt(needed), level) ** 2, *_RESCALE_BOUNDS))
    predicted, _ = _in_units(data, np.concatenate(means), inflation * np.concatenate(variances))
    truth = data.output.backward(data.shift + data.scale * y)
    r2 = 1.0 - float(((truth - predicted) ** 2).sum() / ((truth - truth.mean()) ** 2).sum())
    return inflation, r2


def _in_units(data: Scaled, mean: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The process's moments -> the output's."""
    return data.output.moments(data.shift + data.scale * mean, data.scale**2 * variance)


def _needed_inflation(data: Scaled, y: FloatArray, mean: FloatArray, variance: FloatArray) -> FloatArray:
    """The least factor (m,) of each variance with which the output is within two of its standard deviations of its mean."""
    if not data.output.log:
        return (y - mean) ** 2 / (4.0 * variance)
    truth = data.output.backward(data.shift + data.scale * y)
    low, high = (np.full(len(y), np.log(edge)) for edge in (1e-6, 2.0 * _RESCALE_BOUNDS[1]))
    for _ in range(30):  # a log-normal's mean moves with its variance: bisection
        middle = 0.5 * (low + high)
        m, v = _in_units(data, mean, np.exp(middle) * variance)
        inside = np.abs(truth - m) < 2.0 * np.sqrt(v)
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    return np.exp(high)


def fit_emulators(
    table: RunTable,
    *,
    starts: int = 3,
    seed: int = 0,
    tick: Callable[[], None] | None = None,
    may_log: BoolArray | None = None,
) -> list[Emulator]:
    """An emulator for each output of the table, in its order; ``tick`` is called after each; may_log as in
    ``fit_emulator``."""
    result = []
    for j, name in enumerate(table.outputs):
        result.append(fit_emulator(table.x, table.y[:, j], name, table.error_sd[:, j], starts=starts, seed=seed, may_log=may_log))
        if tick is not None:
            tick()
    return result
