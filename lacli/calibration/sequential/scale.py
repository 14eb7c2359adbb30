"""Inputs as the search sees them: each from 0 to 1 over its range, wide positive ones by their logarithm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray
from lacli.inference.box import Box

_RATIO = 20.0  # a range wider than this is searched along its logarithm (stiffnesses; pressures are not): one step is one factor


@dataclass(frozen=True)
class Scale:
    """z (m, d) in [0, 1] for x (m, d) in the box; ``logged`` (d,): inputs taken as logarithms."""

    box: Box
    logged: BoolArray

    @classmethod
    def of(cls, box: Box) -> Scale:
        """Of a box."""
        return cls(box, (box.lower > 0) & (box.upper > _RATIO * np.maximum(box.lower, 1e-300)))

    def to_z(self, x: FloatArray) -> FloatArray:
        """(m, d) of points of the box."""
        low, high = self._ends()
        return np.asarray((self._log(x) - low) / (high - low))

    def to_x(self, z: FloatArray) -> FloatArray:
        """Points of the box (m, d); to its ends exactly."""
        low, high = self._ends()
        t = low + z * (high - low)
        x = np.where(self.logged, np.exp(np.where(self.logged, t, 0.0)), t)
        return np.asarray(np.where(z <= 0.0, self.box.lower, np.where(z >= 1.0, self.box.upper, x)))

    def slope(self, x: FloatArray) -> FloatArray:
        """dx/dz (m, d)."""
        low, high = self._ends()
        return np.asarray((high - low) * np.where(self.logged, x, 1.0))

    def _log(self, x: FloatArray) -> FloatArray:
        return np.asarray(np.where(self.logged, np.log(np.where(self.logged, x, 1.0)), x))

    def _ends(self) -> tuple[FloatArray, FloatArray]:
        return self._log(self.box.lower), self._log(self.box.upper)
