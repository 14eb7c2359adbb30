"""One Gaussian process with a linear mean, learnt from values and derivatives: restricted likelihood, fit, prediction.

As ``gp``, with rows for derivatives: their noise is a share eta_g of how much each derivative varies over the runs. The
linear mean's coefficients, with derivatives 1 of their own input, are integrated out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.optimize import minimize

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.inference.emulation import gp
from lacli.inference.emulation.gradient_kernel import Kind, blocks, length_gradient, mean_gradient, value_rows

# rows of a process at most: a fit takes time as their cube, and a table has no more runs
MOST_ROWS = 4_000
# the share of a derivative's variance that is noise
_SHARE_BOUNDS = (1e-8, 1.0)
_SHARE_PRIOR = (np.log(1e-4), 3.0)
# points of a block of predictions hold about so many covariances
_ENTRIES = 1_000_000


@dataclass(frozen=True)
class Data:
    """u (n, d); rows: which of (value, derivatives along ``active`` (a)) of each run are there, (1 + a, n); what they are, same
    shape, 0 where absent; noise (n,): variance of each run's value; slope_variance (a,): of each derivative over the runs."""

    u: FloatArray
    active: IntArray
    rows: BoolArray
    observed: FloatArray
    noise: FloatArray
    slope_variance: FloatArray

    def part(self, runs: IntArray) -> Data:
        """The same of some runs."""
        return replace(self, u=self.u[runs], rows=self.rows[:, runs], observed=self.observed[:, runs], noise=self.noise[runs])

    def basis(self) -> FloatArray:
        """The linear mean's functions at the rows (N, 1 + d)."""
        n, d = self.u.shape
        h = np.zeros((1 + len(self.active), n, 1 + d))
        h[0] = gp.basis(self.u)
        for i, j in enumerate(self.active):
            h[1 + i, :, 1 + j] = 1.0
        return h[self.rows]


@dataclass(frozen=True)
class GradientGP:
    """A fitted process: theta = log (l_1..l_d, s2, eta, eta_g), its data, and the factors of ``gp.GP`` over all rows (N)."""

    kind: Kind
    theta: FloatArray
    data: Data
    objective: float
    inverse_factor: FloatArray
    alpha: FloatArray
    beta: FloatArray
    g: FloatArray
    c: FloatArray

    @property
    def lengths(self) -> FloatArray:
        """Length scales (d,) in units of u."""
        return np.exp(self.theta[:-3])

    @property
    def s2(self) -> float:
        """Variance of the process."""
        return float(np.exp(self.theta[-3]))

    @property
    def nugget(self) -> float:
        """Variance of a value's nugget."""
        return float(np.exp(self.theta[-3] + self.theta[-2]))

    def noise(self) -> FloatArray:
        """Variance (N,) of each row's noise, nugget included."""
        return _noise(self.theta, self.data)

    def covariances(self, u: FloatArray) -> FloatArray:
        """(m, N): of values at u (m, d) with the rows."""
        d = self.data
        k = value_rows(self.kind, u / self.lengths, d.u / self.lengths, d.active)
        k[:, 1:] /= self.lengths[d.active, None]
        return self.s2 * k[:, d.rows]

    def predict(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m,) and variance (m,) of an observation at u (m, d), nugget included, the mean's uncertainty too."""
        mean, variance = np.empty(len(u)), np.empty(len(u))
        for part in _parts(len(u), len(self.alpha)):
            k, h = self.covariances(u[part]), gp.basis(u[part])
            mean[part] = h @ self.beta + k @ self.alpha
            v = k @ self.inverse_factor.T
            w = (h - k @ self.g.T) @ self.c.T
            variance[part] = self.s2 + self.nugget - (v**2).sum(1) + (w**2).sum(1)
        return mean, np.maximum(variance, self.nugget)

    def predict_mean(self, u: FloatArray) -> FloatArray:
        """Mean (m,) alone."""
        mean = gp.basis(u) @ self.beta
        for part in _parts(len(u), len(self.alpha)):
            mean[part] += self.covariances(u[part]) @ self.alpha
        return mean

    def predict_gradient(self, u: FloatArray) -> FloatArray:
        """The mean's gradient (m, d) by u."""
        d = self.data
        weight = np.zeros(d.rows.shape)
        weight[d.rows] = self.alpha
        weight[1:] /= self.lengths[d.active, None]
        result = np.empty_like(u)
        for part in _parts(len(u), len(d.u) * (1 + len(d.active))):
            result[part] = mean_gradient(self.kind, u[part] / self.lengths, d.u / self.lengths, d.active, weight)
        return self.beta[1:] + self.s2 * result / self.lengths

    def leave_one_run_out(self) -> tuple[FloatArray, FloatArray]:
        """Errors (n,) and variances (n,) of each run's value without the run, its derivatives included, at fixed theta, the mean
        refitted; NaN where a run's value is not there."""
        d = self.data
        q = self.g.T @ self.c.T
        y = d.observed[d.rows]
        precision = self.inverse_factor.T @ self.inverse_factor - q @ q.T
        py = precision @ y
        place = np.full(d.rows.shape, -1)
        place[d.rows] = np.arange(len(y))
        error, variance = np.full(len(d.u), np.nan), np.full(len(d.u), np.nan)
        for i in range(len(d.u)):
            mine = place[d.rows[:, i], i]
            if d.rows[0, i]:
                block = np.linalg.inv(precision[np.ix_(mine, mine)])
                error[i], variance[i] = block[0] @ py[mine], block[0, 0]
        return error, variance


def _parts(m: int, rows: int) -> list[slice]:
    size = max(16, _ENTRIES // max(rows, 1))
    return [slice(begin, begin + size) for begin in range(0, m, size)]


def _bounds(d: int) -> FloatArray:
    return np.log(np.array([gp.LENGTH_BOUNDS] * d + [gp.S2_BOUNDS, gp.ETA_BOUNDS, _SHARE_BOUNDS]))


def check_theta(theta: FloatArray, d: int) -> bool:
    """Whether theta is one that a fit gives."""
    bounds = _bounds(d)
    return len(theta) == d + 3 and bool((theta >= bounds[:, 0] - 1e-9).all() and (theta <= bounds[:, 1] + 1e-9).all())


def _covariance(kind: Kind, theta: FloatArray, data: Data) -> tuple[FloatArray, FloatArray, FloatArray]:
    """K without noise (N, N), the noise variances (N,), and the length scale each row is divided by (N,)."""
    d = data.u.shape[1]
    lengths, s2 = np.exp(theta[:d]), np.exp(theta[d])
    divided = np.ones(data.rows.shape)
    divided[1:] = lengths[data.active, None]
    z = data.u / lengths
    scale = divided[data.rows]
    there = np.flatnonzero(data.rows.ravel())
    k = s2 * blocks(kind, z, z, data.active).reshape(data.rows.size, data.rows.size)[np.ix_(there, there)]
    k /= scale
    k /= scale[:, None]
    return k, _noise(theta, data), scale


def _noise(theta: FloatArray, data: Data) -> FloatArray:
    s2, eta, share = np.exp(theta[-3:])
    noise = np.empty(data.rows.shape)
    noise[0] = s2 * eta + data.noise
    noise[1:] = share * data.slope_variance[:, None]
    return noise[data.rows]


def negative_log_likelihood(theta: FloatArray, kind: Kind, data: Data) -> tuple[float, FloatArray]:
    """Negative log restricted likelihood with weak priors (constants dropped), and its gradient in theta (d + 3,)."""
    n, d = data.u.shape
    k, noise, scale = _covariance(kind, theta, data)
    covariance = k.copy(order="F")
    covariance[np.diag_indices(len(k))] += noise
    factor, info = dpotrf(covariance, lower=1, overwrite_a=1)
    if info != 0:
        return 1e25, np.zeros_like(theta)
    log_determinant = np.log(np.diag(factor)).sum()
    inverse, _ = dpotri(factor, lower=1, overwrite_c=1)
    lower = np.tril(inverse, -1)
    inverse = lower + lower.T + np.diag(np.diag(inverse))
    h, y = data.basis(), data.observed[data.rows]
    kh = inverse @ h
    try:
        a_factor = np.linalg.cholesky(h.T @ kh)
    except np.linalg.LinAlgError:
        return 1e25, np.zeros_like(theta)
    q = solve_triangular(a_factor, kh.T, lower=True).T
    weight = inverse - q @ q.T
    py = weight @ y
    value = 0.5 * y @ py + log_determinant + np.log(np.diag(a_factor)).sum()
    weight -= np.outer(py, py)
    weight *= 0.5
    gradient = np.empty(d + 3)
    diagonal = np.diag(weight)
    along = np.broadcast_to(np.r_[-1, data.active][:, None], data.rows.shape)[data.rows]
    values = along < 0
    row_sums = (weight * k).sum(1)
    at_values = float(diagonal[values] @ np.full(int(values.sum()), np.exp(theta[d] + theta[d + 1])))
    gradient[d] = row_sums.sum() + at_values
    gradient[d + 1] = at_values
    gradient[d + 2] = float(diagonal[~values] @ noise[~values])
    full = np.zeros((data.rows.size, data.rows.size))
    there = np.flatnonzero(data.rows.ravel())
    full[np.ix_(there, there)] = weight * np.exp(theta[d]) / scale / scale[:, None]
    a = len(data.active)
    gradient[:d] = length_gradient(kind, data.u / np.exp(theta[:d]), data.active, full.reshape(1 + a, n, 1 + a, n))
    np.subtract.at(gradient, along[~values], 2.0 * row_sums[~values])
    centre, spread = _prior(d)
    off = (theta - centre) / spread
    return float(value + 0.5 * off @ off), gradient + off / spread


def _prior(d: int) -> tuple[FloatArray, FloatArray]:
    centre, spread = gp.prior(d)
    return np.r_[centre, _SHARE_PRIOR[0]], np.r_[spread, _SHARE_PRIOR[1]]


def maximise(kind: Kind, data: Data, start: FloatArray, iterations: int = 100) -> tuple[FloatArray, float]:
    """Best theta (d + 3,) and its objective, climbing from ``start``."""
    bounds = _bounds(data.u.shape[1])
    result = minimize(
        negative_log_likelihood, np.clip(start, bounds[:, 0], bounds[:, 1]), args=(kind, data), jac=True, method="L-BFGS-B",
        bounds=list(map(tuple, bounds)), options={"maxiter": iterations, "ftol": 1e-7, "gtol": 1e-2},
    )  # fmt: skip
    return np.asarray(result.x, float), float(result.fun)


def start(data: Data) -> FloatArray:
    """Theta (d + 3,) by moments: of a process of unit variance, a derivative varies by 1 / l^2 over the runs."""
    d = data.u.shape[1]
    lengths = np.full(d, 10.0)
    lengths[data.active] = np.clip(1.0 / np.sqrt(np.maximum(data.slope_variance, 1e-6)), 0.3, 30.0)
    return np.r_[np.log(lengths), 0.0, np.log(1e-5), np.log(1e-4)]


def condition(kind: Kind, theta: FloatArray, data: Data, objective: float = np.nan) -> GradientGP:
    """The process with given theta conditioned on the data. Raises LinAlgError where the rows carry no linear mean."""
    k, noise, _ = _covariance(kind, theta, data)
    k[np.diag_indices(len(k))] += noise
    r = solve_triangular(np.linalg.cholesky(k), np.eye(len(k)), lower=True)
    h, y = data.basis(), data.observed[data.rows]
    rh, ry = r @ h, r @ y
    c = solve_triangular(np.linalg.cholesky(rh.T @ rh), np.eye(h.shape[1]), lower=True)
    beta = c.T @ (c @ (rh.T @ ry))
    return GradientGP(kind, np.asarray(theta, float), data, objective, np.tril(r), r.T @ (ry - rh @ beta), beta, rh.T @ r, c)
