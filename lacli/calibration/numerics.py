"""What a choice of numerics does to the answer: the posterior by cheap simulations against that by the reference's.

The patient is the reference's own simulation at the scene's parameters x*, so that the reference's posterior has its most
probable point there. A cheaper choice reads the same targets through its own f_c: Gauss-Newton steps from x*, each by one run
with its derivatives and halved while it leads uphill, lead to its most probable point; the curvature there is the posterior's
precision (Laplace's approximation, a Gaussian of the box's variance as prior). Shifts are in standard deviations of the
reference's posterior.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.linalg import solve_triangular

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError, UsageError
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import Outcome, Simulator
from lacli.mechanics.numerics.error_correlation import correlation

MOST_RUNS = 5
_SETTLED = 0.03  # standard deviations: a shorter step ends the search
_NEAR = 0.1  # and one so short after the last run: a fraction of a shift that matters
_PRIOR = 12.0  # precision of a uniform distribution on the unit interval
_LONGEST = 0.25  # of the box in one step


@dataclass(frozen=True)
class Choice:
    """A choice of numerics: its name, the simulator of the scene with it, the scene's discretisation errors (sd, in the targets'
    units) that a calibration with it adds to the targets' own, and the order of the cells, by which they go together."""

    name: str
    simulator: Simulator
    errors: Mapping[str, float]
    order: int = 2


@dataclass(frozen=True)
class Effect:
    """What a choice does: runs made and CPU seconds of one; its most probable point x (d,); shift (d,) from the reference's and
    sd_ratio (d,), both by the reference's standard deviations; wider (d,): the standard deviation with its own discretisation
    errors in the likelihood, and shift_wider (d,) the shift then, in units of ``wider``; error: root mean square of the features'
    errors in standard deviations of the targets. ``trouble`` says why there is none."""

    name: str
    runs: int
    cpu_s: float
    x: FloatArray
    shift: FloatArray
    sd_ratio: FloatArray
    shift_wider: FloatArray
    wider_ratio: FloatArray
    error: float
    trouble: str = ""


@dataclass(frozen=True)
class _Point:
    y: FloatArray
    jacobian: FloatArray  # (p, d) by z
    cpu_s: float


def effects(
    choices: Sequence[Choice], targets: Targets, box: Box, x: FloatArray, tell: Callable[[str], None] = lambda name: None
) -> list[Effect]:
    """The effect of every choice on the posterior at x (d,) within the box; the last is the reference.

    targets: names and errors count, their means do not. Raises UsageError where x is outside the box, LacliError where the
    reference fails or tells no derivatives.
    """
    if not box.contains(x[None])[0]:
        outside = [
            f"{name} {value:g} ({low:g} to {high:g})"
            for name, value, low, high in zip(box.names, x, box.lower, box.upper, strict=True)
            if not low <= value <= high
        ]
        raise UsageError(f"tradeoff: the scene's parameters are outside the box: {', '.join(outside) or 'their order'}.")
    scale = Scale.of(box)
    tell(choices[-1].name)
    best = _run(choices[-1], targets, box, x, scale)
    patient = Targets(targets.names, best.y, targets.sd, targets.covariance)
    reference = _sd(best.jacobian, _factor(patient, {}, choices[-1].order))
    found = []
    for choice in choices[:-1]:
        tell(choice.name)
        try:
            found.append(_effect(choice, patient, box, x, scale, reference))
        except LacliError as error:
            nothing = np.full(box.d, np.nan)
            found.append(Effect(choice.name, 1, float("nan"), nothing, *(nothing,) * 4, float("nan"), str(error)))
    same = np.zeros(box.d)
    return [*found, Effect(choices[-1].name, 1, best.cpu_s, x, same, same + 1.0, same, same + 1.0, 0.0)]


def recommend(found: Sequence[Effect], names: Sequence[str], tolerance: float) -> Effect | None:
    """The cheapest choice that shifts no alpha (no input, where there is none) by more than ``tolerance`` standard deviations."""
    good = [effect for effect in found if not effect.trouble and worst_shift(effect, names) <= tolerance]
    return min(good, key=lambda effect: effect.cpu_s) if good else None


def worst_shift(effect: Effect, names: Sequence[str]) -> float:
    """The largest shift of an alpha, in the reference's standard deviations; of all inputs where none is an alpha."""
    alphas = [i for i, name in enumerate(names) if name.startswith("alpha_")] or list(range(len(names)))
    return float(np.abs(effect.shift[alphas]).max())


def _effect(choice: Choice, patient: Targets, box: Box, x: FloatArray, scale: Scale, reference: FloatArray) -> Effect:
    first = _run(choice, patient, box, x, scale)
    plain, wide = _factor(patient, {}, choice.order), _factor(patient, choice.errors, choice.order)
    error = float(np.sqrt(np.mean(solve_triangular(plain, first.y - patient.mean, lower=True) ** 2)))
    start = scale.to_z(x[None])[0]
    z, point, cpu = start, first, [first.cpu_s]
    share = 1.0  # of the Gauss-Newton step: halved while it leads uphill
    ahead = _ahead(point, patient, plain, z, start)
    while (left := float(np.max(np.abs(ahead) / reference))) >= _SETTLED and len(cpu) < MOST_RUNS:
        tried = z + share * ahead
        there = _run(choice, patient, box, scale.to_x(tried[None])[0], scale)
        cpu.append(there.cpu_s)
        if _misfit(there, patient, plain, tried - start) <= _misfit(point, patient, plain, z - start):
            z, point, share = tried, there, 1.0
            ahead = _ahead(point, patient, plain, z, start)
        else:
            share /= 2.0
    if left >= _NEAR:
        return Effect(
            choice.name, len(cpu), float(np.mean(cpu)), *(np.full(box.d, np.nan),) * 5, error,
            f"tradeoff: {len(cpu)} runs with {choice.name} did not come to its most probable point.",
        )  # fmt: skip
    z = z + ahead
    shift = (z - start) / reference
    wider = _sd(point.jacobian, wide)
    shifted = z + _step(point, patient, wide, z - start) - start
    return Effect(
        choice.name, len(cpu), float(np.mean(cpu)), scale.to_x(z[None])[0], shift, _sd(point.jacobian, plain) / reference,
        shifted / wider, wider / reference, error,
    )  # fmt: skip


def _run(choice: Choice, targets: Targets, box: Box, x: FloatArray, scale: Scale) -> _Point:
    ((_, outcome),) = choice.simulator(pd.DataFrame([x], columns=list(box.names)))
    if outcome.status != "done":
        raise LacliError(f"tradeoff: the simulation with {choice.name} failed ({outcome.kind}): {outcome.message}")
    y = np.array([outcome.outputs.get(name, np.nan) for name in targets.names])
    lacking = [name for name, value in zip(targets.names, y, strict=True) if not np.isfinite(value)]
    if lacking:
        raise LacliError(
            f"tradeoff: the simulation with {choice.name} has no {', '.join(lacking[:6])}; remove it from the targets."
        )
    jacobian = _jacobian(outcome, targets.names, box.names)
    if not np.isfinite(jacobian).all():
        raise LacliError(f"tradeoff: the simulation with {choice.name} tells no derivatives of some targets.")
    return _Point(y, jacobian * scale.slope(x[None])[0], outcome.cpu_s)


def _jacobian(outcome: Outcome, names: Sequence[str], inputs: Sequence[str]) -> FloatArray:
    return np.array([[outcome.gradients.get((name, given), np.nan) for given in inputs] for name in names])


def _factor(targets: Targets, errors: Mapping[str, float], order: int) -> FloatArray:
    """(p, p) lower triangle of the covariance of the targets, widened by errors."""
    wide = targets.widened(errors, correlation(targets.names, targets.mean, order))
    covariance = np.diag(wide.sd**2) if wide.covariance is None else wide.covariance
    return np.asarray(np.linalg.cholesky(covariance))


def _sd(jacobian: FloatArray, factor: FloatArray) -> FloatArray:
    """(d,) posterior standard deviations in z."""
    j = solve_triangular(factor, jacobian, lower=True)
    precision = j.T @ j + _PRIOR * np.eye(j.shape[1])
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(precision))))


def _step(point: _Point, targets: Targets, factor: FloatArray, away: FloatArray) -> FloatArray:
    """The Gauss-Newton step (d,) from a run at ``away`` from the prior's centre, no longer than a quarter of the box."""
    j = solve_triangular(factor, point.jacobian, lower=True)
    r = solve_triangular(factor, point.y - targets.mean, lower=True)
    step = -np.linalg.solve(j.T @ j + _PRIOR * np.eye(j.shape[1]), j.T @ r + _PRIOR * away)
    return np.asarray(step * min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-300)))


def _ahead(point: _Point, targets: Targets, factor: FloatArray, z: FloatArray, start: FloatArray) -> FloatArray:
    """The step (d,) from the run at z, as far as the box goes."""
    return np.asarray(np.clip(z + _step(point, targets, factor, z - start), 0.0, 1.0) - z)


def _misfit(point: _Point, targets: Targets, factor: FloatArray, away: FloatArray) -> float:
    """What the search makes small: the misfit of a run and the distance from the prior's centre, squared."""
    r = solve_triangular(factor, point.y - targets.mean, lower=True)
    return float(r @ r + _PRIOR * away @ away)
