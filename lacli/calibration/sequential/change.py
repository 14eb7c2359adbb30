"""How far the emulator's error may still move the posterior, and the runs that would tell most."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.emulator import Components

_DRAWS, _WORLDS = 400, 64
_CANDIDATES, _JUDGES = 60, 300


def expected_change(components: Components, draws: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(d,): the standard deviation of the posterior's mean over what the true residuals may be, in posterior sds.

    draws (m, d): z of the posterior. Errors are drawn jointly at some of them; each draw then has another likelihood, and the
    weights give another mean.
    """
    z = draws[rng.choice(len(draws), min(_DRAWS, len(draws)), replace=False)]
    mean = components.mean(z)
    covariance = components.covariance(z)
    size, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    scale = np.sqrt(components.variance)
    total = 1.0 + np.maximum(np.diag(covariance), 0.0)[:, None] * components.variance
    now = -0.5 * ((mean**2 / total) + np.log(total)).sum(1)
    spread = np.maximum(z.std(0), 1e-12)
    found = []
    for _ in range(_WORLDS):
        error = root @ rng.standard_normal((len(z), len(scale))) * scale
        weight = -0.5 * ((mean + error) ** 2).sum(1) - now
        weight = np.exp(weight - weight.max())
        found.append((weight @ z) / weight.sum())
    return np.asarray(np.std(found, axis=0) / spread)


def most_telling(components: Components, draws: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """``count`` of the posterior's draws (m, d): those whose runs leave the least error in log likelihood over all draws.

    The error of -chi^2 / 2 at a draw has the variance sum_k (c_k^2 V_k + V_k^2 / 2), V_k the components' variance there; a
    run's place alone says what variance it will leave.
    """
    judges = draws[rng.choice(len(draws), min(_JUDGES, len(draws)), replace=False)]
    candidates = draws[rng.choice(len(draws), min(_CANDIDATES, len(draws)), replace=False)]
    mean = components.mean(judges)
    linear = (mean**2 * components.variance).sum(1)
    square = 0.5 * (components.variance**2).sum()
    chosen: list[FloatArray] = []
    for _ in range(count):
        # the candidates at which most is unknown come into question; each is tried
        doubtful = candidates[np.argsort(-components.share(candidates))[:12]]
        left = []
        for z in doubtful:
            share = components.joined_by(z[None]).share(judges)
            left.append(float(np.sqrt(linear * share + square * share**2).mean()))
        z = doubtful[int(np.argmin(left))]
        chosen.append(z)
        components = components.joined_by(z[None])
    return np.array(chosen)
