"""The likelihood of targets by the emulator of a sequential calibration, for hundreds of correlated targets at a diagonal's cost.

The emulator's error is v(z) M, M a matrix between the features that no input changes. With the covariance of the targets' errors
K = L L' and L^-1 M L^-T = E diag(s) E', what is left of the targets is independent in the coordinates E' L^-1, with variances
1 + v(z) s; log det K is the same everywhere. So no matrix of the targets' size is factored at any point, and nothing is left out:
that the emulator errs in many features together is in it. Of runs that were corrected the correction's error is one more, in a
few directions, which a matrix as large as their number brings in (Woodbury).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.emulator import Components, Part
from lacli.calibration.sequential.evidence import factor
from lacli.calibration.sequential.fidelity.corrected import Corrected
from lacli.calibration.sequential.outputs import Features
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.targets import Targets
from lacli.inference.sampling.likelihood import conditional

_NOTHING = 1e-6  # of the targets' variance: errors of the correction in such a direction are left out
_ENTRIES = 4_000_000  # of matrices between targets and directions that are in memory at a time


@dataclass(frozen=True)
class _Few:
    """An error of few directions beside the independent ones: the process whose share of it is not known, and the directions
    (p, k) times their standard deviations where nothing is known."""

    process: Components
    along: FloatArray

    def inner(self, z: FloatArray, total: FloatArray) -> tuple[FloatArray, FloatArray]:
        """At z (m, d), beside variances (m, p): the standard deviation's share (m,), and the factor C (m, k, k) of
        C C' = 1 + share^2 W' D^-1 W."""
        root = np.sqrt(self.process.share(z))
        k = self.along.shape[1]
        i, j = np.tril_indices(k)  # the factor is of the lower half
        inside = np.tile(np.eye(k), (len(z), 1, 1))
        inside[:, i, j] += (root**2)[:, None] / total @ (self.along[:, i] * self.along[:, j])
        return root, np.asarray(np.linalg.cholesky(inside))


@dataclass(frozen=True)
class Decorrelated:
    """components: what is left of the targets, independent, where errors of the targets are 1; shift (p,): what is added to them;
    whitening (p, p): E' L^-1; constant: of log L; correction: its error, where runs were corrected."""

    components: Components
    scale: Scale
    shift: FloatArray
    whitening: FloatArray
    constant: float
    correction: _Few | None = None

    @classmethod
    def of(cls, features: Features, targets: Targets) -> Decorrelated:
        """Of the emulated features held against ``targets``, which are of these features in their order. Their errors may be
        others than those that the emulator's components are made with."""
        made, lower = features.components, factor(targets)
        back = solve_triangular(lower, features.back(), lower=True)
        axes = np.linalg.eigh((back * made.variance) @ back.T)[1]
        turn, whitening = axes.T @ back, axes.T @ solve_triangular(lower, np.eye(len(lower)), lower=True)
        runs, correction = made, None
        if isinstance(made, Corrected):
            directions, size, _ = np.linalg.svd(turn @ (made.mix.T * np.sqrt(made.delta.variance)), full_matrices=False)
            runs, kept = made.of_runs(), size**2 > _NOTHING
            correction = _Few(made.delta, directions[:, kept] * size[kept])
        centre = features.targets.select(features.outputs).mean
        p = len(lower)
        return cls(
            runs.turned(turn), features.scale, whitening @ (centre - targets.mean), whitening,
            -float(np.log(np.diag(lower)).sum()) - 0.5 * p * math.log(2.0 * math.pi), correction,
        )  # fmt: skip

    def __call__(self, x: FloatArray) -> FloatArray:
        """log L (m,) at x (m, d)."""
        z = self.scale.to_z(x)
        left, total = self._left(z)
        found = self.constant - 0.5 * (left**2 / total + np.log(total)).sum(axis=1)
        if self.correction is None:
            return found
        root, inner = self.correction.inner(z, total)
        taken_up = np.linalg.solve(inner, (root[:, None] * (left / total) @ self.correction.along)[..., None])[..., 0]
        size = np.log(np.diagonal(inner, axis1=1, axis2=2)).sum(axis=1)
        return np.asarray(found + 0.5 * (taken_up**2).sum(axis=1) - size)

    def worlds(self, x: FloatArray, of: Part = "emulator and correction") -> Callable[[np.random.Generator], FloatArray]:
        """Draws of what log L (m,) at x (m, d) would be more, were the residuals known that the emulator errs in, jointly at all
        points. of: whose errors; the others are left as they are, in the variances."""
        z = self.scale.to_z(x)
        left, total = self._left(z)
        spread = 1.0 if of != "correction" else total
        of_runs = self.components.errors(z, "emulator") if of != "correction" else None
        few = self.correction if of != "emulator" else None
        now, again = self(x), self.constant - 0.5 * np.log(np.broadcast_to(spread, left.shape)).sum(axis=1)
        if few is not None:
            size, axes = np.linalg.eigh(few.process.covariance(z))
            root = axes * np.sqrt(np.maximum(size, 0.0))
        elif self.correction is not None:
            now = self.constant - 0.5 * (left**2 / total + np.log(total)).sum(axis=1)

        def drawn(rng: np.random.Generator) -> FloatArray:
            error = np.zeros_like(left) if of_runs is None else of_runs(rng)
            if few is not None:
                error = error + root @ rng.standard_normal((len(z), few.along.shape[1])) @ few.along.T
            return np.asarray(again - 0.5 * ((left + error) ** 2 / spread).sum(axis=1) - now)

        return drawn

    def pointwise(self, x: FloatArray) -> FloatArray:
        """log p(y_j | y_-j, x) (m, p): of all targets' errors and the emulator's together."""
        rows = max(1, _ENTRIES // (len(self.shift) * (1 if self.correction is None else 1 + self.correction.along.shape[1])))
        return np.vstack([self._pointwise(x[start : start + rows]) for start in range(0, len(x), rows)])

    def _pointwise(self, x: FloatArray) -> FloatArray:
        z = self.scale.to_z(x)
        left, total = self._left(z)
        g, precision = left / total, 1.0 / total @ self.whitening**2
        if self.correction is None:
            return conditional(g @ self.whitening, precision)
        root, inner = self.correction.inner(z, total)
        # W' D^-1 in the directions that C leaves independent
        known = np.linalg.solve(inner, (root[:, None, None] * self.correction.along.T) / total[:, None])
        g = g - np.einsum("mkp,mk->mp", known, np.einsum("mkp,mp->mk", known, left))
        return conditional(g @ self.whitening, precision - ((known @ self.whitening) ** 2).sum(axis=1))

    def _left(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What is left (m, p) of the targets at z (m, d) and its variance, but for the correction's."""
        mean, variance = self.components.predict(z)
        return mean + self.shift, variance + 1.0
