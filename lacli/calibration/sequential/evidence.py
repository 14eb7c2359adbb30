"""Runs against the targets: residuals in units of the measurement's error, decorrelated, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_triangular

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.base.errors import LacliError
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.priors import check_priors
from lacli.contracts.targets import Targets
from lacli.inference.box import Box, make_box
from lacli.inference.runs import STATUS, RunLog

if TYPE_CHECKING:
    from lacli.calibration.sequential.fidelity.correction import Correction


@dataclass(frozen=True)
class Evidence:
    """Finished runs: x, z (n, d) their inputs; residual (n, p + q) = L^-1 (f - target), L L' the targets' covariance, followed by
    those of q priors; jacobian (n, p + q, d) = d residual / dz, NaN where a run tells no derivatives; failed (k, d): z of runs
    that failed; targets: p; spread (n, p): how far two equilibria of a run are apart, in each target's standard deviations, 0
    where it is not known. Of cheap runs that were corrected: by what, and which are the reference's own (n,)."""

    x: FloatArray
    z: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    failed: FloatArray
    targets: int
    spread: FloatArray
    correction: Correction | None = None
    dear: BoolArray | None = None

    @property
    def chi2(self) -> FloatArray:
        """Of the targets alone (n,), without the priors."""
        return np.asarray((self.residual[:, : self.targets] ** 2).sum(1))

    @property
    def told(self) -> BoolArray:
        """Which runs tell derivatives (n,)."""
        return np.asarray(np.isfinite(self.jacobian).all((1, 2)))

    @property
    def misfit(self) -> FloatArray:
        """chi^2 (n,) of each run: its squared residual, summed; -2 log posterior, up to a constant."""
        return np.asarray((self.residual**2).sum(1))

    @property
    def own(self) -> BoolArray:
        """Which runs are the reference's own (n,), told by no correction."""
        return np.ones(len(self.z), bool) if self.dear is None else self.dear

    @property
    def best(self) -> int:
        """The row of the lowest misfit among runs that tell derivatives; of the reference's own, where one does."""
        told = self.told & self.own if (self.told & self.own).any() else self.told
        return int(np.argmin(np.where(told, self.misfit, np.inf)))

    def take(self, rows: IntArray | list[int] | BoolArray) -> Evidence:
        """Some of the runs."""
        return replace(
            self, x=self.x[rows], z=self.z[rows], residual=self.residual[rows], jacobian=self.jacobian[rows],
            spread=self.spread[rows],
            dear=None if self.dear is None else self.dear[rows],
        )  # fmt: skip


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
    of_priors, slopes_of_priors = _prior_rows(targets, x_done, scale)
    told = np.isfinite(jacobian).all((1, 2))
    slopes_of_priors[~told] = np.nan
    return Evidence(
        x_done, scale.to_z(x_done), np.hstack([residual, of_priors]), np.concatenate([jacobian, slopes_of_priors], axis=1),
        scale.to_z(x[~done]), len(targets.names), np.nan_to_num(log.spread(x_done, targets.names)) / targets.sd,
    )  # fmt: skip


def narrowed(box: Box, targets: Targets) -> Box:
    """The box within the ends at which priors are cut off. Raises UsageError for a prior of no input, or outside of the box."""
    check_priors(targets.priors, box.names, box.lower, box.upper)
    lower, upper = box.lower.copy(), box.upper.copy()
    for prior in targets.priors or ():
        i = box.names.index(prior.name)
        lower[i], upper[i] = max(lower[i], prior.lower), min(upper[i], prior.upper)
    return make_box(box.names, lower.tolist(), upper.tolist())


def _prior_rows(targets: Targets, x: FloatArray, scale: Scale) -> tuple[FloatArray, FloatArray]:
    """Residuals (n, q) of the priors that are not uniform, and their derivatives by z (n, q, d)."""
    shaped = [prior for prior in targets.priors or () if prior.distribution != "uniform"]
    residual, jacobian = np.zeros((len(x), len(shaped))), np.zeros((len(x), len(shaped), scale.box.d))
    for k, prior in enumerate(shaped):
        i = scale.box.names.index(prior.name)
        residual[:, k], slope = prior.residual(x[:, i])
        jacobian[:, k, i] = slope * scale.slope(x)[:, i]
    return residual, jacobian
