"""What runs of the reference say of cheap ones: reference = rho cheap + delta, delta learnt from runs made at both.

Kennedy, O'Hagan (2000), Biometrika 87:1: delta is a Gaussian process over the inputs, independent of the cheap one, with a linear
mean; values and derivatives of the difference are its data. One number rho is shared by all targets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.calibration.sequential.emulator import Components, fit
from lacli.calibration.sequential.evidence import Evidence

LEAST = 2  # runs made at both, below which there is no correction
_RHO_SD = 0.3  # rho is expected to be 1 within this
_FLOOR = 1e-4  # of the measurement's variance: differences as small do not weigh more in rho


@dataclass(frozen=True)
class Correction:
    """rho, and delta of the p targets' residuals as a process over z."""

    rho: float
    delta: Components

    def mean(self, z: FloatArray) -> FloatArray:
        """delta (m, p) at z (m, d), in standard deviations of the targets' errors, decorrelated."""
        return np.asarray(self.delta.mean(z) @ self.delta.rotation.T)

    def slope(self, z: FloatArray) -> FloatArray:
        """d delta / dz (p, d) at one point z (d,)."""
        return np.asarray(self.delta.rotation @ self.delta.slope(z))


def pairs(cheap: Evidence, dear: Evidence) -> IntArray:
    """(k, 2): rows of both made at the same inputs."""
    rows = {tuple(x): i for i, x in enumerate(cheap.x.tolist())}
    return np.array([(rows[tuple(x)], j) for j, x in enumerate(dear.x.tolist()) if tuple(x) in rows], int).reshape(-1, 2)


def fit_correction(cheap: Evidence, dear: Evidence) -> Correction | None:
    """From runs at both fidelities; None where they are too few."""
    paired = pairs(cheap, dear)
    of_cheap, of_dear = cheap.take(paired[:, 0]), dear.take(paired[:, 1])
    told = of_cheap.told & of_dear.told
    if told.sum() < LEAST:
        return None
    p = cheap.targets
    z, low, high = of_cheap.z, of_cheap.residual[:, :p], of_dear.residual[:, :p]
    low_slope, high_slope = of_cheap.jacobian[:, :p], of_dear.jacobian[:, :p].copy()
    high_slope[~told] = np.nan
    delta = fit(z, high - low, high_slope - low_slope)
    rho = _rho(delta, delta.rows.observations(low, low_slope), delta.rows.observations(high, high_slope))
    return Correction(rho, fit(z, high - rho * low, high_slope - rho * low_slope, delta))


def far_from_best(cheap: Evidence, dear: Evidence | None) -> FloatArray | None:
    """(n,) how far the cheap runs are from the reference's best, in widths of the box: which of two that contradict each other
    the answer needs. None where the reference tells nothing: by their own misfit, cheap runs fit somewhere else."""
    if dear is None or not dear.told.any():
        return None
    best = int(np.argmin(np.where(dear.told, dear.misfit, np.inf)))
    return np.asarray(np.abs(cheap.z - dear.z[best]).max(1))


def sound(cheap: Evidence, dear: Evidence, off: tuple[BoolArray, BoolArray]) -> tuple[Evidence, Evidence, Evidence]:
    """Without the runs ``off`` of each, which lie on another branch: the cheap ones that a correction may be learnt from, those
    that it is for, and the reference's. A cheap run that is off stays in the second where the reference's own tells of it."""
    dear = dear.take(~off[1])
    kept = ~off[0]
    for i, j in pairs(cheap, dear):
        kept[i] |= dear.told[j]
    return cheap.take(~off[0]), cheap.take(kept), dear


def corrected(cheap: Evidence, dear: Evidence, correction: Correction) -> Evidence:
    """The cheap runs as the reference would tell them: by its own run where there is one, else by the correction."""
    p = cheap.targets
    residual, jacobian, spread = cheap.residual.copy(), cheap.jacobian.copy(), cheap.spread.copy()
    residual[:, :p] = correction.rho * residual[:, :p] + correction.mean(cheap.z)
    jacobian[:, :p] = correction.rho * jacobian[:, :p] + np.array([correction.slope(z) for z in cheap.z])
    own = np.zeros(len(cheap.z), bool)
    for i, j in pairs(cheap, dear):
        own[i] = True
        residual[i], spread[i] = dear.residual[j], dear.spread[j]
        if np.isfinite(dear.jacobian[j]).all():
            jacobian[i] = dear.jacobian[j]
    failed = np.vstack([cheap.failed, dear.failed])
    return replace(
        cheap, residual=residual, jacobian=jacobian, spread=spread, failed=failed, correction=correction, dear=own
    )  # fmt: skip


def _rho(delta: Components, low: FloatArray, high: FloatArray) -> float:
    """Generalised least squares of the reference's rows (N, p) on the cheap ones, in delta's covariance, beside its trend."""
    low, high = low @ delta.rotation, high @ delta.rotation
    q = delta.trend_factor @ delta.trend_rows
    white = delta.inverse_factor @ low
    projected = delta.inverse_factor.T @ white - q.T @ (q @ low)
    weight = 1.0 / np.maximum(delta.variance, _FLOOR)
    above, below = float(((projected * high).sum(0) * weight).sum()), float(((projected * low).sum(0) * weight).sum())
    return (above + _RHO_SD**-2) / (below + _RHO_SD**-2)
