"""A prior in the posterior: density, most probable point, and what was learnt beyond it."""

import numpy as np
import pytest

from lacli.contracts.priors import Prior
from lacli.contracts.tables.table import RunTable
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.emulation.gradient_gp import fit_gradient_emulators
from lacli.inference.matching.matching import Region
from lacli.inference.sampling import posterior as mcmc
from lacli.inference.sampling.likelihood import Density

BOX = make_box(["a", "b"], [-5.0, -5.0], [5.0, 5.0])


@pytest.fixture(scope="module")
def density() -> Density:
    """y = a; the target says 1 +- 0.5, the prior of a 2 +- 0.5 and of b 3 +- 0.4: so a is 1.5 +- 0.354 and b as it was."""
    x = BOX.uniform(12, np.random.default_rng(0))
    gradients = np.tile(np.array([[[1.0], [0.0]]]), (12, 1, 1))
    table = RunTable(("a", "b"), ("y",), x, x[:, :1], np.zeros((12, 1)), np.empty((0, 2)), (), gradients)
    priors = (Prior("a", "normal", 2.0, 0.5), Prior("b", "normal", 3.0, 0.4))
    targets = Targets(("y",), np.array([1.0]), np.array([0.5]), None, priors)
    return Density(fit_gradient_emulators(table), targets, Region(BOX))


def test_the_density_is_likelihood_times_prior(density: Density) -> None:
    x = np.array([[1.0, 2.0], [1.6, 3.5]])
    by_hand = -0.5 * ((x[:, 0] - 1) / 0.5) ** 2 - 0.5 * ((x[:, 0] - 2) / 0.5) ** 2 - 0.5 * ((x[:, 1] - 3) / 0.4) ** 2
    assert np.diff(density(x)) == pytest.approx(np.diff(by_hand), rel=1e-3)


def test_sampled_it_is_the_product_and_what_stayed_at_the_prior_is_told(density: Density) -> None:
    chain = mcmc.sample_posterior(density, mcmc.Settings(ensembles=2, walkers=8, max_steps=400, seed=1))
    best, _ = mcmc.maximum(density, chain)
    assert best == pytest.approx([1.5, 3.0], abs=0.02)
    a, b = mcmc.summary(chain, best, density.region.box, density.targets.priors)
    assert (a["mean"], a["sd"]) == pytest.approx((1.5, 0.354), abs=0.06)
    assert (b["mean"], b["sd"]) == pytest.approx((3.0, 0.4), abs=0.06)
    assert (a["prior_sd"], b["prior_sd"]) == pytest.approx((0.5, 0.4), rel=1e-3)
    assert a["contraction"] == pytest.approx(1 - 0.354 / 0.5, abs=0.12) and abs(b["contraction"]) < 0.15
