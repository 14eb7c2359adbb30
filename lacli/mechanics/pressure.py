"""The pressure in the cavity over the cycle, as a scene gives it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.contracts.motion import Motion
from lacli.contracts.sections import MMHG_KPA, Loads


@dataclass(frozen=True)
class Pressure:
    """The loads' pressure; ``es``: time of end-systole, as a share of the cycle."""

    loads: Loads
    es: float

    @property
    def at_es_kpa(self) -> float:
        """At end-systole."""
        return self.kpa(self.es)

    def shares(self, time: float) -> tuple[float, float]:
        """Derivatives of ``kpa`` along EDP and ESP; of a scene's own transient, EDP is the first value alone."""
        given = self.loads.transient_mmhg
        if given is not None:
            times = [time for time, _ in given]
            return float(np.interp(time, times, [1.0] + [0.0] * (len(times) - 1))), 0.0
        fallen = self.es + 0.5 * (1.0 - self.es)
        risen = float(np.interp(time, [0.0, self.es, fallen, 1.0], [0.0, 1.0, 0.0, 0.0]))
        return 1.0 - risen, risen

    def kpa(self, time: float) -> float:
        """Idealised transient: EDP -> ESP linearly up to end-systole, back over half of what is left, then constant; or the
        scene's own ``transient_mmhg``, scaled by nothing."""
        given = self.loads.transient_mmhg
        if given is not None:
            times, values = np.array(given).T
            return float(np.interp(time, times, values)) * MMHG_KPA
        by_edp, by_esp = self.shares(time)
        return by_edp * self.loads.edp_kpa + by_esp * self.loads.esp_kpa


def pressure_of(loads: Loads, es_time: float, motion: Motion | None) -> Pressure:
    """A scene's pressure; end-systole is the motion's where that is known, else the scene's, a share of the cycle."""
    return Pressure(loads, motion.es_time if motion is not None else es_time)
