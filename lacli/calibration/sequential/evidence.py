"""Runs against the targets: residuals in units of the measurement's error, decorrelated, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import LacliError
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.targets import Targets
from lacli.inference.runs import STATUS, RunLog


@dataclass(frozen=True)
class Evidence:
    """Finished runs: x, z (n, d) their inputs; residual (n, p) = L^-1 (f - target), L L' the targets' covariance; jacobian
    (n, p, d) = d residual / dz, NaN where a run tells no derivatives; failed (k, d): z of runs that failed."""

    x: FloatArray
    z: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    failed: FloatArray

    @property
    def told(self) -> BoolArray:
        """Which runs tell derivatives (n,)."""
        return np.asarray(np.isfinite(self.jacobian).all((1, 2)))

    @property
    def misfit(self) -> FloatArray:
        """chi^2 (n,) of each run: its squared residual, summed."""
        return np.asarray((self.residual**2).sum(1))

    def take(self, rows: FloatArray | list[int] | BoolArray) -> Evidence:
        """Some of the runs."""
        return Evidence(self.x[rows], self.z[rows], self.residual[rows], self.jacobian[rows], self.failed)


def factor(targets: Targets) -> FloatArray:
    """(p, p) lower triangle L of the targets' covariance."""
    covariance = np.diag(targets.sd**2) if targets.covariance is None else targets.covariance
    return np.asarray(np.linalg.cholesky(covariance))


def gather(log: RunLog, x: FloatArray, targets: Targets, scale: Scale) -> Evidence:
    """The evidence of the runs at x (m, d), which are in the log. Raises LacliError where a finished run lacks a target."""
    frame = log.frame(x)
    done = (frame[STATUS] == "done").to_numpy()
    y = frame.loc[done, list(targets.names)].to_numpy(float)
    lacking = [name for name, known in zip(targets.names, np.isfinite(y).all(0), strict=True) if not known]
    if lacking:
        raise LacliError(
            f"calibrate: the runs have no {', '.join(lacking[:6])}{' ...' if len(lacking) > 6 else ''}: the bundle lacks the "
            "data for it (universal coordinates, fibres), or its time is none of the simulation's. Remove it from the targets."
        )
    x_done = x[done]
    whitening = factor(targets)
    residual = solve_triangular(whitening, (y - targets.mean).T, lower=True).T
    slopes = log.gradients(x_done, targets.names) * scale.slope(x_done)[:, :, None]
    jacobian = np.full((len(x_done), len(targets.names), scale.box.d), np.nan)
    for row, slope in zip(jacobian, slopes, strict=True):
        if np.isfinite(slope).all():
            row[:] = solve_triangular(whitening, slope.T, lower=True)
    return Evidence(x_done, scale.to_z(x_done), residual, jacobian, scale.to_z(x[~done]))
