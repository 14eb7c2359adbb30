"""A slope between two quantities of which each is known only up to a posterior: a structural model, fitted by REML.

For patient i and region j, with x the true predictor, w its posterior mean and y the response,

    x_ij = mu_j + a_i + d_ij        a ~ N(0, tau^2), d ~ N(0, omega^2)
    w_ij = x_ij + u_ij              u_i ~ N(0, S_i), S_i the posterior's covariance of patient i, known
    y_ij = gamma_j + beta x_ij + b_i + e_ij + v_ij      b ~ N(0, sigma_b^2), e ~ N(0, sigma_e^2), v_i ~ N(0, T_i), known

(Fuller, Measurement Error Models, 1987; Carroll et al., Measurement Error in Nonlinear Models, 2006, ch. 8.) x is never seen:
integrated out, (w_i, y_i) is normal with a covariance that beta enters, and the regions' means form a design that it does not, so
that restricted likelihoods at different beta may be compared. The interval holds every beta whose likelihood ratio is within that
which the quantile of F(1, df) makes in normal regression (``_ratio_of_f``); it may be unbounded, as it must where the posteriors
are as wide as the patients differ.
df is Satterthwaite's: the variance f of beta's estimate is itself an estimate from the few patients there are, and df =
2 f^2 / var(f), as Fai and Cornelius (J. Stat. Comput. Simul. 54, 1996) take it for fixed effects. Here beta stands among the
covariance's parameters, so that f is its element of the inverse expected information of them all; and since each beta is tested
as given, var(f) is that which the four variances bring.
The estimate told is not the likelihood's best, which few patients bias away from nought, but that without this bias to first
order (``_Model.unbiased``).
It rests on posteriors whose error is independent of the truth: a flat prior that the data dominate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, minimize, root
from scipy.stats import f as f_distribution

from lacli.base.arrays import FloatArray

_FLOOR = 1e-6  # of a quantity's variance: less is none
_STEP = 1e-3  # of derivatives on beta and the log variances, which are of order 1
_OMEGA = 1  # of the log variances, that of the truth within patients
_LEAST_TRUTH = 0.05  # of the predictor's variance, where the search without bias begins
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
    drop = _ratio_of_f(float(f_distribution.ppf(level, 1, df)), df)

    def excess(value: float, start: FloatArray) -> tuple[float, FloatArray]:
        found, where = model.profile(value, start)
        return found - best - drop, where

    low, high = (_limit(excess, beta, at, sign) for sign in (-1.0, 1.0))
    ratio = max(model.profile(0.0, at)[0] - best, 0.0)
    tau, omega, sigma_b, sigma_e = np.sqrt(np.where(at > math.log(_FLOOR) + 0.5, np.exp(at), 0.0))
    # what all regions of a patient err by together makes none of the differences between them
    error = float(np.mean(np.trace(s, axis1=1, axis2=2) - s.sum(axis=(1, 2)) / regions)) / (regions - 1) / scale_w**2
    unit = scale_y / scale_w
    p = float(f_distribution.sf(_f_of_ratio(ratio, df), 1, df))
    return Slope(
        model.unbiased(beta, at) * unit, low * unit, high * unit, p, float(omega**2 / (omega**2 + error)),
        float(tau * scale_w), float(omega * scale_w), float(sigma_b * scale_y), float(sigma_e * scale_y), df,
    )  # fmt: skip


def _ratio_of_f(f: float, df: float) -> float:
    """The restricted likelihood ratio that an F statistic on (1, df) degrees of freedom makes in normal regression.

    With the means alone as design, df + 1 contrasts are left, and -2 log likelihood at a beta, least over the variance, is
    (df + 1) log RSS(beta) + constant. F = (RSS(beta) - RSS) / (RSS / df), so that the ratio is (df + 1) log(1 + F / df): exact
    there, and F itself only for many df.
    """
    return (df + 1) * math.log1p(f / df)


def _f_of_ratio(ratio: float, df: float) -> float:
    """The inverse of ``_ratio_of_f``."""
    return df * math.expm1(ratio / (df + 1))


def _centred(q: FloatArray) -> FloatArray:
    """Without the regions' means, which a complete table's generalised least squares takes out as they are."""
    centred: FloatArray = q - q.mean(axis=0)
    return centred


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), float)


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
        w = _inverse(self.covariance(float(at[0]), at[1:]))
        product = _Products(w, [self._derivative(at, k) for k in free])
        return np.array([[0.5 * product.trace(i, j) for j in range(len(free))] for i in range(len(free))])

    def unbiased(self, beta: float, logs: FloatArray) -> float:
        """beta without its bias of first order in 1 / patients; from the likelihood's best, which it is where none is found.

        The score less I b is nought there (Firth, Biometrika 80, 1993), b the bias of Cox and Snell (J. R. Stat. Soc. B 30,
        1968). For normal data whose covariance alone has parameters, b = -I^-1 a / 2 with a_s = tr(P V_s P D) / 2 and D the sum
        of the covariance's second derivatives V_tu times the elements of I^-1 (Patriota and Lemonte, Stat. Probab. Lett. 79,
        2009): it is V's bend that biases. In the variances V is linear, so that D has beta's terms only.
        """
        most = math.log(_FLOOR) + 0.5
        # the truth varies, or there is no slope; the others may be at nothing, where they stay
        free = [0, *(1 + k for k in range(len(logs)) if k == _OMEGA or logs[k] > most)]
        at = np.array([beta, *logs])
        at[1 + _OMEGA] = max(at[1 + _OMEGA], math.log(_LEAST_TRUTH))

        def adjusted(z: FloatArray) -> FloatArray:
            here = at.copy()
            here[free] = z
            here[1:] = np.clip(here[1:], *self.bounds[0])
            changes = [self._derivative(here, k) for k in free]
            w = _inverse(self.covariance(float(here[0]), here[1:]))
            inverse = _inverse(self.information(here, free))
            product = _Products(w, [*changes, self._bend(here, free, inverse)])
            # I b = -a / 2
            bias = np.array([-0.25 * product.trace(i, len(free)) for i in range(len(free))])
            result: FloatArray = product.score(self.data)[:-1] - bias
            return result

        try:
            found = root(adjusted, at[free], method="hybr", options={"maxfev": 400})
        except (np.linalg.LinAlgError, FloatingPointError):
            return beta
        good = found.success and abs(found.x[0]) < _FARTHEST and np.isfinite(found.x).all()
        return float(found.x[0]) if good else beta

    def _bend(self, at: FloatArray, free: Sequence[int], inverse: FloatArray) -> FloatArray:
        """D of ``unbiased``, (patients, 2 regions, 2 regions)."""
        beta, r = float(at[0]), self.r
        tau, omega = np.exp(at[1:3])
        bend = np.zeros((2 * r, 2 * r))
        bend[r:, r:] = 2 * inverse[0, 0] * (tau * self.ones + omega * self.eye)
        for k, change in ((1, tau * self.ones), (2, omega * self.eye)):
            if k in free:
                twice = 2 * inverse[0, free.index(k)]
                bend[:r, r:] += twice * change
                bend[r:, :r] += twice * change
                bend[r:, r:] += twice * 2 * beta * change
        return np.broadcast_to(bend, (self.n, 2 * r, 2 * r))

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


class _Products:
    """Traces of P A P B and the score, for changes A, B, ... of the covariance, (patients, 2 regions, 2 regions) each."""

    def __init__(self, w: FloatArray, changes: Sequence[FloatArray]) -> None:
        self.w, self.c = w, _inverse(w.sum(axis=0))
        self.wd = [w @ change for change in changes]
        self.once = [np.einsum("nij,njk->ik", a, w) for a in self.wd]

    def trace(self, i: int, j: int) -> float:
        """tr(P A_i P A_j)."""
        ab = self.wd[i] @ self.wd[j]
        twice = (ab @ self.w).sum(axis=0)
        within = float(np.trace(ab.sum(axis=0))) - 2 * float(np.sum(self.c * twice.T))
        return within + float(np.trace(self.c @ self.once[i] @ self.c @ self.once[j]))

    def score(self, data: FloatArray) -> FloatArray:
        """(q' P A_i P q - tr(P A_i)) / 2 of data q, for each change."""
        weighted = np.einsum("nij,nj->ni", self.w, data)
        rest = data - self.c @ weighted.sum(axis=0)
        squares = [float(np.einsum("ni,nij,njk,nk", rest, a, self.w, rest)) for a in self.wd]
        traces = [float(np.trace(a.sum(axis=0))) - float(np.sum(self.c * b.T)) for a, b in zip(self.wd, self.once, strict=True)]
        return 0.5 * (np.array(squares) - np.array(traces))


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
