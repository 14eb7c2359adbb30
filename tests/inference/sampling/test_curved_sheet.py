"""A thin curved sheet in nine inputs, as few targets leave of many inputs: its moments are known."""

from __future__ import annotations

import numpy as np
import pytest
from exact import ExactEmulators

from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.matching.matching import Region
from lacli.inference.sampling import posterior as mcmc
from lacli.inference.sampling.likelihood import Density
from lacli.inference.surrogate import fit_surrogate

STEEP, THIN, CURVED = 0.6, 0.1, 4
SD = np.r_[1.0, np.full(CURVED, THIN), np.ones(4)]
SIGN = np.array([1.0, -1.0, 1.0, -1.0])
DENSITY = Density(
    ExactEmulators(9, 9, lambda x: np.hstack([x[:, :1], x[:, 1:5] - SIGN * np.sinh(STEEP * x[:, :1]), x[:, 5:]])),
    Targets(tuple(f"y{j}" for j in range(9)), np.zeros(9), SD),
    Region(make_box([f"x{i}" for i in range(9)], *([-s * v for v in (6, *[40] * 4, *[6] * 4)] for s in (1.0, -1.0)))),
)


def sheet(count: int, seed: int, wider: float = 1.0) -> np.ndarray:
    """Draws (count, 9) of the posterior, or about a wider one: x0 ~ N(0, 1), x1..4 = +-sinh(0.6 x0) + N(0, 0.1^2), the rest
    N(0, 1). The map from normal numbers keeps volumes."""
    x = wider * SD * np.random.default_rng(seed).standard_normal((count, 9))
    x[:, 1:5] += SIGN * np.sinh(STEEP * x[:, :1])
    return x


def test_the_chain_is_soon_through_the_sheet_and_its_moments_are_right() -> None:
    chain = mcmc.sample_posterior(DENSITY, mcmc.Settings(max_steps=300, seed=2), sheet(1000, 1, 1.3))
    assert chain.converged and chain.uses_surrogate
    x = chain.flat()
    # E sinh^2(a Z) = (e^(2 a^2) - 1) / 2 = 0.527 with a = 0.6
    sd = np.r_[1.0, np.full(CURVED, np.sqrt(THIN**2 + 0.52722)), np.ones(4)]
    assert (np.abs(x.mean(0)) < 3.5 * sd / np.sqrt(chain.ess)).all()
    # a sample's sd errs by sqrt((k - 1) / 4 n) of it: k = 3 of a normal distribution, 5.7 of sinh(a Z); n = 5000: 1.0, 1.5 %
    assert x[:, [0, 5, 6, 7, 8]].std(0) == pytest.approx(1.0, rel=0.035)
    assert x[:, 1:5].std(0) == pytest.approx(sd[1:5], rel=0.05)
    # the arms have their weight: P(|Z| > 2.5) = 0.0124, and over 20 seeds its estimates scatter by 0.0020, for walkers stay long
    # in an arm's end; P(|Z| > 1.96) = 0.05
    assert (np.abs(x[:, 0]) > 2.5).mean() == pytest.approx(0.0124, abs=0.008)
    assert np.quantile(x[:, 0], [0.025, 0.975]) == pytest.approx([-1.96, 1.96], abs=0.1)


def test_the_stand_in_takes_the_emulators_own_means_where_polynomials_err() -> None:
    bent, error = fit_surrogate(DENSITY, sheet(1600, 3))
    assert bent.own_means and error < 1e-6
    far = sheet(200, 4, 1.5)  # beyond the points that it was fitted to
    assert bent(far) == pytest.approx(DENSITY(far), abs=1e-6)
    t = Targets(("y0", "y1"), np.zeros(2), np.ones(2))
    box = make_box(["x0", "x1"], [-3.0] * 2, [3.0] * 2)
    straight = Density(ExactEmulators(2, 2, lambda x: x + 0.1 * x**2), t, Region(box))
    cubic, error = fit_surrogate(straight, box.uniform(400, np.random.default_rng(5)))
    assert not cubic.own_means and error < 0.1
