"""Runs whose values contradict their derivatives: states on several branches, which no smooth emulator can follow.

Where the end-diastolic wall has unstable modes, the frames after it may be reached on either side: runs at all but the same
parameters then differ by millimetres in those frames, and agree again at end-systole. Between two runs a smooth output changes by
the mean of its slopes at both, but for a third-order rest; where the rest is more than what the slopes' own change allows,
something else has happened between them. A run that sought its end-systole twice says itself whether there are two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray
from lacli.calibration.sequential.evidence import Evidence, factor
from lacli.contracts.features import parse
from lacli.contracts.targets import Targets

_NEAR = 0.15  # widths of the box: runs farther apart than this, in any input, are not compared
_REST, _OF_BEND = (
    2.0,
    0.5,
)  # standard deviations of a target, and share of what the change of the slopes makes: a larger rest jumps
APART = 1.0  # standard deviations of a target: a run whose two equilibria differ more is no point of a smooth function
_FEW = 0.1  # a share of the runs that lie elsewhere in a frame and are left out themselves; of more, the frame is


@dataclass(frozen=True)
class Branches:
    """times: frames of several states, whose targets no run tells; strays (n,): runs that lie elsewhere in what is left, or that
    have two equilibria; torn (n,): the latter, the best run among them, which is no stray; jumped: frames that are not left out,
    in which some runs lie elsewhere."""

    times: tuple[float, ...]
    strays: BoolArray
    torn: BoolArray
    jumped: tuple[float, ...] = ()


def look(evidence: Evidence, targets: Targets, order: FloatArray | None = None) -> Branches:
    """Compare the runs in each frame: those left out are as few as leave no contradiction, and never the best run.

    order (n,): the lowest is the best run, and of two that could be left out the higher one is; the misfit if not given.

    Runs that say of themselves that they have two equilibria are left out first, but for the best: the answer is about it.
    """
    order = evidence.misfit if order is None else order
    left: list[float] = []
    jumped: list[float] = []
    torn = np.asarray((evidence.spread > APART).any(1))
    strays = torn.copy()
    if evidence.told.any():
        strays[int(np.argmin(np.where(evidence.told, order, np.inf)))] = False
    whole = evidence.told & ~strays
    for time, columns in _frames(targets).items():
        compared, off = _elsewhere(evidence, targets, columns, whole, order)
        if time is not None and off.sum() > max(1.0, _FEW * compared):
            left.append(time)
        else:
            strays |= off
            jumped += [time] if time is not None and off.any() else []
    return Branches(tuple(left), strays, torn, tuple(jumped))


def without(targets: Targets, times: tuple[float, ...]) -> Targets:
    """The targets but for those of some frames."""
    return targets.select([name for name in targets.names if _time(name) not in times])


def _time(name: str) -> float | None:
    """The frame that a target belongs to; None of one at end-systole, or of no feature."""
    try:
        return parse(name)[1] or None
    except ValueError:
        return None


def _frames(targets: Targets) -> dict[float | None, list[int]]:
    found: dict[float | None, list[int]] = {}
    for j, name in enumerate(targets.names):
        found.setdefault(_time(name), []).append(j)
    return found


def _elsewhere(
    evidence: Evidence, targets: Targets, columns: list[int], compared: BoolArray, order: FloatArray
) -> tuple[int, BoolArray]:
    """Of the outputs ``columns``: how many of the runs ``compared`` (n,) have another near them, and which are elsewhere (n,)."""
    own = (factor(targets) / targets.sd[:, None])[columns]  # whitened -> each target in its own standard deviations
    rows = np.flatnonzero(compared)
    p = evidence.targets
    z, value = evidence.z[rows], evidence.residual[rows, :p] @ own.T
    slope = np.einsum("jp,npd->njd", own, evidence.jacobian[rows, :p])
    jump, near = np.zeros((len(rows), len(rows)), bool), np.zeros((len(rows), len(rows)), bool)
    for i in range(len(rows)):
        others = i + 1 + np.flatnonzero(np.abs(z[i + 1 :] - z[i]).max(1) < _NEAR)
        step = z[others] - z[i]
        rest = np.abs(value[others] - value[i] - 0.5 * np.einsum("mjd,md->mj", slope[others] + slope[i], step)).max(1)
        bend = np.abs(np.einsum("mjd,md->mj", slope[others] - slope[i], step)).max(1)
        jump[i, others] = (rest > _REST) & (rest > _OF_BEND * bend)
        near[i, others] = True
    jump, near = jump | jump.T, near | near.T
    order = order[rows]
    off = np.zeros(len(evidence.z), bool)
    while (count := jump.sum(1)).any():
        # most contradictions first, of the same number the worse run; the best run contradicts nobody
        count[order == order.min()] = 0
        worst = int(np.lexsort((order, count))[-1])
        off[rows[worst]] = True
        jump[worst] = jump[:, worst] = False
    return int(near.any(1).sum()), off
