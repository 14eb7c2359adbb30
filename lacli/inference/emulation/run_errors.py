"""Errors that runs carry of their own (discretisation), as a variance over the box: where runs are rough, targets bind less.

The runs tell their error at their own inputs. Its variance is emulated as exp(quadratic in the inputs), fitted by least squares
in its logarithm, kept within what the runs tell, and of their mean at the runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray
from lacli.inference.emulation.emulator import Emulator
from lacli.inference.emulation.scales import coordinates

# an exact run beside rough ones: its logarithm would be none
_FLOOR = 1e-6
_RIDGE = 1e-3
# runs for each coefficient; with fewer the variance is linear in its logarithm, or the same everywhere
_RUNS_EACH = 3


@dataclass(frozen=True)
class RunErrors:
    """Variance of one output's own error over the box: exp(basis(u) @ coefficients), from least to most; u as the emulator's
    (log_inputs, low, high (d,): ``scales.coordinates``)."""

    log_inputs: BoolArray
    low: FloatArray
    high: FloatArray
    coefficients: FloatArray
    least: float
    most: float

    def __call__(self, x: FloatArray) -> FloatArray:
        """Variance (m,) at x (m, d), in the output's unit squared."""
        # out of the runs' range the nearest that they tell
        u = np.clip(coordinates(x, self.log_inputs, self.low, self.high), -1.0, 1.0)
        return np.clip(np.exp(_basis(u, len(self.coefficients)) @ self.coefficients), self.least, self.most)


def run_errors(emulator: Emulator) -> RunErrors | None:
    """The variance of an output's own error, None where its runs tell none."""
    e = emulator
    return told_errors(_variances(e), e.process.u, e.log_inputs, e.low, e.high)


def told_errors(told: FloatArray, u: FloatArray, log_inputs: BoolArray, low: FloatArray, high: FloatArray) -> RunErrors | None:
    """The variance over the box, None where no run tells any: told (n,) variances at u (n, d), coordinates by the rest."""
    mean = float(told.mean())
    if mean == 0.0:
        return None
    floored = np.maximum(told, _FLOOR * mean)
    n, d = u.shape
    size = next((k for k in (1 + 2 * d, 1 + d) if n >= _RUNS_EACH * k), 1)
    basis = _basis(u, size)
    # the constant is free, the rest is held back a little: two inputs may be nearly one in the runs
    penalty = np.diag([0.0] + [_RIDGE * n] * (size - 1))
    coefficients = np.linalg.solve(basis.T @ basis + penalty, basis.T @ np.log(floored))
    found = RunErrors(log_inputs, low, high, coefficients, float(floored.min()), float(floored.max()))
    fitted = np.exp(basis @ coefficients)
    coefficients[0] += np.log(mean / fitted.mean())
    return found


def _basis(u: FloatArray, size: int) -> FloatArray:
    """One, the inputs (m, d), their squares: the first ``size`` of them."""
    return np.hstack([np.ones((len(u), 1)), u, u**2])[:, :size]


def _variances(emulator: Emulator) -> FloatArray:
    """Variance (n,) of each training run's own error, in the output's unit squared."""
    process, output = emulator.process, emulator.output_scale
    y = output.backward(emulator.shift + emulator.scale * process.y)
    return np.asarray(process.noise * (emulator.scale / np.exp(output.log_slope(y))) ** 2, float)
