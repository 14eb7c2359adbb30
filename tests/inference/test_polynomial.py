"""Polynomials as stand-ins: exact where the function is one, in the box's own scale."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.inference.polynomial import fit_polynomial

LOW, HIGH = np.array([0.1, -2.0]), np.array([4.0, 3.0])
LOGGED = np.array([True, False])


def points(count: int, seed: int) -> np.ndarray:
    return LOW + np.random.default_rng(seed).random((count, 2)) * (HIGH - LOW)


@given(st.lists(st.floats(-3, 3), min_size=10, max_size=10))
def test_a_cubic_of_log_x_comes_back(c: list[float]) -> None:
    def truth(x: np.ndarray) -> np.ndarray:
        a, b = np.log(x[:, 0]), x[:, 1]
        terms = [np.ones(len(x)), a, b, a * a, a * b, b * b, a**3, a * a * b, a * b * b, b**3]
        return np.column_stack([np.array(c) @ terms, -np.array(c) @ terms])

    fitted = fit_polynomial(points(200, 0), truth(points(200, 0)), LOW, HIGH, LOGGED)
    assert fitted.cubic and fitted.coefficients.shape == (10, 2)
    there = points(50, 1)
    scale = 1 + np.abs(truth(points(200, 0))).max()
    assert np.abs(fitted(there) - truth(there)).max() < 1e-4 * scale  # the ridge costs as little
    assert there.min() > -2.1  # and the points given are not changed in place
    assert (there == points(50, 1)).all()


def test_with_few_points_a_quadratic_is_fitted() -> None:
    # a cubic of two inputs has 10 coefficients; below 40 points it is none
    x = points(39, 0)
    fitted = fit_polynomial(x, x[:, 1:] ** 2, LOW, HIGH, LOGGED)
    assert not fitted.cubic and fitted.coefficients.shape == (6, 1)
    assert fitted(points(9, 1))[:, 0] == pytest.approx(points(9, 1)[:, 1] ** 2, abs=1e-3)
    assert fit_polynomial(points(40, 0), np.zeros((40, 1)), LOW, HIGH, LOGGED).cubic
