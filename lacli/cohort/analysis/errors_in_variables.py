"""A slope between two quantities of which each is known only up to a posterior: a structural model, fitted by REML.

For patient i and region j, with x the true predictor, w its posterior mean and y the response,

    x_ij = mu_j + a_i + d_ij        a ~ N(0, tau^2), d ~ N(0, omega^2)
    w_ij = x_ij + u_ij              u_i ~ N(0, S_i), S_i the posterior's covariance of patient i, known
    y_ij = gamma_j + beta x_ij + b_i + e_ij + v_ij      b ~ N(0, sigma_b^2), e ~ N(0, sigma_e^2), v_i ~ N(0, T_i), known

(Fuller, Measurement Error Models, 1987; Carroll et al., Measurement Error in Nonlinear Models, 2006, ch. 8.) x is never seen:
integrated out, (w_i, y_i) is normal with a covariance that beta enters, and the regions' means form a design that it does not, so
that restricted likelihoods at different beta may be compared. The interval holds every beta whose likelihood ratio is within the
quantile of F(1, df); it may be unbounded, as it must where the posteriors are as wide as the patients differ.
df is Satterthwaite's: the variance f of beta's estimate is itself an estimate from the few patients there are, and df =
2 f^2 / var(f), as Fai and Cornelius (J. Stat. Comput. Simul. 54, 1996) take it for fixed effects. Here beta stands among the
covariance's parameters, so that f is its element of the inverse expected information of them all; and since each beta is tested
as given, var(f) is that which the four variances bring.
It rests on posteriors whose error is independent of the truth: a flat prior that the data dominate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.stats import f as f_distribution

from lacli.base.arrays import FloatArray

_FLOOR = 1e-6  # of a quantity's variance: less is none
_STEP = 1e-3  # of derivatives on beta and the log variances, which are of order 1
_FARTHEST = 1e3  # of the quantities' ratio of spreads: a slope beyond it is no longer told from any


@dataclass(frozen=True)
class Slope:
    """beta with its interval (``low``, ``high``; infinite where unbounded) and p of beta = 0.

    reliability: the share of the predictor's variance within patients that is no error of its posterior; tau, omega, sigma_b,
    sigma_e: standard deviations of the model; df: Satterthwaite's denominator degrees of freedom of the F distribution, at most
    those of the residuals within patients.
    """

    beta: float
    low: float
    high: float
    p: float
    reliability: float
    tau: float
    omega: float
    sigma_b: float
    sigma_e: float
    df: float


def structural_slope(w: FloatArray, y: FloatArray, s: FloatArray, t: FloatArray, level: float = 0.95) -> Slope:
    """The slope of y on the truth behind w.

    w, y: (patients, regions). s, t: (patients, regions, regions) covariances of their errors. level: of the interval.
    Raises ValueError for fewer than 3 patients or 2 regions, or a quantity that does not vary within patients.
    """
    patients, regions = w.shape
    if patients < 3 or regions < 2:
        raise ValueError("at least 3 patients and 2 regions")
    scale_w, scale_y = (float(np.std(_centred(q))) for q in (w, y))
    if not (scale_w > 0 and scale_y > 0):
        raise ValueError("a quantity does not vary")
    model = _Model(_centred(w) / scale_w, _centred(y) / scale_y, s / scale_w**2, t / scale_y**2)
    beta, best, at = model.fit()
    df = model.degrees_of_freedom(beta, at, patients * regions - regions - (patients - 1) - 1)
    drop = float(f_distribution.ppf(level, 1, df))

    def excess(value: float, start: FloatArray) -> tuple[float, FloatArray]:
        found, where = model.profile(value, start)
        return found - best - drop, where

    low, high = (_limit(excess, beta, at, sign) for sign in (-1.0, 1.0))
    ratio = max(model.profile(0.0, at)[0] - best, 0.0)
    tau, omega, sigma_b, sigma_e = np.sqrt(np.where(at > math.log(_FLOOR) + 0.5, np.exp(at), 0.0))
    error = float(np.mean(np.trace(s, axis1=1, axis2=2) / regions)) / scale_w**2
    unit = scale_y / scale_w
    return Slope(
        beta * unit, low * unit, high * unit, float(f_distribution.sf(ratio, 1, df)), float(omega**2 / (omega**2 + error)),
        float(tau * scale_w), float(omega * scale_w), float(sigma_b * scale_y), float(sigma_e * scale_y), df,
    )  # fmt: skip


def _centred(q: FloatArray) -> FloatArray:
    """Without the regions' means, which a complete table's generalised least squares takes out as they are."""
    centred: FloatArray = q - q.mean(axis=0)
    return centred


class _Model:
    """-2 log restricted likelihood of (beta, log variances tau, omega, sigma_b, sigma_e) for scaled data."""

    def __init__(self, w: FloatArray, y: FloatArray, s: FloatArray, t: FloatArray) -> None:
        self.n, self.r = w.shape
        self.data = np.concatenate([w, y], axis=1)
        self.s, self.t = s, t
        self.ones, self.eye = np.ones((self.r, self.r)), np.eye(self.r)
        self.bounds = [(math.log(_FLOOR), math.log(1e3))] * 4

    def covariance(self, beta: float, logs: FloatArray) -> FloatArray:
        """Of (w_i, y_i), (patients, 2 regions, 2 regions)."""
        tau, omega, sigma_b, sigma_e = np.exp(logs)
        x = tau * self.ones + omega * self.eye
        r = self.r
        v = np.empty((self.n, 2 * r, 2 * r))
        v[:, :r, :r] = x + self.s
        v[:, :r, r:] = v[:, r:, :r] = beta * x
        v[:, r:, r:] = beta**2 * x + sigma_b * self.ones + sigma_e * self.eye + self.t
        return v

    def minus_two_log_likelihood(self, beta: float, logs: FloatArray) -> float:
        v = self.covariance(beta, logs)
        try:
            inverse = np.linalg.inv(v)
            sign, logdet = np.linalg.slogdet(v)
        except np.linalg.LinAlgError:
            return math.inf
        if (sign <= 0).any():
            return math.inf
        precision = inverse.sum(axis=0)
        weighted = np.einsum("nij,nj->ni", inverse, self.data)
        total = weighted.sum(axis=0)
        means = np.linalg.solve(precision, total)
        return float(logdet.sum() + np.linalg.slogdet(precision)[1] + (weighted * self.data).sum() - total @ means)

    def profile(self, beta: float, start: FloatArray) -> tuple[float, FloatArray]:
        """The least over the variances at ``beta``, and where."""
        found = minimize(lambda z: self.minus_two_log_likelihood(beta, z), start, method="L-BFGS-B", bounds=self.bounds)
        return float(found.fun), found.x

    def fit(self) -> tuple[float, float, FloatArray]:
        """The best beta, -2 log likelihood there, and log variances; from several starts, for it may have two valleys."""
        low, high = self.bounds[0]
        best: tuple[float, FloatArray] | None = None
        for beta in (-1.0, -0.2, 0.2, 1.0):
            start = np.array([beta, *np.log([0.3, 0.4, 0.3, 0.4])])
            found = minimize(
                lambda z: self.minus_two_log_likelihood(float(z[0]), z[1:]),
                start,
                method="L-BFGS-B",
                bounds=[(-_FARTHEST, _FARTHEST), *([(low, high)] * 4)],
            )
            if best is None or found.fun < best[0]:
                best = float(found.fun), found.x
        assert best is not None
        return float(best[1][0]), best[0], best[1][1:]

    def information(self, at: FloatArray, free: Sequence[int]) -> FloatArray:
        """Expected information of the restricted likelihood on ``at`` = (beta, log variances), its rows those that are ``free``.

        Element i, j is tr(P V_i P V_j) / 2 with V_i the covariance's derivative, P = W - W X (X' W X)^-1 X' W, W = V^-1.
        """
        w = np.linalg.inv(self.covariance(float(at[0]), at[1:]))
        c = np.linalg.inv(w.sum(axis=0))
        wd = [w @ self._derivative(at, k) for k in free]
        once = [np.einsum("nij,njk->ik", a, w) for a in wd]
        result = np.empty((len(free), len(free)))
        for i, a in enumerate(wd):
            for j, b in enumerate(wd[: i + 1]):
                ab = a @ b
                twice = (ab @ w).sum(axis=0)
                trace = float(np.trace(ab.sum(axis=0))) - 2 * float(np.sum(c * twice.T))
                result[i, j] = result[j, i] = 0.5 * (trace + float(np.trace(c @ once[i] @ c @ once[j])))
        return result

    def _derivative(self, at: FloatArray, k: int) -> FloatArray:
        """Of the covariance on parameter k, by central differences: V is quadratic in beta and an exponential of the others."""
        step = np.zeros(len(at))
        step[k] = _STEP
        ends = [self.covariance(float((at + e)[0]), (at + e)[1:]) for e in (step, -step)]
        change: FloatArray = (ends[0] - ends[1]) / (2 * _STEP)
        return change

    def degrees_of_freedom(self, beta: float, logs: FloatArray, most: int) -> float:
        """Satterthwaite's for beta, 1 to ``most``; a variance that is at nothing is not uncertain. ``most`` where the information
        is singular."""
        at = np.array([beta, *logs])
        uncertain = [1 + k for k in range(len(logs)) if logs[k] > math.log(_FLOOR) + 0.5]
        free = [0, *uncertain]
        try:
            variance = float(np.linalg.inv(self.information(at, free))[0, 0])
            slope = np.zeros(len(uncertain))
            for row, k in enumerate(uncertain):
                step = np.zeros(len(at))
                step[k] = _STEP
                ends = [float(np.linalg.inv(self.information(at + e, free))[0, 0]) for e in (step, -step)]
                slope[row] = (ends[0] - ends[1]) / (2 * _STEP)
            spread = float(slope @ np.linalg.solve(self.information(at, uncertain), slope)) if uncertain else 0.0
        except np.linalg.LinAlgError:
            return float(most)
        if not (variance > 0 and spread > 0):
            return float(most)
        return float(np.clip(2 * variance**2 / spread, 1.0, most))


def _limit(excess: Callable[[float, FloatArray], tuple[float, FloatArray]], beta: float, at: FloatArray, sign: float) -> float:
    """The end of the interval on this side of beta, infinite where the likelihood never falls that far."""
    inner, step, start = beta, 0.25, at
    while True:
        outer = beta + sign * step
        if abs(outer) > _FARTHEST:
            return sign * math.inf
        value, where = excess(outer, start)
        if value > 0:
            break
        inner, start, step = outer, where, 2 * step
    if excess(inner, start)[0] >= 0:
        return inner
    return float(brentq(lambda b: excess(b, start)[0], inner, outer, xtol=1e-3))
