"""The sampler's moves leave the density as it is: means, variances and both modes come out."""

from __future__ import annotations

import emcee
import numpy as np
import pytest

from lacli.inference.sampling import moves

MODES = np.array([[-4.0, 0.0], [4.0, 1.0]])


def two_modes(x: np.ndarray) -> np.ndarray:
    a, b = (-0.5 * ((x - m) ** 2).sum(-1) for m in MODES)
    return np.asarray(np.logaddexp(a, b + np.log(3.0)))


def move_of(**options: object) -> object:
    kinds = [
        v
        for v in vars(moves).values()
        if isinstance(v, type) and issubclass(v, emcee.moves.Move) and v.__module__ == moves.__name__
    ]
    (kind,) = kinds
    return kind(1, np.ones(2), **options)


@pytest.mark.parametrize("surrogate", [None, lambda x: 0.9 * two_modes(x)], ids=["plain", "detour"])
def test_two_modes_are_visited_as_often_as_they_weigh(surrogate: object) -> None:
    rng = np.random.default_rng(2)
    start = MODES[rng.integers(0, 2, 40)] + rng.normal(size=(40, 2))
    sampler = emcee.EnsembleSampler(40, 2, two_modes, moves=[move_of(surrogate=surrogate)], vectorize=True)
    sampler.random_state = np.random.RandomState(5).get_state()
    sampler.run_mcmc(start, 600 if surrogate is None else 150)
    x = sampler.get_chain(discard=50, flat=True)
    right = x[:, 0] > 0
    assert right.mean() == pytest.approx(0.75, abs=0.08)  # weights 1 : 3
    assert x[right].mean(0) == pytest.approx(MODES[1], abs=0.12)
    assert x[right].std(0) == pytest.approx([1.0, 1.0], abs=0.12)
