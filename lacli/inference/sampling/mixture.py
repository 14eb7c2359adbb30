"""A mixture of normal distributions fitted to points: proposals that reach every part of a density, however separate."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray

_POINTS_PER_COMPONENT = 60


@dataclass(frozen=True)
class Mixture:
    """weights (k,), means (k, d), factors (k, d, d): lower Cholesky factors of the covariances, and their inverses."""

    weights: FloatArray
    means: FloatArray
    factors: FloatArray
    inverses: FloatArray

    def sample(self, rng: Any, count: int) -> FloatArray:
        """Independent points (count, d); ``rng``: a numpy RandomState, as emcee hands over."""
        which = np.searchsorted(np.cumsum(self.weights)[:-1], rng.random_sample(count))
        normal = rng.standard_normal((count, self.means.shape[1]))
        return self.means[which] + np.einsum("mij,mj->mi", self.factors[which], normal)

    def log_density(self, x: FloatArray) -> FloatArray:
        """log density (m,) at x (m, d)."""
        d = x.shape[1]
        inverse = self.inverses
        z = np.einsum("kij,mkj->mki", inverse, x[:, None] - self.means)
        height = np.log(self.weights) + np.log(np.diagonal(inverse, axis1=1, axis2=2)).sum(1) - 0.5 * d * np.log(2.0 * np.pi)
        exponent = height - 0.5 * (z**2).sum(2)
        top = exponent.max(1)
        return np.asarray(top + np.log(np.exp(exponent - top[:, None]).sum(1)), float)


def fit_mixture(x: FloatArray, scale: FloatArray, seed: int = 0, most: int = 12, widened: float = 2.0) -> Mixture:
    """A mixture of at most ``most`` distributions for points x (m, d); scale (d,): lengths in which the inputs compare (the
    box's size); widened: so many times as wide as the points, in variance, that tails are reached too."""
    from sklearn.mixture import GaussianMixture

    count = int(np.clip(len(x) // _POINTS_PER_COMPONENT, 1, most))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a fit stopped early serves as well
        # (k-means itself would sum in several threads, in any order: other bits each time)
        options: dict[str, Any] = {"init_params": "k-means++", "reg_covar": 1e-8, "max_iter": 30, "random_state": seed}
        fitted = GaussianMixture(count, **options).fit(x / scale)
    factors = np.asarray(np.linalg.cholesky(widened * fitted.covariances_) * scale[:, None], np.float64)
    inverses = np.asarray(np.linalg.inv(factors), np.float64)
    return Mixture(np.asarray(fitted.weights_), fitted.means_ * scale, factors, inverses)
