"""Models of one patient compared: each region its own stiffness, one for all, regions that vary about a common level, or any that
are tied; and other anatomies.

All models of one simulator share its emulators: a tied model is the same emulators on a smaller box, so it costs no runs. Told
are the evidence with a uniform prior on the box (of regions about a level: see ``pooling``) times the priors that the targets
state, as the calibration had them, which to all models alike are what was seen of inputs beside the targets; PSIS-LOO over the
targets (Vehtari et al. 2017; with correlated errors by the conditional densities of Buerkner et al. 2021) with its effective
number of parameters; and the misfit of the displacements.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lacli.base import quiet
from lacli.base.arrays import FloatArray
from lacli.base.errors import UsageError
from lacli.calibration.sequential.draw.likelihood import Decorrelated
from lacli.calibration.sequential.evidence import narrowed
from lacli.calibration.sequential.outputs import Features
from lacli.cohort.evidence import evidence
from lacli.cohort.pooling import pooled
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.priors import log_prior
from lacli.contracts.targets import Targets
from lacli.inference.box import Box, make_box
from lacli.inference.emulation.emulator_set import AnyEmulators
from lacli.inference.sampling.coverage import TOO_MUCH, coverage
from lacli.inference.sampling.likelihood import ByFeature, Likelihood

REGIONAL, GLOBAL, POOLED = "regional", "global", "pooled"
STRONG = 3.0  # of the difference of log evidences: odds of 20 to 1
WORST_K = 0.7  # of Pareto: beyond it PSIS-LOO is of no worth
EXTRAPOLATED = "its evidence is by extrapolation, do not rely on it"
_PARTS = ("alpha", "c")


@dataclass(frozen=True)
class Model:
    """A model: emulators with their box, and groups of inputs that are one number; with ``spread`` they vary about it."""

    name: str
    emulators: AnyEmulators | Features
    box: Box
    tied: tuple[tuple[str, ...], ...] = ()
    spread: bool = False


@dataclass(frozen=True)
class Fit:
    """What the targets say of a model.

    free: number of its inputs; log_evidence and elpd (PSIS-LOO) in nats with standard errors; p_loo: effective parameters;
    worst_k: largest Pareto k, above .7 of no worth; rmse_mm: of the displacement targets at the best draw, and its mean and sd
    over the posterior (NaN where no target is in mm).
    """

    name: str
    free: int
    log_evidence: float
    log_evidence_se: float
    elpd: float
    elpd_se: float
    p_loo: float
    worst_k: float
    rmse_mm: float
    rmse_mean_mm: float
    rmse_sd_mm: float


@dataclass(frozen=True)
class Contrast:
    """A model against another: difference of log evidences with its standard error, and what it says."""

    model: str
    against: str
    difference: float
    se: float
    verdict: str


@dataclass(frozen=True)
class Comparison:
    """All fits, the contrasts of the first model against each other one and of a pooled one against the global, warnings in
    words."""

    fits: tuple[Fit, ...]
    contrasts: tuple[Contrast, ...]
    warnings: tuple[str, ...]


def tied_regions(inputs: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """The groups of one stiffness for all regions. Raises UsageError where no stiffness has two regions among the inputs."""
    groups = [tuple(f"{part}_{name}" for name in BODY_REGIONS if f"{part}_{name}" in inputs) for part in _PARTS]
    groups += [tuple(f"{part}_{name}_kpa" for name in BODY_REGIONS if f"{part}_{name}_kpa" in inputs) for part in _PARTS]
    found = tuple(group for group in groups if len(group) > 1)
    if not found:
        raise UsageError(
            "compare: fewer than two regions' stiffness were calibrated; there is no global model beside the regional."
        )
    return found


def compare(
    models: Sequence[Model], targets: Targets, particles: int = 600, seed: int = 0, tick: Callable[[], None] = lambda: None
) -> Comparison:
    """The comparison, the first model against the others, and a pooled one against the global.

    tick: called four times a model. Raises UsageError, LacliError.
    """
    fits, said = [], []
    for model in models:
        fit, words = _fit(model, targets.select(model.emulators.outputs), particles, seed, tick)
        fits.append(fit)
        said += words
    contrasts = [_contrast(fits[0], other) for other in fits[1:]]
    named = {fit.name: fit for fit in fits}
    if POOLED in named and GLOBAL in named:
        contrasts.append(_contrast(named[POOLED], named[GLOBAL]))
    return Comparison(tuple(fits), tuple(contrasts), tuple(said))


def _contrast(first: Fit, other: Fit) -> Contrast:
    difference = first.log_evidence - other.log_evidence
    se = math.hypot(first.log_evidence_se, other.log_evidence_se)
    if abs(difference) < STRONG + 2 * se:
        verdict = "no contrast can be claimed"
    else:
        verdict = f"{first.name if difference > 0 else other.name} is strongly preferred"
    return Contrast(first.name, other.name, difference, se, verdict)


def reduced(model: Model) -> tuple[Box, Callable[[FloatArray], FloatArray]]:
    """The box of the model's free inputs, and the map of its points (m, k) to those of the full box (m, d)."""
    names = model.box.names
    first: dict[str, str] = {}
    for group in model.tied:
        for name in group:
            if name not in names:
                raise UsageError(f"compare: {name} is no input; there are {', '.join(names)}.")
            if name in first:
                raise UsageError(f"compare: {name} is tied twice.")
            first[name] = group[0]
    free = [name for name in names if first.get(name, name) == name]
    low, high = dict(zip(names, model.box.lower, strict=True)), dict(zip(names, model.box.upper, strict=True))
    for group in model.tied:
        low[group[0]], high[group[0]] = max(low[n] for n in group), min(high[n] for n in group)
        if not low[group[0]] < high[group[0]]:
            raise UsageError(f"compare: the ranges of {', '.join(group)} have nothing in common.")
    if model.spread:
        return pooled(model.box, model.tied, [(low[group[0]], high[group[0]]) for group in model.tied])
    column = [free.index(first.get(name, name)) for name in names]
    return make_box(free, [low[n] for n in free], [high[n] for n in free]), lambda x: x[:, column]


def _fit(model: Model, targets: Targets, particles: int, seed: int, tick: Callable[[], None]) -> tuple[Fit, list[str]]:
    box, lift = reduced(replace(model, box=narrowed(model.box, targets)))

    likelihood = _likelihood(model.emulators, targets)

    def told(full: FloatArray) -> FloatArray:
        return likelihood(full) + log_prior(targets.priors, model.box.names, full)

    found = evidence(lambda x: told(lift(x)), box, particles, seed=seed, tick=tick)
    points = lift(found.draws)
    mean, _ = model.emulators.predict_truth(points)
    elpd, elpd_se, p_loo, worst = _loo(likelihood.pointwise(points))
    in_mm = np.array([name.partition("@")[0].endswith("_mm") for name in targets.names])
    rmse = np.sqrt(((mean - targets.mean)[:, in_mm] ** 2).mean(axis=1)) if in_mm.any() else np.full(len(mean), np.nan)
    best = int(np.argmax(told(points)))
    said = []
    if words := _extrapolated(model, points):
        said.append(f"{model.name}: {words}")
    if worst > WORST_K:
        said.append(
            f"{model.name}: PSIS-LOO is not to be trusted (Pareto k {worst:.2f} > .7): a target alone decides; take the evidence."
        )
    fit = Fit(
        model.name, box.d, found.log_z, found.se, elpd, elpd_se, p_loo, worst,
        float(rmse[best]), float(rmse.mean()), float(rmse.std(ddof=1)),
    )  # fmt: skip
    return fit, said


def _extrapolated(model: Model, points: FloatArray) -> str:
    """What of a model's posterior draws lies where no run has been, in words; '' where (nearly) nothing does.

    Even where all of them do it is a word: an end would take the other models' evidence with it.
    """
    found = coverage(model.box, model.emulators.training_inputs(), points)
    words = found.words("its posterior")
    return f"{EXTRAPOLATED}: {words}" if found.share > TOO_MUCH else words


def _likelihood(emulators: AnyEmulators | Features, targets: Targets) -> Likelihood:
    return Decorrelated.of(emulators, targets) if isinstance(emulators, Features) else ByFeature(emulators, targets)


def _loo(pointwise: FloatArray) -> tuple[float, float, float, float]:
    az = quiet.arviz()
    m = len(pointwise)
    data = az.from_dict(posterior={"draw_number": np.arange(m, dtype=float)[None]}, log_likelihood={"y": pointwise[None]})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Pareto's k: we tell it ourselves
        loo = az.loo(data, pointwise=True, reff=1.0)
    return float(loo.elpd_loo), float(loo.se), float(loo.p_loo), float(np.max(loo.pareto_k))
