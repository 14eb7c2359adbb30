"""Models of one patient compared: each region its own stiffness, one for all, regions that vary about a common level, or any that
are tied; and other anatomies.

All models of one simulator share its emulators: a tied model is the same emulators on a smaller box. It costs no runs but where
it is likely and none has been (see ``models.further``). Told are the evidence with a uniform prior on the box (of regions about a
level: see ``models.pooling``) times the priors that the targets state, as the calibration had them, which to all models alike are
what was seen of inputs beside the targets; PSIS-LOO over the targets (Vehtari et al. 2017; with correlated errors by the
conditional densities of Buerkner et al. 2021) with its effective number of parameters; and the misfit of the displacements.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from lacli.base import quiet
from lacli.base.arrays import FloatArray
from lacli.base.errors import UsageError
from lacli.calibration.sequential.draw.likelihood import Decorrelated
from lacli.calibration.sequential.evidence import narrowed
from lacli.calibration.sequential.outputs import Features
from lacli.cohort.models.evidence import evidence
from lacli.cohort.models.further import Doubt
from lacli.cohort.models.pooling import pooled
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
_WORLDS, _DRAWS = 100, 400  # of what the emulators may err in, at so many draws of each model


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

    free: number of its inputs; log_evidence and elpd (PSIS-LOO) in nats with standard errors, the former's of sampling alone;
    emulator_se: what of log_evidence hangs on the error of a sequential calibration's emulators, a standard deviation (NaN: of
    others it is not known); p_loo: effective parameters; worst_k: largest Pareto k, above .7 of no worth; rmse_mm: of the
    displacement targets at the best draw, and its mean and sd over the posterior (NaN where no target is in mm).
    """

    name: str
    free: int
    log_evidence: float
    log_evidence_se: float
    emulator_se: float
    elpd: float
    elpd_se: float
    p_loo: float
    worst_k: float
    rmse_mm: float
    rmse_mean_mm: float
    rmse_sd_mm: float


@dataclass(frozen=True)
class Contrast:
    """A model against another: difference of log evidences with its standard error, of sampling and of the emulators, which err
    alike in models that share them; and what it says."""

    model: str
    against: str
    difference: float
    se: float
    verdict: str


@dataclass(frozen=True)
class Comparison:
    """All fits, the contrasts of the first model against each other one and of a pooled one against the global, warnings in
    words; how many runs were made for it, and of them the scenes' own beside cheap ones."""

    fits: tuple[Fit, ...]
    contrasts: tuple[Contrast, ...]
    warnings: tuple[str, ...]
    runs: int = 0
    reference_runs: int = 0


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
    found = [_fit(model, targets.select(model.emulators.outputs), particles, seed, tick) for model in models]
    fits, said, draws = [fit for fit, _, _ in found], [words for _, of, _ in found for words in of], [x for _, _, x in found]
    of_emulators = _emulators_errors(models, targets, draws, seed)
    if of_emulators is not None:
        fits = [replace(fit, emulator_se=float(of_emulators[k, k])) for k, fit in enumerate(fits)]
    pairs = [(0, k) for k in range(1, len(fits))]
    names = [fit.name for fit in fits]
    if POOLED in names and GLOBAL in names:
        pairs.append((names.index(POOLED), names.index(GLOBAL)))
    contrasts = [_contrast(fits[j], fits[k], 0.0 if of_emulators is None else float(of_emulators[j, k])) for j, k in pairs]
    return Comparison(tuple(fits), tuple(contrasts), tuple(said))


def _contrast(first: Fit, other: Fit, of_emulators: float) -> Contrast:
    difference = first.log_evidence - other.log_evidence
    se = math.hypot(first.log_evidence_se, other.log_evidence_se, of_emulators)
    if abs(difference) < STRONG + 2 * se:
        verdict = "no contrast can be claimed"
    else:
        verdict = f"{first.name if difference > 0 else other.name} is strongly preferred"
    return Contrast(first.name, other.name, difference, se, verdict)


def doubts(
    models: Sequence[Model], targets: Targets, particles: int, seed: int, tick: Callable[[], None] = lambda: None
) -> dict[str, Doubt]:
    """By model of emulated features: how far its log evidence hangs on the emulator, by fewer particles than ``compare``.

    tick: called twice a model.
    """
    told = {}
    for model in models:
        assert isinstance(model.emulators, Features), "others tell no joint errors"
        held = targets.select(model.emulators.outputs)
        likelihood = Decorrelated.of(model.emulators, held)
        box, lift, posterior = _posterior(model, held, likelihood)
        points = lift(evidence(posterior, box, particles, repeats=2, seed=seed, tick=tick).draws)
        rng = np.random.default_rng([seed, 5])
        se, of_runs, of_correction = (
            float(_changes(likelihood.worlds(_some(points), part), [len(_some(points))], rng).std())
            for part in ("emulator and correction", "emulator", "correction")
        )
        beyond = coverage(model.box, model.emulators.training_inputs(), points).share > TOO_MUCH
        told[model.name] = Doubt(se, of_runs, of_correction, beyond, points)
    return told


def _emulators_errors(models: Sequence[Model], targets: Targets, draws: Sequence[FloatArray], seed: int) -> FloatArray | None:
    """(k, k): what of two models' difference of log evidence hangs on the emulators' errors, a standard deviation; on the
    diagonal, of each alone. Models that share emulators share their errors. None where emulators are of another kind."""
    if not all(isinstance(model.emulators, Features) for model in models):
        return None
    changes = np.empty((_WORLDS, len(models)))
    groups: dict[int, list[int]] = {}
    for k, model in enumerate(models):
        groups.setdefault(id(model.emulators), []).append(k)
    for number, group in enumerate(groups.values()):
        emulators = models[group[0]].emulators
        assert isinstance(emulators, Features)
        some = [_some(draws[k]) for k in group]
        likelihood = Decorrelated.of(emulators, targets.select(emulators.outputs))
        rng = np.random.default_rng([seed, 6, number])
        changes[:, group] = _changes(likelihood.worlds(np.concatenate(some)), list(map(len, some)), rng)
    apart = (changes[:, :, None] - changes[:, None, :]).std(axis=0)
    return np.asarray(apart + np.diag(changes.std(axis=0)))


def _changes(world: Callable[[np.random.Generator], FloatArray], counts: Sequence[int], rng: np.random.Generator) -> FloatArray:
    """(worlds, k): what the emulator's errors would change in the log evidences of k models, of whom the draws are so many."""
    ends = np.cumsum(counts)[:-1]
    found = [[logsumexp(part) - math.log(len(part)) for part in np.split(world(rng), ends)] for _ in range(_WORLDS)]
    return np.array(found, float)


def _some(draws: FloatArray) -> FloatArray:
    """As many of the draws (m, d) as errors are drawn at."""
    return draws[np.linspace(0, len(draws) - 1, min(_DRAWS, len(draws))).astype(int)]


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


def _fit(
    model: Model, targets: Targets, particles: int, seed: int, tick: Callable[[], None]
) -> tuple[Fit, list[str], FloatArray]:
    """The fit, what is to be said of it, and draws (m, d) of the model's posterior."""
    likelihood = _likelihood(model.emulators, targets)
    box, lift, posterior = _posterior(model, targets, likelihood)
    found = evidence(posterior, box, particles, seed=seed, tick=tick)
    points = lift(found.draws)
    mean, _ = model.emulators.predict_truth(points)
    elpd, elpd_se, p_loo, worst = _loo(likelihood.pointwise(points))
    in_mm = np.array([name.partition("@")[0].endswith("_mm") for name in targets.names])
    rmse = np.sqrt(((mean - targets.mean)[:, in_mm] ** 2).mean(axis=1)) if in_mm.any() else np.full(len(mean), np.nan)
    best = int(np.argmax(posterior(found.draws)))
    said = []
    if words := _extrapolated(model, points):
        said.append(f"{model.name}: {words}")
    if worst > WORST_K:
        said.append(
            f"{model.name}: PSIS-LOO is not to be trusted (Pareto k {worst:.2f} > .7): a target alone decides; take the evidence."
        )
    fit = Fit(
        model.name, box.d, found.log_z, found.se, math.nan, elpd, elpd_se, p_loo, worst,
        float(rmse[best]), float(rmse.mean()), float(rmse.std(ddof=1)),
    )  # fmt: skip
    return fit, said, points


def _posterior(
    model: Model, targets: Targets, likelihood: Likelihood
) -> tuple[Box, Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]:
    """The box of the model's free inputs, the map of its points to those of the full box, and of L times priors the logarithm."""
    box, lift = reduced(replace(model, box=narrowed(model.box, targets)))

    def posterior(x: FloatArray) -> FloatArray:
        full = lift(x)
        return np.asarray(likelihood(full) + log_prior(targets.priors, model.box.names, full))

    return box, lift, posterior


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
