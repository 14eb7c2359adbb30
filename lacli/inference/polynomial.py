"""Polynomials of degree two or three fitted to values at scattered points: nearly free stand-ins for dear functions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray

# a little ridge keeps directions that the points do not cover from swinging
_RIDGE = 1e-6
# points for each coefficient that a cubic needs; with fewer a quadratic is fitted
_PER_COEFFICIENT = 4


@dataclass(frozen=True)
class Polynomial:
    """coefficients (terms, q) of the monomials of t = 2 (x - low) / (high - low) - 1 up to degree two or three; t is of
    log x where ``logged`` (d,)."""

    low: FloatArray
    high: FloatArray
    logged: NDArray[np.bool_]
    cubic: bool
    coefficients: FloatArray

    def __call__(self, x: FloatArray) -> FloatArray:
        """Values (m, q) at x (m, d)."""
        return _monomials(self._scaled(x), self.cubic) @ self.coefficients

    def _scaled(self, x: FloatArray) -> FloatArray:
        t = x.copy()
        if self.logged.any():
            t[:, self.logged] = np.log(t[:, self.logged])
        t -= self.low
        t *= 2.0 / (self.high - self.low)
        t -= 1.0
        return t


def fit_polynomial(x: FloatArray, y: FloatArray, lower: FloatArray, upper: FloatArray, logged: NDArray[np.bool_]) -> Polynomial:
    """Least squares fit to y (m, q) at x (m, d), points of the box [lower, upper] (d,)."""
    d = len(lower)
    low, high = lower.copy(), upper.copy()
    low[logged], high[logged] = np.log(low[logged]), np.log(high[logged])
    cubic = len(x) >= _PER_COEFFICIENT * ((d + 1) * (d + 2) * (d + 3) // 6)
    empty = Polynomial(low, high, logged, cubic, np.empty((0, y.shape[1])))
    a = _monomials(empty._scaled(x), cubic)
    ridge = _RIDGE * len(a) * np.eye(a.shape[1])
    coefficients = np.asarray(np.linalg.solve(a.T @ a + ridge, a.T @ y), np.float64)
    return Polynomial(low, high, logged, cubic, coefficients)


def _monomials(t: FloatArray, cubic: bool) -> FloatArray:
    """(m, terms): 1, t_i, t_i t_j (i <= j) and, if ``cubic``, t_i t_j t_k (i <= j <= k)."""
    m, d = t.shape
    terms = 1 + d + d * (d + 1) // 2 + (d * (d + 1) * (d + 2) // 6 if cubic else 0)
    rows = np.empty((terms, m))  # a monomial a row: every product below runs along memory
    rows[0] = 1.0
    rows[1 : 1 + d] = t.T
    at, place = 1 + d, []
    for i in range(d):
        place.append(at)
        np.multiply(rows[1 + i], rows[1 + i : 1 + d], out=rows[at : at + d - i])
        at += d - i
    if cubic:
        end = at
        for i in range(d):
            size = end - place[i]
            np.multiply(rows[1 + i], rows[place[i] : end], out=rows[at : at + size])
            at += size
    return rows.T
