"""The ensemble move: whatever helps it, what it samples is the target."""

from __future__ import annotations

import emcee
import numpy as np
import pytest

from lacli.inference.sampling.mixture import fit_mixture
from lacli.inference.sampling.moves import EnsemblesMove

MEAN, SD = np.array([1.0, -2.0]), np.array([0.5, 2.0])
ENSEMBLES, WALKERS = 4, 10


def target(x: np.ndarray) -> np.ndarray:
    return -0.5 * (((x - MEAN) / SD) ** 2).sum(1)


def wrong(x: np.ndarray) -> np.ndarray:
    """A surrogate that is off in place and width."""
    return -0.5 * (((x - MEAN - 0.4) / (1.5 * SD)) ** 2).sum(1)


def walked(move: EnsemblesMove, steps: int, density=target) -> np.ndarray:  # type: ignore[no-untyped-def]
    start = MEAN + SD * np.random.default_rng(1).normal(size=(ENSEMBLES * WALKERS, 2))
    sampler = emcee.EnsembleSampler(len(start), 2, density, moves=move, vectorize=True)
    sampler.random_state = np.random.RandomState(5).get_state()
    sampler.run_mcmc(start, steps)
    return sampler.get_chain()


@pytest.mark.parametrize("kind", ["plain", "surrogate", "mixture", "both"])
def test_the_target_is_sampled_whatever_helps(kind: str) -> None:
    draws = MEAN + 0.3 + 1.3 * SD * np.random.default_rng(2).normal(size=(400, 2))
    move = EnsemblesMove(
        ENSEMBLES, 5 * SD, wrong if kind in ("surrogate", "both") else None, 5,
        fit_mixture(draws, SD) if kind in ("mixture", "both") else None,
    )  # fmt: skip
    chain = walked(move, 600)[100:].reshape(-1, 2)
    assert chain.mean(0) == pytest.approx(MEAN, abs=0.1 * SD.max())
    assert chain.std(0) == pytest.approx(SD, rel=0.08)


def test_groups_never_mix() -> None:
    """Two far modes: a group that begins in one stays there, where no jump leads across."""
    far = np.array([500.0, 0])

    def two(x: np.ndarray) -> np.ndarray:
        return np.logaddexp(target(x), target(x - far))

    start = MEAN + SD * np.random.default_rng(1).normal(size=(2 * WALKERS, 2))
    start[WALKERS:] += far
    sampler = emcee.EnsembleSampler(len(start), 2, two, moves=EnsemblesMove(2, SD), vectorize=True)
    sampler.random_state = np.random.RandomState(5).get_state()
    sampler.run_mcmc(start, 100)
    last = sampler.get_chain()[-1, :, 0]
    assert last[:WALKERS].max() < 100 and last[WALKERS:].min() > 400
    assert (np.abs(last[:WALKERS] - start[:WALKERS, 0]) > 0).all()  # every walker moved


def test_a_step_into_nothing_is_not_made() -> None:
    chain = walked(EnsemblesMove(ENSEMBLES, SD), 50, lambda x: np.where(x[:, 0] > 1.0, target(x), -np.inf))
    start = chain[0, :, 0]
    assert (chain[-1, start > 1.0, 0] > 1.0).all()
