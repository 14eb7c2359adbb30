"""Mixed models with a random intercept a patient: as published, and with a posterior's error carried.

``published`` is statsmodels' MixedLM, response ~ C(region) + x, REML, Wald's z; if the random intercept's variance is none, its
standard errors are of a curvature at an edge, and least squares take its place. ``known_error`` is the same model where the
response's posterior covariance is added to its variance, so that the residual is only what the posteriors leave; its test is
Student's t with degrees of freedom by containment. ``rubin`` fits many joint draws of the response and combines them (Rubin,
Multiple Imputation, 1987; degrees of freedom of Barnard and Rubin, 1999). Its draws know nothing of the regression, so that
the posterior's error enters twice: it errs on the wide side.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.optimize import minimize

from lacli.base.arrays import FloatArray
from lacli.cohort.analysis.observations import Observations

DRAWS = 50
MIXED, SQUARES, OTHER_REML = "MixedLM", "least squares (MixedLM is singular)", "REML (MixedLM did not converge)"
_NO_SPREAD = 1e-6


@dataclass(frozen=True)
class Coefficient:
    """A term of a mixed model with its standard error, statistic (z, or t with ``df``), p and interval."""

    term: str
    estimate: float
    se: float
    statistic: float
    p: float
    low: float
    high: float
    df: float = math.inf


@dataclass(frozen=True)
class MixedFit:
    """Coefficients, standard deviations of the random intercept and the residual, what must be said of the fit, its method."""

    coefficients: tuple[Coefficient, ...]
    intercept_sd: float
    residual_sd: float
    notes: tuple[str, ...]
    method: str = MIXED

    def of(self, term: str) -> Coefficient:
        """The coefficient of a term."""
        return next(c for c in self.coefficients if c.term == term)


def published(observed: Observations, response: str, predictor: str, level: float = 0.95) -> MixedFit:
    """MixedLM of ``response ~ C(region) + predictor`` with a random intercept a patient, by REML; Wald z.

    Where it is singular, ordinary least squares with Student's t; where it does not converge, the same model by another search.
    """
    import statsmodels.api as sm

    y, x = observed.values[response], observed.values[predictor]
    patients, regions = y.shape
    dummies = np.tile(np.eye(regions), (patients, 1))
    design = np.column_stack([np.ones(patients * regions), dummies[:, 1:], x.ravel()])
    terms = ["intercept", *(f"region {name}" for name in observed.regions[1:]), predictor]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fit = sm.MixedLM(y.ravel(), design, groups=np.repeat(np.arange(patients), regions)).fit(reml=True)
        estimate, se = np.asarray(fit.fe_params), np.asarray(fit.bse_fe)  # by the roots of a matrix that may be indefinite
    variance, residual = float(np.asarray(fit.cov_re)[0, 0]), float(fit.scale)
    here, notes, method = f"response {response}, predictor {predictor}", [], MIXED
    words = {str(w.message).strip().splitlines()[0].rstrip(".") for w in told if not issubclass(w.category, FutureWarning)}
    if words:
        notes.append(f"{here}: statsmodels says: {'; '.join(sorted(words))}.")
    if not (fit.converged and np.isfinite(se).all()):
        found = _restricted(y, design.reshape(patients, regions, -1), np.zeros((patients, regions, regions)))
        if found.converged and np.isfinite(found.covariance).all():
            estimate, se, method = found.estimate, np.sqrt(np.diag(found.covariance)), OTHER_REML
            variance, residual = found.intercept, found.residual
            notes.append(f"{here}: MixedLM did not converge; the numbers are the same model's by another search.")
        else:
            notes.append(f"{here}: the fit did not converge; its numbers are no estimates.")
    df = math.inf
    if variance < _NO_SPREAD * residual:
        squares = sm.OLS(y.ravel(), design).fit()
        estimate, se, df, method = np.asarray(squares.params), np.asarray(squares.bse), float(squares.df_resid), SQUARES
        variance, residual = 0.0, float(squares.scale)
        notes.append(
            f"{here}: the random intercept's variance is zero (a singular fit): the patients differ by no more than their regions"
            f" do, and the row is that of ordinary least squares (t with {df:.0f} degrees of freedom)."
        )
    rows = tuple(_by_t(term, float(b), float(s), df, level) for term, b, s in zip(terms, estimate, se, strict=True))
    return MixedFit(rows, math.sqrt(max(variance, 0.0)), math.sqrt(residual), tuple(notes), method)


def known_error(y: FloatArray, x: FloatArray, t: FloatArray, level: float = 0.95) -> tuple[Coefficient, float, float]:
    """The slope of y on x with the response's errors' covariance t known; and the sd of intercept and residual.

    y, x: (patients, regions); t: (patients, regions, regions).
    """
    patients, regions = y.shape
    design = np.concatenate([np.tile(np.eye(regions), (patients, 1, 1)), (x - x.mean())[:, :, None]], axis=2)
    found = _restricted(y, design, t)
    slope, se = float(found.estimate[-1]), math.sqrt(float(found.covariance[-1, -1]))
    # a predictor that is one number a patient is told by the patients alone (containment)
    within = float(np.abs(x - x.mean(axis=1, keepdims=True)).max()) > 1e-12 * float(np.abs(x).max() or 1.0)
    df = patients * regions - regions - (patients - 1) - 1 if within else patients - 2
    return _by_t("", slope, se, df, level), math.sqrt(found.intercept), math.sqrt(found.residual)


@dataclass(frozen=True)
class _Restricted:
    """Estimates with their covariance, variances of intercept and residual (0 at the least that is sought), and whether REML's
    search ended."""

    estimate: FloatArray
    covariance: FloatArray
    intercept: float
    residual: float
    converged: bool


def _restricted(y: FloatArray, design: FloatArray, t: FloatArray) -> _Restricted:
    """REML of y (patients, regions) on a design (patients, regions, terms), its errors' covariance t known."""
    regions = y.shape[1]
    scale = float(np.std(y - y.mean(axis=0))) or 1.0
    data, errors = y / scale, t / scale**2
    ones, eye = np.ones((regions, regions)), np.eye(regions)

    def solve(logs: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        b, e = np.exp(logs)
        v = b * ones + e * eye + errors
        inverse = np.linalg.inv(v)
        information = np.einsum("nij,nik,nkl->jl", design, inverse, design)
        score = np.einsum("nij,nik,nk->j", design, inverse, data)
        estimate = np.linalg.solve(information, score)
        rest = data - design @ estimate
        value = np.linalg.slogdet(v)[1].sum() + np.linalg.slogdet(information)[1] + np.einsum("ni,nij,nj", rest, inverse, rest)
        return float(value), estimate, np.linalg.inv(information)

    bound = (math.log(1e-7), math.log(1e3))
    found = minimize(lambda z: solve(z)[0], np.log([0.3, 0.4]), method="L-BFGS-B", bounds=[bound, bound])
    _, estimate, covariance = solve(found.x)
    b, e = (float(v) * scale**2 if v > 2e-7 else 0.0 for v in np.exp(found.x))
    return _Restricted(estimate * scale, covariance * scale**2, b, e, bool(found.success))


def rubin(draws: FloatArray, x: FloatArray, level: float = 0.95) -> Coefficient:
    """The slope of the response's draws (draws, patients, regions) on x, combined: within + (1 + 1/m) between."""
    none = np.zeros((x.shape[0], x.shape[1], x.shape[1]))
    fits = [known_error(draw, x, none)[0] for draw in draws]
    m = len(fits)
    slopes = np.array([f.estimate for f in fits])
    within, between = float(np.mean([f.se**2 for f in fits])), float(slopes.var(ddof=1))
    total = within + (1 + 1 / m) * between
    share = (1 + 1 / m) * between / total
    complete = fits[0].df
    observed = (complete + 1) / (complete + 3) * complete * (1 - share)
    df = 1 / ((share**2 / (m - 1) if share > 0 else 0.0) + 1 / observed)
    return _by_t("", float(slopes.mean()), math.sqrt(total), df, level)


def normal_draws(mean: FloatArray, covariance: FloatArray, count: int, seed: int) -> FloatArray:
    """``count`` draws (count, patients, regions) about the posterior means."""
    rng = np.random.default_rng(seed)
    return np.stack(
        [rng.multivariate_normal(m, c, size=count, method="eigh") for m, c in zip(mean, covariance, strict=True)], axis=1
    )


def _by_t(term: str, slope: float, se: float, df: float, level: float) -> Coefficient:
    q = float(stats.t.ppf(0.5 + level / 2, df))  # of infinite df the normal's
    ratio = slope / se if se != 0 else math.copysign(math.inf, slope)  # of a fit that leaves nothing
    return Coefficient(term, slope, se, ratio, float(2 * stats.t.sf(abs(ratio), df)), slope - q * se, slope + q * se, df)
