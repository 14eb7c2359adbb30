"""A stand-in for a density in the part of the box where its samples are: nearly free, never trusted alone.

Of a prediction the variance is dear, (N, N) numbers at each point; the mean takes N.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.inference.polynomial import Polynomial, fit_polynomial
from lacli.inference.sampling.likelihood import Density, gaussian_log_likelihood

_STEEP = 30.0
# polynomial means that err by more in log likelihood, where the samples are, err by far more in the arms of a curved density
_CLOSE = 0.1


@dataclass(frozen=True)
class Surrogate:
    """Cubic polynomials for the emulators' log variances on the inputs' scales, and for their means where these are close.

    polynomial: (m, d) -> (m, 2 p), or (m, p) of the log variances alone, beside the emulators' own means; floor, ceiling (p,) of
    the log variance; threshold on the implausibility from which the density is zero (infinite where that is not for these
    emulators to say).
    """

    density: Density
    polynomial: Polynomial
    floor: FloatArray
    ceiling: FloatArray
    threshold: float

    @property
    def own_means(self) -> bool:
        """Whether the means are the emulators' own."""
        return self.polynomial.coefficients.shape[1] == len(self.floor)

    def __call__(self, x: FloatArray) -> FloatArray:
        """Approximate log density (m,) at x (m, d); -inf outside the box, steeply falling (never zero: the exact density has
        the last word) where the waves rule out."""
        value = np.full(len(x), -np.inf)
        rows = np.flatnonzero(self.density.region.box.contains(x))
        if not len(rows):
            return value
        fitted = self.polynomial(x[rows])
        p = len(self.floor)
        variance = np.exp(np.clip(fitted[:, -p:], self.floor, self.ceiling))
        mean = self.density.emulators.predict_mean(x[rows]) if self.own_means else fitted[:, :p]
        targets = self.density.targets
        value[rows] = gaussian_log_likelihood(mean, variance, targets) + self.density.log_prior(x[rows])
        if np.isfinite(self.threshold):
            worst = np.sqrt(((mean - targets.mean) ** 2 / (variance + targets.sd**2)).max(1))
            value[rows] -= _STEEP * np.maximum(worst / self.threshold - 1.0, 0.0)
        return value


def fit_surrogate(density: Density, x: FloatArray) -> tuple[Surrogate, float]:
    """Fit to the density's emulators at x (m, d), points of its bulk.

    Returns the stand-in and the standard deviation of its error in log likelihood at points kept out of the fit.
    """
    box = density.region.box
    log_inputs = (density.emulators.log_share > 0.5) & (box.lower > 0)
    mean, variance = density.emulators.predict_truth(x)
    log_variance = np.log(variance)
    kept_out = np.zeros(len(x), bool)
    kept_out[::5] = True
    waves = density.region.waves
    own = [w.threshold for w in waves if w.emulators is density.emulators and w.targets is density.targets]
    ends = log_variance.min(0) - 0.5, log_variance.max(0) + 0.5
    exact = gaussian_log_likelihood(mean[kept_out], variance[kept_out], density.targets) + density.log_prior(x[kept_out])

    def fitted(y: FloatArray) -> tuple[Surrogate, float]:
        polynomial = fit_polynomial(x[~kept_out], y[~kept_out], box.lower, box.upper, log_inputs)
        found = Surrogate(density, polynomial, *ends, min(own, default=np.inf))
        return found, float((found(x[kept_out]) - exact).std())

    found, error = fitted(np.hstack([mean, log_variance]))
    return (found, error) if error < _CLOSE else fitted(log_variance)
