"""Damped Gauss-Newton on real runs: from several starts, which share their runs, to the most probable point.

Each round runs two trials side by side: the Levenberg-Marquardt step of the best run's own derivatives, and the lowest point of
the emulator of all runs within the trust radius; where the two are the same, the step of the next start that has not come to the
same place takes the second one. (Levenberg 1944, Marquardt 1963; the damping as Nielsen 1999.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares, lsq_linear

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.emulator import Components
from lacli.calibration.sequential.evidence import Evidence
from lacli.calibration.sequential.fidelity import corrected

_RADIUS = 0.35  # of a trial's step, in widths of the box
_SAME = 0.02  # two trials as near as this are one
_DAMPING = 1e-3  # first, of the mean diagonal of J' J
SETTLED = 0.5  # decrease of chi^2 still expected, below which a point is the lowest: a quarter of a posterior sd in one direction
_IDLE = 2  # rounds in a row that did not lower the best point's chi^2 by as much
_UNMET = 2.0  # decrease expected, and not met in so many rounds, that is the runs' own scatter: early frames jump by a branch


@dataclass(frozen=True)
class Incumbent:
    """The best point that a start has reached: its z (d,), damping and trust radius, rounds in a row that gained nothing."""

    z: FloatArray
    damping: float = _DAMPING
    growth: float = 2.0
    radius: float = _RADIUS
    idle: int = 0


@dataclass(frozen=True)
class Trial:
    """A point to run, the decrease of chi^2 that its model expects, and from which incumbent."""

    z: FloatArray
    expected: float
    start: int


def levenberg(
    residual: FloatArray, jacobian: FloatArray, z: FloatArray, damping: float, radius: float
) -> tuple[FloatArray, float]:
    """The damped step (d,) within the box and the radius, and the decrease of chi^2 that the linear model expects."""
    d = len(z)
    scale = damping * float(np.mean((jacobian**2).sum(0)))
    low, high = np.maximum(-z, -radius), np.minimum(1.0 - z, radius)
    # an end of the box that the point stands on leaves no room: a bound must be below the other
    wide = high - low > 1e-12
    step = np.zeros(d)
    a = np.vstack([jacobian[:, wide], np.sqrt(scale) * np.eye(int(wide.sum()))])
    b = np.concatenate([-residual, np.zeros(int(wide.sum()))])
    step[wide] = np.clip(lsq_linear(a, b, (low[wide], high[wide])).x, low[wide], high[wide])
    left = residual + jacobian @ step
    return step, float(residual @ residual - left @ left)


def lowest(components: Components, z: FloatArray, radius: float = 1.0) -> tuple[FloatArray, float]:
    """The emulated residual's lowest point near z, within the box and the radius, and chi^2 there."""
    low, high = np.maximum(z - radius, 0.0), np.minimum(z + radius, 1.0)
    inside = np.clip(z, low + 1e-9, high - 1e-9)
    found = least_squares(
        lambda point: components.mean(point[None])[0], inside, components.slope, bounds=(low, high), max_nfev=60, x_scale=0.1
    )
    return found.x, float(2.0 * found.cost)


def at(evidence: Evidence, z: FloatArray) -> int:
    """The row of the run at z."""
    return int(np.argmin(np.abs(evidence.z - z).max(1)))


def trials(evidence: Evidence, incumbents: list[Incumbent], components: Components | None) -> list[Trial]:
    """Up to two points to run next; none where the best point is settled."""
    order = sorted(range(len(incumbents)), key=lambda i: evidence.misfit[at(evidence, incumbents[i].z)])
    best = incumbents[order[0]]
    row = at(evidence, best.z)
    now = float(evidence.misfit[row])
    own: list[Trial] = []
    step, expected = levenberg(evidence.residual[row], evidence.jacobian[row], best.z, best.damping, best.radius)
    own.append(Trial(best.z + step, expected, order[0]))
    if components is not None:
        z, misfit = lowest(components, best.z, best.radius)
        own.append(Trial(z, now - misfit, order[0]))
        most = max(now - misfit, expected)
        if (most < SETTLED and best.radius > 0.05) or (most < _UNMET and best.idle >= _IDLE):
            return []
        if not _same(own[0].z, z):
            return own
    for i in order[1:]:
        other = incumbents[i]
        if _same(other.z, best.z):
            continue  # it has come to the best one's place
        row = at(evidence, other.z)
        step, expected = levenberg(evidence.residual[row], evidence.jacobian[row], other.z, other.damping, other.radius)
        if not _same(other.z + step, own[-1].z):
            return [own[-1], Trial(other.z + step, expected, i)]
    return own[-1:]


def _same(z: FloatArray, other: FloatArray) -> bool:
    return bool(np.abs(z - other).max() <= _SAME)


def advance(evidence: Evidence, incumbents: list[Incumbent], tried: list[Trial]) -> list[Incumbent]:
    """The incumbents after the trials were run: a start goes to its best trial, or shortens its steps."""
    after = list(incumbents)
    for start in dict.fromkeys(trial.start for trial in tried):
        incumbent = incumbents[start]
        now = float(evidence.misfit[at(evidence, incumbent.z)])
        best, gain, expected = None, 0.0, 0.0
        for trial in tried:
            row = at(evidence, trial.z)
            ran = np.abs(evidence.z[row] - trial.z).max() < 1e-9 and evidence.told[row]
            if trial.start == start and ran and now - evidence.misfit[row] > gain:
                best, gain, expected = trial, now - float(evidence.misfit[row]), trial.expected
        if best is None:
            after[start] = replace(
                incumbent,
                damping=incumbent.damping * incumbent.growth,
                growth=2.0 * incumbent.growth,
                radius=0.5 * incumbent.radius,
                idle=incumbent.idle + 1,
            )
            continue
        ratio = gain / max(expected, 1e-12)
        damping = incumbent.damping * max(1.0 / 3.0, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3)
        radius = min(_RADIUS, incumbent.radius * (1.5 if ratio > 0.5 else 0.7 if ratio < 0.1 else 1.0))
        after[start] = Incumbent(best.z, damping, 2.0, radius, 0 if gain > SETTLED else incumbent.idle + 1)
    return after


def kept(evidence: Evidence, incumbents: list[Incumbent]) -> list[Incumbent]:
    """The incumbents, those whose run is no longer in the evidence moved to the nearest that is."""
    told = np.flatnonzero(evidence.told)
    nearest = [told[int(np.argmin(np.abs(evidence.z[told] - i.z).max(1)))] for i in incumbents]
    return [replace(i, z=evidence.z[row]) for i, row in zip(incumbents, nearest, strict=True)]


def emulate(evidence: Evidence, earlier: Components | None) -> Components | None:
    """The emulator of all runs; None where they are still too few."""
    if evidence.told.sum() < 3:
        return None
    return corrected.emulate(evidence, earlier)
