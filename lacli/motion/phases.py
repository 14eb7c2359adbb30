"""Phases of the atrial cycle from its volume: reservoir to end-systole (ES), conduit, diastasis where there is one, booster."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from lacli.base.arrays import FloatArray

# a stretch is a plateau while the volume falls slower than this share of the mean fall from ES to ED
_SLOW = 0.35
_SHORTEST = 0.05


@dataclass(frozen=True)
class Phases:
    """Times as fractions of the cycle. es: peak of the volume; conduit_end, booster_start: ends of diastasis, equal where there
    is none; es_gap: from ES to the nearest frame. volume_ml at ES; ed_volume_ml."""

    es: float
    es_volume_ml: float
    es_gap: float
    conduit_end: float
    booster_start: float
    ed_volume_ml: float

    @property
    def diastasis(self) -> bool:
        """Whether the volume rests between conduit and booster."""
        return self.booster_start > self.conduit_end

    def name(self, time: float) -> str:
        """Phase at a time: ed, reservoir (ES included), conduit, diastasis or booster."""
        if time in (0.0, 1.0):
            return "ed"
        if time <= self.es:
            return "reservoir"
        if time <= self.conduit_end:
            return "conduit"
        return "diastasis" if time < self.booster_start else "booster"


def volume_spline(times: FloatArray, volume: FloatArray) -> CubicSpline:
    """Periodic cubic spline through the frames' volumes (f,), mL; times (f,) from 0, below 1."""
    return CubicSpline(np.append(times, 1.0), np.append(volume, volume[0]), bc_type="periodic")


def phases_of(times: FloatArray, volume: FloatArray) -> Phases:
    """Phases from the volumes (f,) mL at times (f,), interpolated cubically.

    Conduit ends where the fall slows below a third of its mean; booster starts where it exceeds it again. Where the volume never
    rests (a fast heart), both are the inflection: the slowest fall between ES and ED.
    """
    spline = volume_spline(times, volume)
    fine = np.linspace(0.0, 1.0, 2001)
    value = spline(fine)
    top = int(np.argmax(value))
    roots = spline.derivative().roots(extrapolate=False)
    near = roots[np.abs(roots - fine[top]) < 1e-3]
    es = float(near[np.argmax(spline(near))]) if len(near) else float(fine[top])
    gap = float(np.min(np.abs(np.append(times, 1.0) - es)))
    after = fine[fine > es]
    rate = -spline(after, 1)
    mean = (float(spline(es)) - float(volume[0])) / max(1.0 - es, 1e-9)
    conduit_end = booster_start = 1.0
    if len(after) > 10 and mean > 0:
        # the fall starts and ends slowly at ES itself: look between the first and the last time it is fast
        fast = np.flatnonzero(rate >= mean)
        if len(fast):
            span = slice(int(fast[0]), int(fast[-1]) + 1)
            slow = np.flatnonzero(rate[span] < _SLOW * mean) + span.start
            if len(slow) and after[slow[-1]] - after[slow[0]] >= _SHORTEST:
                conduit_end, booster_start = float(after[slow[0]]), float(after[slow[-1]])
            else:
                conduit_end = booster_start = float(after[span][int(np.argmin(rate[span]))])
    return Phases(es, float(spline(es)), gap, conduit_end, booster_start, float(volume[0]))
