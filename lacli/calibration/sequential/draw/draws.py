"""Draws of the emulated posterior without a chain: adaptive importance sampling (population Monte Carlo, Cappe et al. 2004).

They decide what is run next, many times; the chain, which ends the calibration, is walked once.
"""

from __future__ import annotations

import numpy as np
from numpy.random import RandomState

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.emulator import Components
from lacli.calibration.sequential.laplace import Laplace
from lacli.calibration.sequential.scale import Scale
from lacli.inference.sampling.mixture import fit_mixture

_POINTS, _ROUNDS = 3000, 5
LEAST_EFFECTIVE = 100.0  # of fewer, the points are those of a wider density
_ENOUGH = 300.0  # effective points of the last round, after which no better proposal is looked for
_LEAST = 0.1  # of the points must count in the tempered weights that the next proposal learns from


def log_posterior(components: Components, scale: Scale, z: FloatArray) -> FloatArray:
    """(m,) at z (m, d), up to a constant; -inf outside the box. Components must be the ``reduced`` ones to be fast."""
    value = np.full(len(z), -np.inf)
    inside = np.asarray(((z >= 0.0) & (z <= 1.0)).all(1))
    inside[inside] = scale.box.contains(scale.to_x(z[inside]))
    if inside.any():
        mean, variance = components.predict(z[inside])
        # uniform in x: what is a logarithm in z weighs as x itself
        flat = np.log(scale.to_x(z[inside])[:, scale.logged]).sum(1)
        value[inside] = flat - 0.5 * (mean**2 / (1.0 + variance) + np.log1p(variance)).sum(1)
    return value


def draw(components: Components, scale: Scale, modes: list[Laplace], seed: int, count: int = 1500) -> tuple[FloatArray, float]:
    """``count`` points (count, d) of the box drawn from the emulated posterior, and how many of them are effectively different;
    from a wider, tempered one where no proposal comes near it."""
    components = components.reduced()
    rng = RandomState(seed)
    each = _POINTS // len(modes)
    first = np.vstack([mode.draw(each, 1.5, np.random.default_rng([seed, k])) for k, mode in enumerate(modes)])
    proposal = fit_mixture(first, np.ones(scale.box.d), seed)
    for last in range(_ROUNDS):
        z = proposal.sample(rng, _POINTS)
        log_weight = log_posterior(components, scale, z) - proposal.log_density(z)
        temperature = 1.0
        while (effective := _effective(log_weight / temperature)) < _LEAST * len(z) and temperature < 1e3:
            temperature *= 1.3
        weight = np.exp((log_weight - log_weight.max()) / temperature)
        chosen = z[rng.choice(len(z), count, p=weight / weight.sum())]
        effective = _effective(log_weight)
        if effective > _ENOUGH or last == _ROUNDS - 1:
            break
        proposal = fit_mixture(chosen, np.ones(scale.box.d), seed)
    if effective > LEAST_EFFECTIVE:
        weight = np.exp(log_weight - log_weight.max())
        chosen = z[rng.choice(len(z), count, p=weight / weight.sum())]
    return chosen, effective


def _effective(log_weight: FloatArray) -> float:
    """Number of points that count (Kish)."""
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / (weight**2).sum())
