"""Chains whose samples are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lacli.inference.sampling.posterior import Chain


def chain_of(names: Sequence[str], steps: int = 60, walkers: int = 8, seed: int = 0) -> Chain:
    """A chain of standard normal samples of these inputs, as if it had converged: two ensembles."""
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=(steps, 2, walkers, len(names)))
    d = len(names)
    return Chain(
        tuple(names), samples, -0.5 * (samples**2).sum(-1), 0.4, np.full(d, 1.001), np.full(d, 900.0), True,
        np.random.RandomState(seed).get_state(), samples[0, 0], False, "{}",
    )  # fmt: skip
