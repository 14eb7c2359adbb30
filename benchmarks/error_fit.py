"""The law of discretisation errors that fits those of many anatomies, and what it is worth on anatomies it was not fitted to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from lacli.contracts.features import family
from lacli.mechanics.numerics.error_model import Resolution

LEAST = 1e-5  # of a feature's scale: below it lies the solver's tolerance
HELD = 0.95


@dataclass(frozen=True)
class Difference:
    """A true error: of which anatomy, feature, resolution; its size and sign in the feature's unit and the feature's scale;
    resolution of the reference; ln(d_ES / d) at the feature's time."""

    seed: int
    name: str
    where: Resolution
    error: float
    scale: float
    cell_mm: float
    reference: Resolution
    early: float = 0.0

    @property
    def relative(self) -> float:
        """The logarithm of the error's share of the scale."""
        return math.log(max(abs(self.error) / self.scale, LEAST))


@dataclass(frozen=True)
class Fit:
    """Coefficients of one order. Quadratic cells' reference has an error of its own, of the same law: of two meshes of one
    atrium, cut and numbered apart, the errors are taken for independent."""

    size: float
    t: float
    features: dict[str, float]
    early: float = 0.0

    def typical(self, d: Difference) -> float:
        """The logarithm of the typical difference's share of the scale."""
        a, b = d.where.slopes
        shape = self.size * a + self.t * b + self.early * d.early
        return self.features[family(d.name)] + shape + of_reference(d, self.size)


def of_reference(d: Difference, power: float) -> float:
    """What the reference's own error adds to the logarithm of a difference, where errors go with turn^power."""
    return 0.5 * math.log1p((d.reference.turn / d.where.turn) ** (2.0 * power)) if d.where.order == 2 else 0.0


def fit(data: list[Difference]) -> Fit:
    """Least squares of the logarithms: a constant for each feature and two slopes, again until the power of the size and the
    references' share agree; beside them the power of the motion, by the errors that the rest makes large (``of_tail``)."""
    names = sorted({family(d.name) for d in data})
    a = np.zeros((len(data), len(names) + 2))
    for i, d in enumerate(data):
        a[i, names.index(family(d.name))] = 1.0
        a[i, -2:] = d.where.slopes
    relative, early = np.array([d.relative for d in data]), np.array([d.early for d in data])
    power, motion = 1.0, 0.0
    for _ in range(50):
        apart = relative - np.array([of_reference(d, max(power, 0.0)) for d in data])
        solution = np.linalg.lstsq(a, apart - motion * early, rcond=None)[0]
        last, (power, motion) = (power, motion), (float(solution[-2]), of_tail(apart - a @ solution, early))
        if abs(last[0] - power) < 1e-6 and abs(last[1] - motion) < 1e-4:
            break
    return Fit(power, float(solution[-1]), dict(zip(names, map(float, solution), strict=False)), motion)


def of_tail(excess: np.ndarray, early: np.ndarray) -> float:
    """The power of d_ES / d by which the share HELD of the errors lies below the same multiple of the typical at all times: least
    pinball loss. The large errors, soft walls' among them, fall less towards end-diastole than those in the middle."""
    if not early.any():
        return 0.0

    def loss(power: float) -> float:
        off = excess - power * early
        off = off - np.quantile(off, HELD)
        return float(np.mean(np.where(off > 0.0, HELD * off, (HELD - 1.0) * off)))

    return float(minimize_scalar(loss, bounds=(0.0, 2.0), method="bounded", options={"xatol": 1e-4}).x)


def constant(data: list[Difference], size: float, t: float) -> float:
    """The constant of one feature's errors by slopes that are given."""
    return float(np.mean([d.relative - size * d.where.slopes[0] - t * d.where.slopes[1] for d in data]))


def excess(data: list[Difference]) -> np.ndarray:
    """Logarithms of true over typical error, each anatomy's by a fit to the others."""
    seeds = sorted({d.seed for d in data})
    apart = []
    for seed in seeds:
        rest = fit([d for d in data if d.seed != seed])
        apart += [d.relative - rest.typical(d) for d in data if d.seed == seed]
    return np.array(apart)


def factor(data: list[Difference]) -> float:
    """What the typical errors are multiplied by, so that the share of unseen errors lies within twice the stated."""
    return float(np.exp(np.quantile(excess(data), HELD))) / 2.0


def coverage(data: list[Difference]) -> dict[int, float]:
    """Share of each anatomy's errors within twice the stated, fit and factor by the others."""
    found = {}
    for seed in sorted({d.seed for d in data}):
        rest = [d for d in data if d.seed != seed]
        model, by = fit(rest), factor(rest)
        own = [d for d in data if d.seed == seed]
        found[seed] = float(np.mean([abs(d.error) <= 2.0 * by * d.scale * math.exp(model.typical(d)) for d in own]))
    return found


def factor_of(ratios: dict[int, list[float]]) -> float:
    """What holds that share of true errors within twice the stated, by their ratios; every anatomy has the same weight."""
    values = np.concatenate([np.array(own) for own in ratios.values()])
    weight = np.concatenate([np.full(len(own), 1.0 / len(own)) for own in ratios.values()])
    order = np.argsort(values)
    share = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(share, HELD * share[-1])]) / 2.0
