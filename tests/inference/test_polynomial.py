"""The stand-in: exact for polynomials of its degree, in the inputs or their logarithms."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.inference.polynomial import fit_polynomial

LOW, HIGH = np.array([0.1, -1.0]), np.array([10.0, 2.0])
LOGGED = np.array([True, False])


def response(x: np.ndarray, cubic: bool) -> np.ndarray:
    a, b = np.log(x[:, 0]), x[:, 1]
    return np.column_stack([1 + a - 2 * b + a * b + 0.5 * b**2, a**3 - a * b**2 if cubic else a**2])


@pytest.mark.parametrize(("count", "cubic"), [(30, False), (60, True)])
def test_polynomials_of_its_degree_are_exact(count: int, cubic: bool) -> None:
    rng = np.random.default_rng(3)
    x = LOW + (HIGH - LOW) * rng.random((count, 2))
    found = fit_polynomial(x, response(x, cubic), LOW, HIGH, LOGGED)
    assert found.cubic == cubic  # from 4 points for each of 10 coefficients on
    at = LOW + (HIGH - LOW) * rng.random((20, 2))
    assert found(at) == pytest.approx(response(at, cubic), rel=1e-3, abs=1e-3)
    assert found.coefficients.shape == (10 if cubic else 6, 2)


def test_points_given_are_not_changed() -> None:
    x = np.array([[1.0, 0.5], [2.0, 0.1]] * 15)
    before = x.copy()
    fit_polynomial(x, x, LOW, HIGH, LOGGED)(x)
    assert (x == before).all()
