"""Emulation of all residuals at once from runs' values and derivatives.

Outputs r (p,) share one kernel over the inputs z, and a covariance S (p, p) among themselves: r(z) = b(z) + g(z), b linear,
cov(g(z), g(z')) = k(z, z') S, k a stationary kernel with a length for each input (``emulation.gradient_kernel``). Derivatives
are observations of the same process. In the eigenvectors U of S the components c = U' r are independent, with variance
S_k v(z), and |c| = |r|: the likelihood needs nothing else. (Morris, Mitchell, Ylvisaker 1993; Conti, O'Hagan 2010.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.optimize import minimize

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.base.errors import LacliError
from lacli.inference.emulation.gp import basis as trend_of
from lacli.inference.emulation.gradient_kernel import Kind, blocks, length_gradient, value_rows

# of a length, in widths of the box; of the nugget, a share of the kernel's variance
_LENGTHS, _NUGGETS = (0.08, 12.0), (1e-8, 1e-2)
_JITTER = 1e-10
_SIGNAL = 1e-3  # a component that moves less than this share of the measurement's error tells nothing of the lengths
_MOST_MOVING = 20  # components that the lengths are learnt from
STILL = 1e-5  # of the measurement's variance: a component whose process varies less is its trend
_ROWS = 1000  # predicted at a time

# of the error: what the emulator of the runs does not know, and what the correction of cheap runs does not
Part = Literal["emulator", "correction", "emulator and correction"]


@dataclass(frozen=True)
class Rows:
    """What was observed where: z (n, d); seen (1 + d, n): value and derivatives of each run that are known."""

    z: FloatArray
    seen: BoolArray

    @classmethod
    def of(cls, z: FloatArray, told: BoolArray) -> Rows:
        """Values of all runs, derivatives of those that tell them (n,)."""
        return cls(z, np.vstack([np.ones((1, len(z)), bool), np.tile(told, (z.shape[1], 1))]))

    @property
    def every(self) -> IntArray:
        """All inputs: derivatives are known along each."""
        return np.arange(self.z.shape[1])

    def along(self) -> IntArray:
        """(N,): -1 of a value, else the input that the derivative is along."""
        return np.broadcast_to(np.arange(-1, self.z.shape[1])[:, None], self.seen.shape)[self.seen]

    def run(self) -> IntArray:
        """(N,): the run of each row."""
        return np.broadcast_to(np.arange(len(self.z)), self.seen.shape)[self.seen]

    def basis(self) -> FloatArray:
        """(N, 1 + d): the linear trend's functions."""
        d = self.z.shape[1]
        h = np.zeros((*self.seen.shape, 1 + d))
        h[0] = trend_of(self.z)
        h[np.arange(1, 1 + d), :, np.arange(1, 1 + d)] = 1.0
        return h[self.seen]

    def observations(self, residual: FloatArray, jacobian: FloatArray) -> FloatArray:
        """(N, p) of residual (n, p) and jacobian (n, p, d)."""
        return np.concatenate([residual[None], jacobian.transpose(2, 0, 1)])[self.seen]

    def divided(self, lengths: FloatArray) -> FloatArray:
        """(N,): what the kernel's rows, times a length where derivatives, are divided by."""
        return np.r_[1.0, lengths][self.along() + 1]

    def kernel(self, kind: Kind, lengths: FloatArray, nugget: float) -> tuple[FloatArray, FloatArray]:
        """The kernel's matrix (N, N) without the nugget, and the nugget of each row (N,)."""
        there = np.flatnonzero(self.seen.ravel())
        size = self.seen.size
        k = blocks(kind, self.z / lengths, self.z / lengths, self.every).reshape(size, size)
        if len(there) < size:
            k = k[np.ix_(there, there)]
        by = self.divided(lengths)
        k /= by
        k /= by[:, None]
        return k, (nugget + _JITTER) * k.diagonal()

    def cross(self, kind: Kind, z: FloatArray, lengths: FloatArray) -> FloatArray:
        """(m, N): the kernel between values at z and the rows."""
        k = value_rows(kind, z / lengths, self.z / lengths, self.every)
        k[:, 1:] /= lengths[:, None]
        return k.reshape(len(z), -1) if self.seen.all() else k[:, self.seen]


@dataclass(frozen=True)
class Components:
    """The fitted process. rows: what was observed; lengths (d,); nugget; weights (N, p) and trend (1 + d, p) of the components;
    variance (p,) of each; rotation (p, p) = U; inverse_factor (N, N): of the kernel's matrix L L', L^-1; trend_rows (1 + d, N)
    and trend_factor (1 + d, 1 + d): H' K^-1 and L^-1 of H' K^-1 H; inflation: what held-out runs say the variance must be
    multiplied with, at least 1."""

    kind: Kind
    rows: Rows
    lengths: FloatArray
    nugget: float
    weights: FloatArray
    trend: FloatArray
    variance: FloatArray
    rotation: FloatArray
    inverse_factor: FloatArray
    trend_rows: FloatArray
    trend_factor: FloatArray
    inflation: float
    held_out: float

    @property
    def z(self) -> FloatArray:
        """Inputs (n, d) of the runs."""
        return self.rows.z

    def mean(self, z: FloatArray) -> FloatArray:
        """Components (m, p) at z (m, d)."""
        return np.vstack([self._cross(part) @ self.weights + trend_of(part) @ self.trend for part in _parts(z)])

    def predict(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, p) of the components."""
        mean, variance = np.empty((len(z), len(self.variance))), np.empty((len(z), len(self.variance)))
        for start in range(0, len(z), _ROWS):
            part = slice(start, start + _ROWS)
            k = self._cross(z[part])
            mean[part] = k @ self.weights + trend_of(z[part]) @ self.trend
            variance[part] = self._share(z[part], k)[:, None] * self.variance
        return mean, variance

    def share(self, z: FloatArray) -> FloatArray:
        """v(z) (m,): what is not known of the kernel's variance, inflation included."""
        return np.concatenate([self._share(part, self._cross(part)) for part in _parts(z)] or [np.empty(0)])

    def covariance(self, z: FloatArray) -> FloatArray:
        """(m, m): the posterior covariance of the kernel's process between points, inflation included."""
        k = self._cross(z)
        known = k @ self.inverse_factor.T
        free = (trend_of(z) - k @ self.trend_rows.T) @ self.trend_factor.T
        own = value_rows(self.kind, z / self.lengths, z / self.lengths, np.empty(0, np.int64))[:, 0]
        return np.asarray(self.inflation * (own - known @ known.T + free @ free.T))

    def errors(self, z: FloatArray, of: Part) -> Callable[[np.random.Generator], FloatArray]:
        """Draws of the errors (m, p) that the mean may have at z (m, d), jointly at all points."""
        del of  # nothing is corrected here
        size, axes = np.linalg.eigh(self.covariance(z))
        root, sd = axes * np.sqrt(np.maximum(size, 0.0)), np.sqrt(self.variance)
        return lambda rng: np.asarray(root @ rng.standard_normal((len(z), len(sd))) * sd)

    def part(self, of: Part) -> Components:
        """The process whose runs lessen one part of the error, with its variance in these components."""
        del of
        return self

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """Errors (n, p) of the components at runs left out one after the other, and what is not known there of the kernel's
        variance (n,), inflation included; hyperparameters as they are."""
        error, share = _left_out(self.rows, self.inverse_factor, self.trend_rows, self.trend_factor, self.weights)
        return error, self.inflation * share

    def slope(self, z: FloatArray) -> FloatArray:
        """d mean / dz (p, d) at one point z (d,)."""
        rows = blocks(self.kind, z[None] / self.lengths, self.z / self.lengths, self.rows.every)[1:, 0]
        rows[:, 1:] /= self.lengths[:, None]
        return np.asarray((rows[:, self.rows.seen] / self.lengths[:, None] @ self.weights + self.trend[1:]).T)

    def joined_by(self, z: FloatArray) -> Components:
        """With runs added at z (k, d), of which only the place is known: for the variance they will leave."""
        told = np.hstack([self.rows.seen[1], np.ones(len(z), bool)])
        rows = Rows.of(np.vstack([self.z, z]), told)
        inverse_factor, trend_rows, trend_factor = _factors(rows, self.kind, self.lengths, self.nugget)
        return replace(
            self, rows=rows, weights=np.zeros((len(inverse_factor), 0)), inverse_factor=inverse_factor, trend_rows=trend_rows,
            trend_factor=trend_factor,
        )  # fmt: skip

    def reduced(self) -> Components:
        """The same misfit from fewer components: those that are their trend alone, turned among themselves, are 1 + d at most.

        |c| is kept to ``STILL``; rotation is that of the components which still vary, and of no use for the rest.
        """
        return self._of(self.variance > STILL)

    def turned(self, turn: FloatArray) -> Components:
        """``turn`` (q, P) times the components, which it must leave independent."""
        return replace(
            self, weights=self.weights @ turn.T, trend=self.trend @ turn.T, variance=turn**2 @ self.variance,
            rotation=self.rotation @ turn.T,
        )  # fmt: skip

    def _of(self, lively: BoolArray) -> Components:
        """Those components, and the others turned among themselves."""
        still = np.asarray(np.linalg.qr(self.trend[:, ~lively].T, mode="r")).T  # (1 + d, k): |t' trend| = |t' R'|
        none = np.zeros((len(self.weights), still.shape[1]))
        return replace(
            self, weights=np.hstack([self.weights[:, lively], none]), trend=np.hstack([self.trend[:, lively], still]),
            variance=np.r_[self.variance[lively], np.full(still.shape[1], 1e-12)],
        )  # fmt: skip

    def _cross(self, z: FloatArray) -> FloatArray:
        return self.rows.cross(self.kind, z, self.lengths)

    def _share(self, z: FloatArray, k: FloatArray) -> FloatArray:
        known = k @ self.inverse_factor.T
        free = (trend_of(z) - k @ self.trend_rows.T) @ self.trend_factor.T
        return self.inflation * np.maximum(1.0 - (known**2).sum(1) + (free**2).sum(1), 1e-12)


def fit(
    z: FloatArray, residual: FloatArray, jacobian: FloatArray, start: Components | None = None, iterations: int = 25
) -> Components:
    """Fit to runs at z (n, d): residual (n, p), jacobian (n, p, d), NaN where a run tells none.

    start: an earlier fit, from whose lengths the search sets out. Raises LacliError for fewer runs than a trend takes.
    """
    n, d = z.shape
    told = np.asarray(np.isfinite(jacobian).all((1, 2)))
    rows = Rows.of(z, told)
    observed = rows.observations(residual, jacobian)
    if len(observed) < d + 3:
        raise LacliError(f"calibrate: {n} finished runs ({int(told.sum())} with derivatives) are too few to emulate {d} inputs.")
    moving = _moving(rows, observed)
    kind: Kind = "squared_exponential" if start is None else start.kind
    low, high = np.log([*[_LENGTHS[0]] * d, _NUGGETS[0]]), np.log([*[_LENGTHS[1]] * d, _NUGGETS[1]])
    theta = np.log([*[1.0] * d, 1e-5]) if start is None else np.log([*start.lengths, start.nugget])
    if moving.shape[1]:
        found = minimize(
            cost, np.clip(theta, low, high), (rows, moving, kind), method="L-BFGS-B", jac=True,
            bounds=list(zip(low, high, strict=True)), options={"maxiter": iterations, "ftol": 1e-6},
        )  # fmt: skip
        theta = found.x
    lengths, nugget = np.exp(theta[:d]), float(np.exp(theta[d]))
    inverse_factor, trend_rows, trend_factor = _factors(rows, kind, lengths, nugget)
    white, h = inverse_factor @ observed, inverse_factor @ rows.basis()
    trend = trend_factor.T @ (trend_factor @ (h.T @ white))
    white -= h @ trend
    variance, rotation = np.linalg.eigh(white.T @ white / (len(observed) - d - 1))
    variance = np.maximum(variance, 1e-12)
    weights = inverse_factor.T @ (white @ rotation)
    error, share = _left_out(rows, inverse_factor, trend_rows, trend_factor, weights)
    # components count by their variance: what moves the likelihood. One run far from what the process expects is one of n: the
    # mean is what a chi-square would keep near 1
    held_out = float(np.mean((error**2).sum(1) / (share * variance.sum())))
    return Components(
        kind, rows, lengths, nugget, weights, trend @ rotation, variance, rotation, inverse_factor, trend_rows, trend_factor,
        max(1.0, held_out), held_out,
    )  # fmt: skip


def cost(theta: FloatArray, rows: Rows, moving: FloatArray, kind: Kind) -> tuple[float, FloatArray]:
    """Negative log restricted likelihood of the observations (N, q), with one variance at its best for all, and the gradient;
    theta (d + 1,): logarithms of the lengths and of the nugget.

    One variance, although components differ in theirs: with a variance for each, every component has an equal say in the lengths,
    and many that hardly move decide over few that make the misfit. So squared residuals count, whatever component they are of.
    """
    d = rows.z.shape[1]
    lengths, nugget = np.exp(theta[:d]), float(np.exp(theta[d]))
    k, own = rows.kernel(kind, lengths, nugget)
    total = k.copy(order="F")
    total[np.diag_indices(len(k))] += own
    factor, info = dpotrf(total, lower=1, overwrite_a=1)
    if info != 0:
        return 1e12, np.zeros_like(theta)
    size_of_k = 2.0 * np.log(np.diag(factor)).sum()
    inverse, _ = dpotri(factor, lower=1, overwrite_c=1)
    below = np.tril(inverse, -1)
    inverse = below + below.T + np.diag(np.diag(inverse))
    h = rows.basis()
    kh = inverse @ h
    try:
        information = np.linalg.cholesky(h.T @ kh)
    except np.linalg.LinAlgError:
        return 1e12, np.zeros_like(theta)
    q = solve_triangular(information, kh.T, lower=True)
    py = inverse @ moving - q.T @ (q @ moving)
    free = len(moving) - d - 1
    size = max(float((moving * py).sum()) / (free * moving.shape[1]), 1e-12)
    determinant = size_of_k + 2.0 * np.log(np.diag(information)).sum()
    # weakly held towards the box's width: an input that nothing depends on has no length
    off = theta[:d] - 0.5
    value = 0.5 * moving.shape[1] * (free * np.log(size) + determinant) + 0.5 * float(off @ off)
    weight = 0.5 * (moving.shape[1] * (inverse - q.T @ q) - py @ py.T / size)
    gradient = np.empty(d + 1)
    gradient[d] = float(weight.diagonal() @ own) * nugget / (nugget + _JITTER)
    along, by = rows.along(), rows.divided(lengths)
    slopes = along >= 0
    there = np.flatnonzero(rows.seen.ravel())
    full = np.zeros((rows.seen.size, rows.seen.size))
    full[np.ix_(there, there)] = weight / by / by[:, None]
    n = len(rows.z)
    gradient[:d] = length_gradient(kind, rows.z / lengths, rows.every, full.reshape(1 + d, n, 1 + d, n)) + off
    # the rows of derivatives are divided by their length, once as rows and once as columns; their nugget twice
    drop = 2.0 * (weight * k).sum(1) + 2.0 * weight.diagonal() * own
    np.subtract.at(gradient, along[slopes], drop[slopes])
    return float(value), gradient


def _left_out(
    rows: Rows, inverse_factor: FloatArray, trend_rows: FloatArray, trend_factor: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Errors (n, p) of runs left out, one after the other with their derivatives, and the share (n,) of the kernel's variance
    that is not known of them. Runs that stand alone (all others far) count as others."""
    q = trend_factor @ trend_rows
    projected = inverse_factor.T @ inverse_factor - q.T @ q
    of = rows.run()
    error, share = np.empty((len(rows.z), weights.shape[1])), np.empty(len(rows.z))
    for i in range(len(rows.z)):
        block = np.flatnonzero(of == i)  # the value's row is the first
        inside = np.linalg.pinv(projected[np.ix_(block, block)], hermitian=True)
        error[i], share[i] = (inside @ weights[block])[0], max(inside[0, 0], 1e-12)
    return error, share


def _moving(rows: Rows, observed: FloatArray) -> FloatArray:
    """The observations (N, q) in the directions of output space that move with the inputs beyond the trend."""
    basis = rows.basis()
    left = observed - basis @ np.linalg.lstsq(basis, observed, rcond=None)[0]
    _, size, directions = np.linalg.svd(left, full_matrices=False)
    keep = size > _SIGNAL * np.sqrt(len(observed))
    return np.asarray(observed @ directions[keep][:_MOST_MOVING].T)


def _factors(rows: Rows, kind: Kind, lengths: FloatArray, nugget: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """L^-1 of the kernel's matrix, H' K^-1 with the trend's basis H, and L^-1 of H' K^-1 H."""
    k, own = rows.kernel(kind, lengths, nugget)
    k[np.diag_indices(len(k))] += own
    inverse_factor = np.tril(solve_triangular(np.linalg.cholesky(k), np.eye(len(k)), lower=True))
    h = inverse_factor @ rows.basis()
    d = h.shape[1]
    trend_factor = solve_triangular(np.linalg.cholesky(h.T @ h + 1e-12 * np.eye(d)), np.eye(d), lower=True)
    return inverse_factor, h.T @ inverse_factor, trend_factor


def _parts(z: FloatArray) -> list[FloatArray]:
    return [z[start : start + _ROWS] for start in range(0, len(z), _ROWS)]
