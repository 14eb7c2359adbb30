"""Emulation of all residuals at once from runs' values and derivatives.

Outputs r (p,) share one kernel over the inputs z, and a covariance S (p, p) among themselves: r(z) = b(z) + g(z), b linear,
cov(g(z), g(z')) = k(z, z') S, k the squared-exponential kernel with a length for each input. Derivatives are observations of
the same process: cov(dg/dz_i, g') = dk/dz_i S, and so on. In the eigenvectors U of S the components c = U' r are independent,
with variance S_k v(z), and |c| = |r|: the likelihood needs nothing else. (Morris, Mitchell, Ylvisaker 1993; Conti, O'Hagan 2010.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import LacliError

# of a length, in widths of the box; of the nugget, a share of the kernel's variance
_LENGTHS, _NUGGETS = (0.08, 12.0), (1e-8, 1e-2)
_SIGNAL = 1e-3  # a component that moves less than this share of the measurement's error tells nothing of the lengths
_ROWS = 2000  # predicted at a time


@dataclass(frozen=True)
class Components:
    """The fitted process. z (n, d); told (n,): runs with derivatives; lengths (d,); nugget; weights (N, p) and trend
    (1 + d, p) of the components; variance (p,) of each; rotation (p, p) = U; lower (N, N): Cholesky factor of the kernel's
    matrix; basis (N, 1 + d) of the trend, trend_factor its information's; inflation: what held-out runs say the variance
    must be multiplied with, at least 1."""

    z: FloatArray
    told: BoolArray
    lengths: FloatArray
    nugget: float
    weights: FloatArray
    trend: FloatArray
    variance: FloatArray
    rotation: FloatArray
    lower: FloatArray
    basis: FloatArray
    trend_factor: FloatArray
    inflation: float
    held_out: float

    def mean(self, z: FloatArray) -> FloatArray:
        """Components (m, p) at z (m, d)."""
        k = _cross(z, self.z, self.told, self.lengths)
        return np.asarray(k @ self.weights + _trend(z) @ self.trend)

    def predict(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, p) of the components."""
        mean, variance = np.empty((len(z), len(self.variance))), np.empty((len(z), len(self.variance)))
        for start in range(0, len(z), _ROWS):
            part = slice(start, start + _ROWS)
            k = _cross(z[part], self.z, self.told, self.lengths)
            mean[part] = k @ self.weights + _trend(z[part]) @ self.trend
            variance[part] = self._share(z[part], k)[:, None] * self.variance
        return mean, variance

    def share(self, z: FloatArray) -> FloatArray:
        """v(z) (m,): what is not known of the kernel's variance, inflation included."""
        return np.concatenate(
            [self._share(part, _cross(part, self.z, self.told, self.lengths)) for part in _parts(z)] or [np.empty(0)]
        )

    def _share(self, z: FloatArray, k: FloatArray) -> FloatArray:
        known = solve_triangular(self.lower, k.T, lower=True)
        left = _trend(z).T - self._seen.T @ known
        free = solve_triangular(self.trend_factor, left, lower=True)
        return self.inflation * np.maximum(1.0 - (known**2).sum(0) + (free**2).sum(0), 1e-12)

    @property
    def _seen(self) -> FloatArray:
        return np.asarray(solve_triangular(self.lower, self.basis, lower=True))

    def covariance(self, z: FloatArray) -> FloatArray:
        """(m, m): the posterior covariance of the kernel's process between points, inflation included."""
        known = solve_triangular(self.lower, _cross(z, self.z, self.told, self.lengths).T, lower=True)
        free = solve_triangular(self.trend_factor, _trend(z).T - self._seen.T @ known, lower=True)
        none = np.zeros(len(z), bool)
        return np.asarray(self.inflation * (_cross(z, z, none, self.lengths) - known.T @ known + free.T @ free))

    def slope(self, z: FloatArray) -> FloatArray:
        """d mean / dz (p, d) at one point z (d,)."""
        rows = _kernel(z[None], np.ones(1, bool), self.z, self.told, self.lengths)[1:]
        return np.asarray((rows @ self.weights + self.trend[1:]).T)

    def joined_by(self, z: FloatArray) -> Components:
        """With runs added at z (k, d), of which only the place is known: for the variance they will leave."""
        points, told = np.vstack([self.z, z]), np.concatenate([self.told, np.ones(len(z), bool)])
        lower, basis, trend_factor = _factors(points, told, self.lengths, self.nugget)
        none = np.zeros((len(basis), 0))
        return Components(
            points, told, self.lengths, self.nugget, none, self.trend, self.variance, self.rotation, lower, basis, trend_factor,
            self.inflation, self.held_out,
        )  # fmt: skip


def fit(z: FloatArray, residual: FloatArray, jacobian: FloatArray, start: Components | None = None) -> Components:
    """Fit to runs at z (n, d): residual (n, p), jacobian (n, p, d), NaN where a run tells none.

    start: an earlier fit, from whose lengths the search sets out. Raises LacliError for fewer runs than a trend takes.
    """
    n, d = z.shape
    told = np.asarray(np.isfinite(jacobian).all((1, 2)))
    rows = _observations(residual, jacobian, told)
    if len(rows) < d + 3:
        raise LacliError(f"calibrate: {n} finished runs ({int(told.sum())} with derivatives) are too few to emulate {d} inputs.")
    moving = _moving(z, told, rows)
    low, high = np.log([*[_LENGTHS[0]] * d, _NUGGETS[0]]), np.log([*[_LENGTHS[1]] * d, _NUGGETS[1]])
    theta = np.log([*[1.0] * d, 1e-5]) if start is None else np.log([*start.lengths, start.nugget])

    def cost(theta: FloatArray) -> float:
        try:
            lower, basis, trend_factor = _factors(z, told, np.exp(theta[:d]), float(np.exp(theta[d])))
        except np.linalg.LinAlgError:
            return 1e12
        _, spread = _generalised(lower, basis, trend_factor, moving)
        size = np.maximum((spread**2).sum(0) / (len(moving) - d - 1), 1e-12)
        determinant = 2.0 * np.log(np.diag(lower)).sum() + 2.0 * np.log(np.diag(trend_factor)).sum()
        # weakly held towards the box's width: an input that nothing depends on has no length
        held = 0.5 * float(((theta[:d] - 0.5) ** 2).sum())
        return float(0.5 * ((len(moving) - d - 1) * np.log(size).sum() + determinant * moving.shape[1]) + held)

    if moving.shape[1]:
        found = minimize(cost, np.clip(theta, low, high), method="L-BFGS-B", bounds=list(zip(low, high, strict=True)),
                         options={"maxiter": 25, "ftol": 1e-6})  # fmt: skip
        theta = found.x
    lengths, nugget = np.exp(theta[:d]), float(np.exp(theta[d]))
    lower, basis, trend_factor = _factors(z, told, lengths, nugget)
    trend, white = _generalised(lower, basis, trend_factor, rows)
    spread = white.T @ white / (len(rows) - d - 1)
    variance, rotation = np.linalg.eigh(spread)
    variance = np.maximum(variance, 1e-12)
    weights = solve_triangular(lower, white, lower=True, trans=1) @ rotation
    held_out = _held_out(lower, basis, trend_factor, white @ rotation, variance, n, told)
    return Components(
        z, told, lengths, nugget, weights, trend @ rotation, variance, rotation, lower, basis, trend_factor,
        max(1.0, held_out), held_out,
    )  # fmt: skip


def _held_out(
    lower: FloatArray,
    basis: FloatArray,
    trend_factor: FloatArray,
    white: FloatArray,
    variance: FloatArray,
    n: int,
    told: BoolArray,
) -> float:
    """Mean squared error of runs left out, one after the other with their derivatives, over what the process says of it.

    Components count by their variance: what moves the likelihood. Runs that stand alone (all others far) count as others.
    """
    inverse = cho_solve((lower, True), np.eye(len(lower)))
    information = solve_triangular(trend_factor, (inverse @ basis).T, lower=True)
    projected = inverse - information.T @ information
    pulled = solve_triangular(lower, white, lower=True, trans=1)
    where = np.cumsum(told) - 1
    ratios = []
    for i in range(n):
        d = basis.shape[1] - 1
        block = [i, *(range(n + where[i] * d, n + (where[i] + 1) * d) if told[i] else ())]
        inside = np.linalg.pinv(projected[np.ix_(block, block)], hermitian=True)
        error = (inside @ pulled[block])[0]
        ratios.append(float((error**2).sum() / (max(inside[0, 0], 1e-12) * variance.sum())))
    # one run far from what the process expects is one of n: the mean is what a chi-square would keep near 1
    return float(np.mean(ratios))


def _observations(residual: FloatArray, jacobian: FloatArray, told: BoolArray) -> FloatArray:
    """(N, p): values of all runs, then the derivatives of each run that tells them."""
    slopes = np.swapaxes(jacobian[told], 1, 2).reshape(-1, residual.shape[1])
    return np.vstack([residual, slopes])


def _moving(z: FloatArray, told: BoolArray, rows: FloatArray) -> FloatArray:
    """The observations (N, q) in the directions of output space that move with the inputs beyond the trend."""
    basis = _basis(z, told)
    left = rows - basis @ np.linalg.lstsq(basis, rows, rcond=None)[0]
    _, size, directions = np.linalg.svd(left, full_matrices=False)
    keep = size > _SIGNAL * np.sqrt(len(rows))
    return np.asarray(rows @ directions[keep][:20].T)


def _generalised(
    lower: FloatArray, basis: FloatArray, trend_factor: FloatArray, rows: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Trend (1 + d, q) by generalised least squares, and what is left, L^-1 (rows - basis trend) (N, q)."""
    seen, said = solve_triangular(lower, basis, lower=True), solve_triangular(lower, rows, lower=True)
    trend = cho_solve((trend_factor, True), seen.T @ said)
    return trend, said - seen @ trend


def _factors(z: FloatArray, told: BoolArray, lengths: FloatArray, nugget: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cholesky factors of the kernel's matrix and of the trend's information, and the trend's basis."""
    k = _kernel(z, told, z, told, lengths)
    own = np.concatenate([np.ones(len(z)), np.tile(1.0 / lengths**2, int(told.sum()))])
    k[np.diag_indices_from(k)] += (nugget + 1e-10) * own
    lower = cholesky(k, lower=True, check_finite=False)
    basis = _basis(z, told)
    seen = solve_triangular(lower, basis, lower=True)
    return lower, basis, cholesky(seen.T @ seen + 1e-12 * np.eye(basis.shape[1]), lower=True)


def _basis(z: FloatArray, told: BoolArray) -> FloatArray:
    d = z.shape[1]
    slopes = np.tile(np.hstack([np.zeros((d, 1)), np.eye(d)]), (int(told.sum()), 1))
    return np.vstack([_trend(z), slopes])


def _trend(z: FloatArray) -> FloatArray:
    return np.hstack([np.ones((len(z), 1)), z])


def _cross(z: FloatArray, runs: FloatArray, told: BoolArray, lengths: FloatArray) -> FloatArray:
    """(m, N): the kernel between values at z and what the runs tell."""
    return _kernel(z, np.zeros(len(z), bool), runs, told, lengths)


def _kernel(a: FloatArray, slopes_a: BoolArray, b: FloatArray, slopes_b: BoolArray, lengths: FloatArray) -> FloatArray:
    """The kernel's matrix between values at a and b, followed by derivatives where slopes_a and slopes_b say so."""
    s, t, precision = a / lengths, b / lengths, 1.0 / lengths
    value = np.exp(-0.5 * np.maximum((s**2).sum(1)[:, None] + (t**2).sum(1) - 2.0 * s @ t.T, 0.0))
    way_b = (s[:, None, :] - t[None, slopes_b]) * precision  # (m, nb, d)
    m, d = len(a), len(lengths)
    right = (value[:, slopes_b, None] * way_b).reshape(m, -1)
    top = np.hstack([value, right])
    if not slopes_a.any():
        return top
    way_a = (s[slopes_a, None, :] - t[None]) * precision  # (na, n, d)
    left = -np.swapaxes(value[slopes_a, :, None] * way_a, 1, 2).reshape(-1, len(b))
    both = way_a[:, slopes_b]  # (na, nb, d)
    inner = -both[..., :, None] * both[..., None, :] + np.diag(precision**2)
    inner *= value[np.ix_(slopes_a, slopes_b)][..., None, None]
    corner = inner.transpose(0, 2, 1, 3).reshape(int(slopes_a.sum()) * d, -1)
    return np.vstack([top, np.hstack([left, corner])])


def _parts(z: FloatArray) -> list[FloatArray]:
    return [z[start : start + _ROWS] for start in range(0, len(z), _ROWS)]
