"""Evidence of a model by sequential Monte Carlo: uniform prior on a box, tempered step by step to the posterior.

Z = E_prior[L]. Particles go from L^0 to L^1; each step is as long as leaves half of them effective, and is followed by
Metropolis moves (Del Moral et al. 2006): along all inputs together, as they are spread, and along some of them at a time, so that
what the likelihood ties and what it leaves free move both. The mean over independent repetitions is told with its standard error,
estimated from their spread: few repetitions may lie together by chance, so it is no smaller than what the weights say.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError
from lacli.inference.box import Box

_MOST_STEPS = 60
_LEAST_MOVES, _MOVES_AN_INPUT = 12, 2  # at every step; chains need as many more as there are inputs
_SOME = 0.25  # of the inputs, in moves along some of them


@dataclass(frozen=True)
class Evidence:
    """log Z with its standard error, and equally weighted draws (m, d) of the posterior."""

    log_z: float
    se: float
    draws: FloatArray


def evidence(
    log_likelihood: Callable[[FloatArray], FloatArray],
    box: Box,
    particles: int = 600,
    repeats: int = 4,
    seed: int = 0,
    tick: Callable[[], None] = lambda: None,
) -> Evidence:
    """log_likelihood: (m, d) -> (m,), in the box. tick: called after each of the repetitions.

    Raises LacliError where the likelihood is so narrow that tempering does not reach it.
    """
    found = []
    for k in range(repeats):
        found.append(_one(log_likelihood, box, particles, np.random.default_rng([seed, k])))
        tick()
    z = np.array([log_z for log_z, _, _ in found])
    variance = max(float(z.var(ddof=1)), float(np.mean([of_weights for _, of_weights, _ in found])))
    return Evidence(float(z.mean()), math.sqrt(variance / repeats), np.concatenate([x for _, _, x in found]))


def _one(
    log_likelihood: Callable[[FloatArray], FloatArray], box: Box, n: int, rng: np.random.Generator
) -> tuple[float, float, FloatArray]:
    """log Z, its variance where moves leave nothing of where particles came from, and the particles."""
    x = box.uniform(n, rng)
    value = log_likelihood(x)
    power = log_z = variance = 0.0
    scale = 1.0
    for _ in range(_MOST_STEPS):
        step = _step(value, 1.0 - power)
        weight = step * value
        log_z += float(logsumexp(weight) - math.log(n))
        power = min(1.0, power + step)
        share = np.exp(weight - logsumexp(weight))
        variance += float((share**2).sum()) - 1.0 / n
        # systematic: each particle as often as its weight says, to within one
        chosen = np.minimum(np.searchsorted(np.cumsum(share), (rng.random() + np.arange(n)) / n), n - 1)
        x, value = x[chosen], value[chosen]
        scale = _move(x, value, power, log_likelihood, box, scale, rng)
        if power >= 1.0:
            return log_z, variance, x
    raise LacliError(
        "compare: the likelihood is too narrow beside the box for its evidence. Widen the targets' sd or narrow the box."
    )


def _step(value: FloatArray, left: float) -> float:
    """The step of the power, at most ``left``, after which half of the particles are effective."""

    def excess(step: float) -> float:
        w = step * (value - value.max())
        return float(2 * logsumexp(w) - logsumexp(2 * w)) - math.log(len(value) / 2)

    return left if excess(left) >= 0 else float(brentq(excess, 0.0, left, xtol=1e-12))


def _move(
    x: FloatArray,
    value: FloatArray,
    power: float,
    log_likelihood: Callable[[FloatArray], FloatArray],
    box: Box,
    scale: float,
    rng: np.random.Generator,
) -> float:
    """Metropolis moves of the particles in place; the scale of the proposal for the next stage."""
    n, d = x.shape
    spread = np.cov(x.T).reshape(d, d) + 1e-12 * np.diag((box.upper - box.lower) ** 2)
    factor = np.linalg.cholesky(spread)
    alone = 1.0 / np.sqrt(np.diag(np.linalg.inv(spread)))
    for move in range(max(_LEAST_MOVES, _MOVES_AN_INPUT * d)):
        together = move % 2 == 0
        if together:
            proposed = x + (scale * 2.38 / math.sqrt(d)) * rng.normal(size=(n, d)) @ factor.T
        else:
            chosen = rng.random((n, d)) < _SOME
            chosen[np.arange(n), rng.integers(d, size=n)] = True
            # of sizes over orders of magnitude: where inputs are tied by an input (a spread), one size is wrong somewhere
            size = np.exp(rng.normal(size=(n, 1))) * 2.38 / np.sqrt(chosen.sum(axis=1, keepdims=True))
            proposed = _folded(x + chosen * size * alone * rng.normal(size=(n, d)), box)
        inside = np.flatnonzero(box.contains(proposed))
        accepted = np.zeros(n, bool)
        if len(inside):
            there = log_likelihood(proposed[inside])
            yes = np.log(rng.random(len(inside))) < power * (there - value[inside])
            rows = inside[yes]
            x[rows], value[rows], accepted[rows] = proposed[rows], there[yes], True
        if together:
            scale = float(np.clip(scale * math.exp(accepted.mean() - 0.3), 0.05, 2.0))
    return scale


def _folded(x: FloatArray, box: Box) -> FloatArray:
    """Points (n, d) that left the box, reflected at its walls back into it.

    Only of steps independent between inputs: reflected, those that go together are no symmetric proposal.
    """
    width = box.upper - box.lower
    along = np.mod((x - box.lower) / width, 2.0)
    return np.asarray(np.clip(box.lower + width * np.minimum(along, 2.0 - along), box.lower, box.upper))
