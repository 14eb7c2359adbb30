"""Draws and chains of the emulated posterior, other modes, and the verdict, where the posterior is a known Gaussian."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.calibration.sequential import emulator, modes
from lacli.calibration.sequential.draw import chain, draws
from lacli.calibration.sequential.laplace import Laplace
from lacli.calibration.sequential.scale import Scale
from lacli.calibration.sequential.verdict import unlearned
from lacli.inference.box import make_box

BOX = make_box(("a", "b"), (0.0, 0.0), (1.0, 1.0))
SCALE = Scale.of(BOX)
CENTRE, SLOPE = np.array([0.4, 0.6]), np.array([[20.0, 5.0], [0.0, 10.0], [3.0, -4.0]])
COVARIANCE = np.linalg.inv(SLOPE.T @ SLOPE)


@pytest.fixture(scope="module")
def components() -> emulator.Components:
    """Of runs of a linear response: residuals J (z - centre)."""
    z = np.random.default_rng(0).random((8, 2))
    return emulator.fit(z, (z - CENTRE) @ SLOPE.T, np.broadcast_to(SLOPE, (8, 3, 2)).copy())


@pytest.fixture(scope="module")
def mode() -> Laplace:
    return Laplace.at(CENTRE + 0.05, SLOPE @ np.full(2, 0.05), SLOPE)


def test_the_density_is_the_gaussian_s_and_none_outside_the_box(components: emulator.Components) -> None:
    at = np.array([[0.4, 0.6], [0.45, 0.6], [0.4, 0.5], [1.2, 0.5]])  # the centre, two beside it, one outside
    found = draws.log_posterior(components.reduced(), SCALE, at)
    away = (at - CENTRE) @ SLOPE.T
    exact = -0.5 * (away**2).sum(1)
    assert found[:3] - found[0] == pytest.approx(exact[:3] - exact[0], abs=0.02)
    assert found[3] == -np.inf


def test_draws_have_the_posterior_s_mean_and_covariance(components: emulator.Components, mode: Laplace) -> None:
    z, effective = draws.draw(components, SCALE, [mode], seed=1, count=3000)
    assert effective > draws.LEAST_EFFECTIVE
    sd = np.sqrt(np.diag(COVARIANCE))
    assert np.abs((z.mean(0) - CENTRE) / sd).max() < 0.12
    assert np.cov(z.T) == pytest.approx(COVARIANCE, rel=0.25, abs=0.1 * COVARIANCE.max())
    again, _ = draws.draw(components, SCALE, [mode], seed=1, count=3000)
    assert (again == z).all(), "the same seed, the same draws"


def test_the_chain_s_density_is_that_of_the_draws(components: emulator.Components) -> None:
    density = chain.density(components, SCALE)
    z = np.array([[0.4, 0.6], [0.43, 0.62]])
    found = density(SCALE.to_x(z)) if callable(density) else density.log_posterior(SCALE.to_x(z))
    expected = draws.log_posterior(components.reduced(), SCALE, z)
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], abs=1e-6)


def test_a_box_with_one_mode_is_swept_and_found_empty_elsewhere(components: emulator.Components, mode: Laplace) -> None:
    swept = modes.sweep(components, [mode], 0.0, seed=0)
    assert swept.elsewhere < 1e-6 and len(swept.candidates) == 0
    assert modes.same_valley(components, [mode], np.array([0.9, 0.1])) is None
    away = Laplace(np.array([0.05, 0.05]), mode.precision)
    end = modes.same_valley(components, [away], np.array([0.9, 0.1]))
    assert end == pytest.approx(CENTRE, abs=0.02)


def test_inputs_whose_posterior_is_the_prior_are_told() -> None:
    rows: list[dict[str, float | str]] = [{"input": "a", "contraction": 0.02}, {"input": "b", "contraction": 0.7}]
    assert unlearned(rows) == ["a: the posterior is as wide as the prior; the targets tell nothing of it."]
    assert unlearned(rows[1:]) == []
