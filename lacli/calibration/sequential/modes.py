"""Other modes: a wave of history matching over the whole box, with the emulator of all runs.

A point is ruled out where even three standard deviations of the emulator in its favour leave a misfit so much larger than the
best run's that its posterior density is nothing beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, qmc

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.descent import lowest
from lacli.calibration.sequential.emulator import Components
from lacli.calibration.sequential.laplace import Laplace

_POINTS = 1 << 14
_FAVOUR = 3.0  # emulator's standard deviations
NEAR = 6.0  # Mahalanobis, from a mode whose runs are known
_LEVEL = 1e-4  # of a chi-square in the inputs: of this little posterior mass a point may be the boundary
_DESCENTS = 48
_SURE = 20.0  # of chi^2: between what the emulator expects and the most favourable, where it counts as known


@dataclass(frozen=True)
class Sweep:
    """Of ``points`` of the box, low-discrepancy: the share that is not ruled out, of the known modes and elsewhere; candidates
    (k, d): places elsewhere whose misfit may be lowest, best first."""

    points: int
    near: float
    elsewhere: float
    candidates: FloatArray

    def words(self) -> str:
        """How surely there is no other mode."""
        if self.elsewhere > 0:
            return (
                f"{self.elsewhere:.2%} of the box, away from the answer, is not ruled out: another mode may be there. "
                "More runs (--max-runs) would tell."
            )
        return (
            f"no other mode: of {self.points} points spread over the box, none away from the answer can be as probable, with "
            f"{_FAVOUR:g} standard deviations of the emulator in its favour. A mode that fills more than {3.0 / self.points:.1g} "
            "of the box would have been met with 95 % probability, if the emulator's errors are what held-out runs say."
        )


def sweep(components: Components, known: list[Laplace], best: float, seed: int) -> Sweep:
    """Rule out; ``best``: chi^2 of the best run, ``known``: the modes found."""
    d = components.z.shape[1]
    components = components.reduced()
    z = qmc.Sobol(d, rng=np.random.default_rng(seed)).random(_POINTS)
    cutoff = best + float(chi2.isf(_LEVEL, d))
    optimistic, expected = _misfits(components, z)
    open_ = optimistic < cutoff
    near = np.min([mode.distance(z) for mode in known], axis=0) < NEAR
    away = np.flatnonzero(open_ & ~near)
    order = away[np.argsort(expected[away])]
    tested = order[:: max(1, len(order) // _DESCENTS)][:_DESCENTS]
    found: list[FloatArray] = []
    doubtful = 0
    for i in tested:
        end = same_valley(components, known, z[i])
        # the tail of a known mode, where the emulator knows what it says
        if end is None and expected[i] - optimistic[i] < _SURE:
            continue
        doubtful += 1
        point = z[i] if end is None or _misfits(components, end[None])[0][0] > cutoff else end
        if all(np.abs(point - other).max() > 0.1 for other in found):
            found.append(point)
    found.sort(key=lambda point: float(_misfits(components, point[None])[1][0]))
    elsewhere = len(away) / len(z) * doubtful / max(1, len(tested))
    return Sweep(_POINTS, float(open_.mean()) - elsewhere, elsewhere, np.array(found).reshape(-1, d))


def same_valley(components: Components, known: list[Laplace], z: FloatArray) -> FloatArray | None:
    """None where the emulated misfit falls from z (d,) to a known mode; else the lowest point it falls to."""
    end, _ = lowest(components, z)
    return None if min(float(mode.distance(end[None])[0]) for mode in known) < NEAR else end


def _misfits(components: Components, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """chi^2 with the emulator's errors in the point's favour, and chi^2 with them added to the measurement's; both (m,).

    Of two bounds the sharper: all components at once in favour, each by so many standard deviations; and so many of chi^2's own,
    whose mean and variance are sum(c^2 + V) and sum(4 c^2 V + 2 V^2): where many components err, they do not err alike.
    """
    mean, variance = components.predict(z)
    each = (np.maximum(np.abs(mean) - _FAVOUR * np.sqrt(variance), 0.0) ** 2).sum(1)
    size, spread = (mean**2 + variance).sum(1), (4.0 * mean**2 * variance + 2.0 * variance**2).sum(1)
    return np.maximum(each, size - _FAVOUR * np.sqrt(spread)), (mean**2 / (1.0 + variance)).sum(1)
