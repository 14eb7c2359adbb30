"""One Gaussian process with a linear mean: restricted likelihood with its gradient, fit, factors for prediction.

Kernel s2 exp(-1/2 sum_j ((u_j - u'_j) / l_j)^2); observation covariance K = s2 (K0 + eta I) + diag(noise). The mean's
coefficients have a flat prior and are integrated out (restricted likelihood; Rasmussen and Williams 2006, section 2.7).
Everything is in standardised units: u in about [-1, 1], y of unit variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri, dpstrf
from scipy.optimize import minimize

from lacli.base.arrays import FloatArray

LENGTH_BOUNDS = (0.05, 100.0)
S2_BOUNDS = (1e-4, 1e4)
# the nugget relative to s2; its floor keeps K's condition number under n / 1e-8, so factorisation never fails
ETA_BOUNDS = (1e-8, 1e2)
# weak log-normal priors (centre, sd of the log): they only keep flat directions of the likelihood from running away
_LENGTH_PRIOR = (np.log(3.0), 2.0)
_S2_PRIOR = (0.0, 3.0)
_ETA_PRIOR = (np.log(1e-3), 3.0)
_START_LENGTH = 2.0
# drawing hyperparameters: step of the second derivatives, widest standard deviation of a flat direction (its prior's),
# candidates for each one drawn
_HESSIAN_STEP, _WIDEST, _CANDIDATES = 1e-3, 2.0, 6
_START_ETA = 1e-3


@dataclass(frozen=True)
class GP:
    """A fitted process: theta = log (l_1..l_d, s2, eta), the data (u (n, d), y (n,), noise variance (n,)), the factors.

    Factors: inverse Cholesky factor R (n, n) of K = L L', R = L^-1; alpha (n,) = K^-1 (y - H beta); beta (1 + d,);
    g (1 + d, n) = H' K^-1; c (1 + d, 1 + d), the inverse Cholesky factor of H' K^-1 H.
    """

    theta: FloatArray
    u: FloatArray
    y: FloatArray
    noise: FloatArray
    objective: float
    inverse_factor: FloatArray
    alpha: FloatArray
    beta: FloatArray
    g: FloatArray
    c: FloatArray

    @property
    def lengths(self) -> FloatArray:
        """Length scales (d,) in units of u."""
        return np.exp(self.theta[:-2])

    @property
    def s2(self) -> float:
        """Variance of the process."""
        return float(np.exp(self.theta[-2]))

    @property
    def nugget(self) -> float:
        """Variance of the nugget."""
        return float(np.exp(self.theta[-2] + self.theta[-1]))

    def predict(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m,) and variance (m,) of an observation at u (m, d), nugget included, the mean's uncertainty too."""
        z, zs = self.u / self.lengths, u / self.lengths
        k = self.s2 * np.exp(np.minimum(zs @ z.T - 0.5 * (zs**2).sum(1)[:, None] - 0.5 * (z**2).sum(1), 0.0))
        h = basis(u)
        v = k @ self.inverse_factor.T
        w = (h - k @ self.g.T) @ self.c.T
        return h @ self.beta + k @ self.alpha, self.s2 + self.nugget - (v**2).sum(1) + (w**2).sum(1)

    def leave_one_out(self) -> tuple[FloatArray, FloatArray]:
        """Leave-one-out errors (n,) and variances (n,) at fixed theta, the mean refitted (Dubrule 1983)."""
        k_inverse = self.inverse_factor.T @ self.inverse_factor
        q = self.g.T @ self.c.T
        p = k_inverse - q @ q.T
        variance = 1.0 / np.diag(p)
        return (p @ self.y) * variance, variance


def basis(u: FloatArray) -> FloatArray:
    """The linear mean's functions (m, 1 + d): one and each input."""
    return np.hstack([np.ones((len(u), 1)), u])


def negative_log_likelihood(theta: FloatArray, u: FloatArray, y: FloatArray, noise: FloatArray) -> tuple[float, FloatArray]:
    """Negative log restricted likelihood with the weak priors (constants dropped), and its gradient in theta (d + 2,)."""
    n, d = u.shape
    lengths, s2, eta = np.exp(theta[:d]), np.exp(theta[d]), np.exp(theta[d + 1])
    z = u / lengths
    square = z**2
    half = 0.5 * square.sum(1)
    k0 = z @ z.T
    k0 -= half[:, None]
    k0 -= half
    np.minimum(k0, 0.0, out=k0)
    np.exp(k0, out=k0)
    k0 *= s2
    covariance = k0.copy(order="F")
    covariance[np.diag_indices(n)] += s2 * eta + noise
    factor, info = dpotrf(covariance, lower=1, overwrite_a=1)
    if info != 0:  # cannot happen within the bounds unless the data are not finite
        return 1e25, np.zeros_like(theta)
    log_determinant = np.log(np.diag(factor)).sum()
    k_inverse, _ = dpotri(factor, lower=1, overwrite_c=1)
    lower = np.tril(k_inverse, -1)
    k_inverse = lower + lower.T + np.diag(np.diag(k_inverse))
    h = basis(u)
    kh = k_inverse @ h
    a_factor = np.linalg.cholesky(h.T @ kh)
    q = solve_triangular(a_factor, kh.T, lower=True).T
    p = k_inverse - q @ q.T
    py = p @ y
    value = 0.5 * y @ py + log_determinant + np.log(np.diag(a_factor)).sum()
    weight = p
    weight -= np.outer(py, py)
    weight *= 0.5
    trace = np.trace(weight)
    weight *= k0
    rows = weight.sum(1)
    gradient = np.empty(d + 2)
    gradient[:d] = 2.0 * (rows @ square - np.einsum("ij,ij->j", z, weight @ z))
    gradient[d + 1] = s2 * eta * trace
    gradient[d] = rows.sum() + gradient[d + 1]
    centre, spread = prior(d)
    off = (theta - centre) / spread
    return float(value + 0.5 * off @ off), gradient + off / spread


def prior(d: int) -> tuple[FloatArray, FloatArray]:
    """Centre and standard deviation (d + 2,) of theta's weak log-normal priors."""
    centre = np.array([_LENGTH_PRIOR[0]] * d + [_S2_PRIOR[0], _ETA_PRIOR[0]])
    spread = np.array([_LENGTH_PRIOR[1]] * d + [_S2_PRIOR[1], _ETA_PRIOR[1]])
    return centre, spread


def maximise(
    u: FloatArray, y: FloatArray, noise: FloatArray, starts: list[FloatArray], max_iterations: int = 200
) -> tuple[FloatArray, float]:
    """Best theta (d + 2,) and objective over L-BFGS-B runs from the starts."""
    d = u.shape[1]
    bounds = [tuple(np.log(LENGTH_BOUNDS))] * d + [tuple(np.log(S2_BOUNDS)), tuple(np.log(ETA_BOUNDS))]
    best_theta, best_value = starts[0], np.inf
    for start in starts:
        result = minimize(
            negative_log_likelihood,
            np.clip(start, [b[0] for b in bounds], [b[1] for b in bounds]),
            args=(u, y, noise),
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": max_iterations, "ftol": 1e-8, "gtol": 1e-3},
        )
        if np.isfinite(result.fun) and result.fun < best_value:
            best_theta, best_value = result.x, float(result.fun)
    return best_theta, best_value


def starting_points(d: int, count: int, rng: np.random.Generator) -> list[FloatArray]:
    """A default start and count - 1 random ones in log space."""
    starts = [np.log(np.array([_START_LENGTH] * d + [1.0, _START_ETA]))]
    for _ in range(count - 1):
        starts.append(np.log(np.r_[np.exp(rng.uniform(np.log(0.5), np.log(10.0), d)), 1.0, 10.0 ** rng.uniform(-5, -1)]))
    return starts


def plausible_thetas(process: GP, count: int, rng: np.random.Generator) -> FloatArray:
    """Hyperparameters (count, d + 2) drawn from their posterior: a normal approximation at the fitted ones, corrected by
    importance resampling (weights tempered so far that ``count`` different ones are left)."""
    data = (process.u, process.y, process.noise)
    centre, size = process.theta, len(process.theta)
    hessian = np.empty((size, size))
    for i, step in enumerate(_HESSIAN_STEP * np.eye(size)):
        ahead, behind = (negative_log_likelihood(centre + s * step, *data)[1] for s in (1.0, -1.0))
        hessian[i] = (ahead - behind) / (2.0 * _HESSIAN_STEP)
    value, vector = np.linalg.eigh(0.5 * (hessian + hessian.T))
    root = vector / np.sqrt(np.maximum(value, 1.0 / _WIDEST**2))
    z = rng.standard_normal((_CANDIDATES * count, size))
    bounds = np.log(np.array([LENGTH_BOUNDS] * (size - 2) + [S2_BOUNDS, ETA_BOUNDS]))
    thetas = np.clip(centre + z @ root.T, bounds[:, 0], bounds[:, 1])
    objective = np.array([negative_log_likelihood(theta, *data)[0] for theta in thetas])
    weight = 0.5 * (z**2).sum(1) - objective
    weight -= weight.max()
    for _ in range(20):
        share = np.exp(weight) / np.exp(weight).sum()
        if 1.0 / (share**2).sum() >= count:
            break
        weight *= 0.7
    return thetas[np.searchsorted(np.cumsum(share), (np.arange(count) + rng.random()) / count).clip(max=len(thetas) - 1)]


def pivots(theta: FloatArray, u: FloatArray) -> NDArray[np.int64]:
    """Order of the runs (n,) in which each is the one least known from those before it (pivoted Cholesky)."""
    z = u / np.exp(theta[:-2])
    half = 0.5 * (z**2).sum(1)
    covariance = np.exp(np.minimum(z @ z.T - half[:, None] - half, 0.0))
    covariance[np.diag_indices(len(u))] += np.exp(theta[-1])
    _, order, _, _ = dpstrf(np.asfortranarray(covariance), lower=1)
    return order.astype(np.int64) - 1


def condition(theta: FloatArray, u: FloatArray, y: FloatArray, noise: FloatArray, objective: float = np.nan) -> GP:
    """The process with given theta conditioned on the data: all factors a prediction needs."""
    n, d = u.shape
    lengths, s2, eta = np.exp(theta[:d]), np.exp(theta[d]), np.exp(theta[d + 1])
    z = u / lengths
    half = 0.5 * (z**2).sum(1)
    covariance = s2 * np.exp(np.minimum(z @ z.T - half[:, None] - half, 0.0))
    covariance[np.diag_indices(n)] += s2 * eta + noise
    factor = np.linalg.cholesky(covariance)
    r = solve_triangular(factor, np.eye(n), lower=True)
    h = basis(u)
    rh = r @ h
    a_factor = np.linalg.cholesky(rh.T @ rh)
    c = solve_triangular(a_factor, np.eye(d + 1), lower=True)
    ry = r @ y
    beta = c.T @ (c @ (rh.T @ ry))
    return GP(
        theta=np.asarray(theta, float), u=u, y=y, noise=noise, objective=objective,
        inverse_factor=np.tril(r), alpha=r.T @ (ry - rh @ beta), beta=beta, g=rh.T @ r, c=np.tril(c),
    )  # fmt: skip
