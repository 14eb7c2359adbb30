"""How far the emulator's error may still move the posterior, and the runs that would tell most."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.emulator import Components, Part

_DRAWS, _WORLDS = 400, 64
_CANDIDATES, _JUDGES = 60, 300


def expected_change(
    components: Components, draws: FloatArray, rng: np.random.Generator, of: Part = "emulator and correction"
) -> FloatArray:
    """(d,): the standard deviation of the posterior's mean over what the true residuals may be, in posterior sds.

    draws (m, d): z of the posterior. Errors are drawn jointly at some of them; each draw then has another likelihood, and the
    weights give another mean. of: whose errors, where cheap runs are corrected by few of a reference.
    """
    z = draws[rng.choice(len(draws), min(_DRAWS, len(draws)), replace=False)]
    mean, variance = components.predict(z)
    total = 1.0 + variance
    now = -0.5 * ((mean**2 / total) + np.log(total)).sum(1)
    spread = np.maximum(z.std(0), 1e-12)
    found = []
    errors = components.errors(z, of)
    for _ in range(_WORLDS):
        weight = -0.5 * ((mean + errors(rng)) ** 2).sum(1) - now
        weight = np.exp(weight - weight.max())
        found.append((weight @ z) / weight.sum())
    return np.asarray(np.std(found, axis=0) / spread)


def most_telling(
    components: Components, draws: FloatArray, count: int, rng: np.random.Generator, of: Part = "emulator"
) -> FloatArray:
    """``count`` of the posterior's draws (m, d): those whose runs leave the least error in log likelihood over all draws.

    The error of -chi^2 / 2 at a draw has the variance sum_k (c_k^2 V_k + V_k^2 / 2), V_k the components' variance there; a
    run's place alone says what variance it will leave. of: whose variance the runs are to lessen.
    """
    judges = draws[rng.choice(len(draws), min(_JUDGES, len(draws)), replace=False)]
    candidates = draws[rng.choice(len(draws), min(_CANDIDATES, len(draws)), replace=False)]
    mean = components.mean(judges)
    process = components.part(of)
    linear = (mean**2 * process.variance).sum(1)
    square = 0.5 * (process.variance**2).sum()
    chosen: list[FloatArray] = []
    for _ in range(count):
        # the candidates at which most is unknown come into question; each is tried
        doubtful = candidates[np.argsort(-process.share(candidates))[:12]]
        left = []
        for z in doubtful:
            share = process.joined_by(z[None]).share(judges)
            left.append(float(np.sqrt(linear * share + square * share**2).mean()))
        z = doubtful[int(np.argmin(left))]
        chosen.append(z)
        process = process.joined_by(z[None])
    return np.array(chosen)
