"""A process learnt from values and derivatives: its covariances against differences, functions it must reproduce."""

import numpy as np
import pytest

from lacli.inference.emulation import gradient_process as process
from lacli.inference.emulation.gradient_kernel import KINDS, blocks
from lacli.inference.emulation.gradient_process import Data


def data_of(u, y, slopes, active=None, rows=None, noise=0.0):
    """Values y (n,) and slopes (n, d) as Data."""
    active = np.arange(u.shape[1]) if active is None else np.asarray(active)
    observed = np.vstack([y[None], slopes[:, active].T])
    rows = np.ones(observed.shape, bool) if rows is None else rows
    variance = np.maximum(slopes[:, active].var(0), 1e-6)
    return Data(u, active, rows, np.where(rows, observed, 0.0), np.full(len(y), noise), variance)


@pytest.mark.parametrize("kind", KINDS)
def test_covariances_of_derivatives_are_those_of_differences(kind):
    """k(u, u') differenced in u and u'; for a squared exponential d k / du' at l = 1 is k (u - u')."""
    rng = np.random.default_rng(0)
    z, other, h = rng.normal(size=(4, 3)), rng.normal(size=(5, 3)), 1e-4
    active = np.array([0, 2])
    found = blocks(kind, z, other, active)

    def k(a, b):
        return blocks(kind, a, b, active[:0])[0, :, 0]

    for i, j in enumerate(active):
        step = h * np.eye(3)[j]
        ahead, behind = (blocks(kind, z + s * step, other, active)[0] for s in (1, -1))
        assert found[1 + i] == pytest.approx((ahead - behind) / (2 * h), abs=2e-7)
        assert found[0, :, 1 + i] == pytest.approx((k(z, other + step) - k(z, other - step)) / (2 * h), abs=2e-7)
    if kind == "squared_exponential":
        rho = 0.5 * ((z[1] - other[3]) ** 2).sum()
        assert found[0, 1, 2, 3] == pytest.approx(np.exp(-rho) * (z[1, 2] - other[3, 2]), rel=1e-12)
    same = blocks(kind, z, z, active).reshape(12, 12)
    assert np.allclose(same, same.T, atol=1e-14) and np.linalg.eigvalsh(same).min() > -1e-10


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("active", [[0, 1, 2], [0, 2], []])
def test_the_likelihood_s_gradient_is_that_of_differences(kind, active):
    rng = np.random.default_rng(1)
    u = rng.uniform(-1, 1, (9, 3))
    slopes = np.c_[np.cos(2 * u[:, 0]), u[:, 2], u[:, 1]]
    y = 0.5 * np.sin(2 * u[:, 0]) + u[:, 1] * u[:, 2]
    rows = rng.random((1 + len(active), 9)) < 0.8
    data = data_of(u, y, slopes, np.array(active, int), rows, noise=1e-3)
    theta = np.log([0.7, 1.3, 2.0, 0.8, 1e-3, 1e-2])
    _, gradient = process.negative_log_likelihood(theta, kind, data)
    for i in range(6):
        h = 1e-5 * np.eye(6)[i]
        ahead, behind = (process.negative_log_likelihood(theta + s * h, kind, data)[0] for s in (1, -1))
        assert gradient[i] == pytest.approx((ahead - behind) / 2e-5, rel=1e-5, abs=1e-6), i


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_derivatives_are_reproduced_and_predicted(kind):
    """y = u0^2 - u0 u1 + 3 u2 + 1 from 14 runs: its mean is y, its gradient (2 u0 - u1, -u0, 3)."""
    rng = np.random.default_rng(2)

    def f(u):
        return u[:, 0] ** 2 - u[:, 0] * u[:, 1] + 3 * u[:, 2] + 1

    def slope(u):
        return np.c_[2 * u[:, 0] - u[:, 1], -u[:, 0], np.full(len(u), 3.0)]

    u, at = rng.uniform(-1, 1, (14, 3)), rng.uniform(-0.9, 0.9, (50, 3))
    data = data_of(u, f(u), slope(u), active=[0, 1])
    theta, _ = process.maximise(kind, data, process.start(data))
    fitted = process.condition(kind, theta, data)
    tolerance = {"squared_exponential": 2e-3, "matern52": 0.05}[kind]
    assert np.abs(fitted.predict(u)[0] - f(u)).max() < tolerance
    assert np.abs(fitted.predict(at)[0] - f(at)).max() < tolerance
    assert np.abs(fitted.predict_gradient(at) - slope(at)).max() < 10 * tolerance
    assert np.array_equal(fitted.predict_mean(at), fitted.predict(at)[0])
    h = 1e-5
    for j in range(3):
        ahead, behind = (fitted.predict_mean(at + s * h * np.eye(3)[j]) for s in (1, -1))
        assert fitted.predict_gradient(at)[:, j] == pytest.approx((ahead - behind) / (2 * h), abs=1e-5)


def test_leaving_a_run_out_is_what_conditioning_without_it_says():
    rng = np.random.default_rng(3)
    u = rng.uniform(-1, 1, (10, 2))
    y, slopes = np.sin(2 * u[:, 0]) * u[:, 1], np.c_[2 * np.cos(2 * u[:, 0]) * u[:, 1], np.sin(2 * u[:, 0])]
    rows = np.ones((3, 10), bool)
    rows[1:, 4] = False
    data = data_of(u, y, slopes, rows=rows, noise=1e-4)
    theta = np.log([0.8, 1.1, 1.0, 1e-4, 1e-4])
    error, variance = process.condition("squared_exponential", theta, data).leave_one_run_out()
    for i in range(10):
        rest = process.condition("squared_exponential", theta, data.part(np.delete(np.arange(10), i)))
        mean, var = rest.predict(u[i : i + 1])
        assert error[i] == pytest.approx(y[i] - mean[0], rel=1e-6, abs=1e-9)
        assert variance[i] == pytest.approx(var[0] + 1e-4, rel=1e-6)
