"""The Gaussian approximation of the posterior at its most probable points, and draws from a widened one within the box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from lacli.base.arrays import FloatArray

_SWEEPS = 60


@dataclass(frozen=True)
class Laplace:
    """centre (d,) and precision (d, d) in z: exp(-1/2 (z - c)' P (z - c)) within the box."""

    centre: FloatArray
    precision: FloatArray

    @classmethod
    def at(cls, z: FloatArray, residual: FloatArray, jacobian: FloatArray) -> Laplace:
        """Of a run at z: P = J' J, and the centre where the linear model is lowest within the box."""
        from lacli.calibration.sequential.descent import levenberg

        step, _ = levenberg(residual, jacobian, z, 1e-6, 0.25)
        # the box's own variance, 1 / 12, where the targets tell nothing
        return cls(z + step, jacobian.T @ jacobian + 12.0 * np.eye(len(z)) * 1e-3)

    @property
    def log_volume(self) -> float:
        """log of the integral over the box of the Gaussian of height 1: along no axis of it more than the box's width."""
        return float(np.minimum(0.5 * np.log(2.0 * np.pi / np.linalg.eigvalsh(self.precision)), 0.0).sum())

    def distance(self, z: FloatArray) -> FloatArray:
        """Mahalanobis distance (m,)."""
        away = z - self.centre
        return np.asarray(np.sqrt(np.einsum("mi,ij,mj->m", away, self.precision, away)))

    def draw(self, count: int, widening: float, rng: np.random.Generator) -> FloatArray:
        """(count, d) from the Gaussian of ``widening`` times its standard deviations, truncated to the box (Gibbs' sampler)."""
        precision = self.precision / widening**2
        sd = 1.0 / np.sqrt(np.diag(precision))
        z = np.tile(np.clip(self.centre, 1e-6, 1.0 - 1e-6), (count, 1))
        for _ in range(_SWEEPS):
            for i in range(len(sd)):
                away = z - self.centre
                mean = self.centre[i] - (away @ precision[i] - away[:, i] * precision[i, i]) * sd[i] ** 2
                low, high = ndtr((0.0 - mean) / sd[i]), ndtr((1.0 - mean) / sd[i])
                level = low + rng.random(count) * (high - low)
                z[:, i] = np.clip(mean + sd[i] * ndtri(np.clip(level, 1e-12, 1.0 - 1e-12)), 0.0, 1.0)
        return z
