"""The posterior density: a prior on a region, uniform where none is told, Gaussian likelihood with measurement and emulator
variance.

log L(x) = -1/2 sum_j [ (E f_j - mu_j)^2 / (sigma_j^2 + Var f_j) + log(2 pi (sigma_j^2 + Var f_j)) ]; Var f is the emulator's
and that of the runs' own error (discretisation). The variance depends on x, so its logarithm stays: without it the mean moves
by a quarter of a standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.priors import check_priors, log_prior
from lacli.contracts.targets import Targets
from lacli.inference.emulation.emulator_set import AnyEmulators
from lacli.inference.matching.matching import Region

_ENTRIES = 4_000_000  # of the covariances that are in memory at a time


def gaussian_log_likelihood(mean: FloatArray, variance: FloatArray, targets: Targets) -> FloatArray:
    """log L (m,) from predicted mean and variance (m, p); the targets' errors correlated where they have a covariance."""
    if targets.covariance is not None:
        return _correlated_log_likelihood(mean, variance, targets.mean, targets.covariance)
    total = variance + targets.sd**2
    return -0.5 * ((mean - targets.mean) ** 2 / total + np.log(2.0 * np.pi * total)).sum(1)


def _correlated_log_likelihood(mean: FloatArray, variance: FloatArray, target: FloatArray, covariance: FloatArray) -> FloatArray:
    """log L (m,) = -1/2 [r' S^-1 r + log det S + p log 2 pi], S the covariance (p, p) plus the emulators' variance."""
    p = len(target)
    result = np.empty(len(mean))
    diagonal = np.arange(p)
    rows = max(1, _ENTRIES // (p * p))
    for start in range(0, len(mean), rows):
        part = slice(start, start + rows)
        total = np.repeat(covariance[None], len(mean[part]), axis=0)
        total[:, diagonal, diagonal] += variance[part]
        factor = np.linalg.cholesky(total)
        white = np.linalg.solve(factor, (mean[part] - target)[..., None])[..., 0]
        size = 2.0 * np.log(factor[:, diagonal, diagonal]).sum(axis=1)
        result[part] = -0.5 * ((white**2).sum(axis=1) + size + p * np.log(2.0 * np.pi))
    return result


def pointwise_log_likelihood(mean: FloatArray, variance: FloatArray, targets: Targets) -> FloatArray:
    """log p(y_j | y_-j, x) (m, p): with independent errors that of each target alone."""
    if targets.covariance is None:
        total = variance + targets.sd**2
        independent: FloatArray = -0.5 * ((mean - targets.mean) ** 2 / total + np.log(2 * np.pi * total))
        return independent
    p = len(targets.mean)
    precision, g = np.empty(mean.shape), np.empty(mean.shape)
    diagonal = np.arange(p)
    rows = max(1, _ENTRIES // (p * p))
    for start in range(0, len(mean), rows):
        part = slice(start, start + rows)
        total = np.repeat(targets.covariance[None], len(mean[part]), axis=0)
        total[:, diagonal, diagonal] += variance[part]
        inverse = np.linalg.inv(total)
        precision[part] = inverse[:, diagonal, diagonal]
        g[part] = np.einsum("mij,mj->mi", inverse, targets.mean - mean[part])
    return conditional(g, precision)


def conditional(g: FloatArray, precision: FloatArray) -> FloatArray:
    """log p(y_j | y_-j) (m, p) of normal errors, from S^-1 r and the diagonal of S^-1, both (m, p): r_j less what the others
    foretell is g_j / precision_j, with the variance 1 / precision_j (Buerkner et al. 2021)."""
    return np.asarray(-0.5 * (g**2 / precision - np.log(precision) + np.log(2 * np.pi)))


class Likelihood(Protocol):
    """Of the targets, at inputs (m, d)."""

    def __call__(self, x: FloatArray) -> FloatArray:
        """log L (m,), constants included: models of one set of targets are compared by it."""

    def pointwise(self, x: FloatArray) -> FloatArray:
        """log p(y_j | y_-j, x) (m, p)."""


@dataclass(frozen=True)
class ByFeature:
    """The likelihood where each feature has an emulator of its own, whose errors are independent."""

    emulators: AnyEmulators
    targets: Targets

    def __call__(self, x: FloatArray) -> FloatArray:
        """log L (m,) at x (m, d)."""
        return gaussian_log_likelihood(*self.emulators.predict_truth(x), self.targets)

    def pointwise(self, x: FloatArray) -> FloatArray:
        """log p(y_j | y_-j, x) (m, p)."""
        return pointwise_log_likelihood(*self.emulators.predict_truth(x), self.targets)


@dataclass(frozen=True)
class Density:
    """log posterior, up to a constant: the likelihood inside the region, -inf outside.

    ``region`` with no waves is the box. ``emulators`` has the outputs of ``targets`` in the same order.
    """

    emulators: AnyEmulators
    targets: Targets
    region: Region

    @property
    def d(self) -> int:
        """Number of inputs."""
        return self.region.box.d

    def __post_init__(self) -> None:
        check_priors(self.targets.priors, self.region.box.names, self.region.box.lower, self.region.box.upper)

    def log_prior(self, x: FloatArray) -> FloatArray:
        """log prior (m,) at x (m, d) of the box, up to a constant."""
        return log_prior(self.targets.priors, self.region.box.names, x)

    def log_likelihood(self, x: FloatArray) -> FloatArray:
        """log L (m,) at x (m, d)."""
        return gaussian_log_likelihood(*self.emulators.predict_truth(x), self.targets)

    def __call__(self, x: FloatArray) -> FloatArray:
        """log posterior (m,) at x (m, d)."""
        value = np.full(len(x), -np.inf)
        rows = np.flatnonzero(self.region.box.contains(x))
        if not len(rows):
            return value
        mean, variance = self.emulators.predict_truth(x[rows])
        keep = np.ones(len(rows), bool)
        for wave in self.region.waves:
            if wave.emulators is self.emulators and wave.targets is self.targets:
                # the last wave's emulators are the likelihood's: their prediction serves both
                keep &= (np.abs(wave.signed_of(mean, variance)) < wave.threshold).all(1)
            elif keep.any():
                open_ = np.flatnonzero(keep)
                keep[open_] = wave.below(x[rows[open_]], 1.0)
        value[rows[keep]] = gaussian_log_likelihood(mean[keep], variance[keep], self.targets) + self.log_prior(x[rows[keep]])
        return value
