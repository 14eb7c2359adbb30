"""How much larger the simulator's own errors are than was stated, by the misfit that is left at the best run.

The errors that were added to the targets' (of discretisation) have a scale which holds for most anatomies and motions; that of
one patient may be larger, and the misfit tells. With the measurement's covariance S, that of the added errors A, and the
simulator linear about the best run, the residual is normal with covariance S + s^2 A + J P J^T, P that of the prior on the
inputs: what inputs can take up says nothing of s, and errors like it stay unseen. ln s has half a normal distribution, of
standard deviation ln 2, from 0 up: errors are never taken for smaller than stated. The most probable s is used (empirical
Bayes; Kennedy and O'Hagan 2001 have the whole term free).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray

_PRIOR_SD = math.log(2.0)  # of ln s: of one anatomy in twenty, errors are four times those stated
_MOST = 30.0
_LEAST = 1e-12  # of the added variance: the measurement's is known to no less where it was found as a difference
_VARIANCE = 1.0 / 12.0  # of an input that is uniform over its range from 0 to 1


@dataclass(frozen=True)
class ErrorFactor:
    """The most probable s, and the 95 % interval of its posterior distribution."""

    value: float
    low: float
    high: float


def error_factor(
    residual: FloatArray,
    jacobian: FloatArray,
    measured: FloatArray,
    added: FloatArray,
    priors: tuple[FloatArray, FloatArray] | None = None,
) -> ErrorFactor:
    """s by the residual (p,) and its derivatives (p, d) by inputs from 0 to 1, with the covariances (p, p) of the measurement and
    of the errors that were added, all in the features' units. priors: residual (q,) of those that are not uniform, in their
    standard deviations, and its derivatives (q, d)."""
    # in the measurement's standard deviations and the axes of the added errors, all scales are seen at once
    whitening = np.linalg.inv(np.linalg.cholesky(measured + _LEAST * np.diag(np.diag(added))))
    variance, axes = np.linalg.eigh(whitening @ added @ whitening.T)
    r, slopes = axes.T @ whitening @ residual, axes.T @ whitening @ jacobian
    if priors is not None:  # no factor is on them
        r, slopes = np.concatenate([r, priors[0]]), np.vstack([slopes, priors[1]])
        variance = np.concatenate([variance, np.zeros(len(priors[0]))])
    logs = np.linspace(0.0, math.log(_MOST), 400)
    value = np.array([_log_density(math.exp(2.0 * t), r, slopes, np.maximum(variance, 0.0)) for t in logs])
    value -= 0.5 * (logs / _PRIOR_SD) ** 2
    share = np.cumsum(np.exp(value - value.max()))
    low, high = np.exp(logs[np.searchsorted(share, [0.025 * share[-1], 0.975 * share[-1]])])
    return ErrorFactor(float(np.exp(logs[int(np.argmax(value))])), float(low), float(high))


def _log_density(square: float, r: FloatArray, slopes: FloatArray, variance: FloatArray) -> float:
    total = 1.0 + square * variance
    # (D + J P J^T)^-1 and its determinant through a matrix of the inputs' size
    inner = np.eye(slopes.shape[1]) / _VARIANCE + slopes.T @ (slopes / total[:, None])
    along = slopes.T @ (r / total)
    misfit = (r**2 / total).sum() - along @ np.linalg.solve(inner, along)
    return float(-0.5 * (misfit + np.log(total).sum() + np.linalg.slogdet(inner)[1]))
