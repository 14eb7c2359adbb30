"""How well the mitral annulus is tracked. Simulations hold it where tracking says: what registration misses of it is undone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.motion.errors.shrinkage import share_of


@dataclass(frozen=True)
class AnnulusError:
    """Of the annulus's displacement from end-diastole: ``share`` of it that is found too much (negative: too little), the sd of
    that share, and ``noise_mm``, the root mean square length of a point's error beside it."""

    share: float
    sd: float
    noise_mm: float

    def undone(self, positions: FloatArray) -> FloatArray:
        """Positions (f, n, 3) mm, the first at end-diastole, as they would be without the share."""
        return np.asarray(positions[0] + (positions - positions[0]) / (1.0 + self.share))

    def at(self, displacement: FloatArray, widened: float = 1.0) -> float:
        """Root mean square error (mm) of points that have moved by so much (n, 3) mm, the share undone; ``widened``: the factor
        of the noise where a drift was corrected."""
        moved = self.sd * np.sqrt((displacement**2).sum(axis=1).mean())
        return float(np.hypot(widened * self.noise_mm, moved) / (1.0 + self.share))


def annulus_error(errors: Sequence[FloatArray], displacements: Sequence[FloatArray]) -> AnnulusError:
    """From errors and displacements, each (n, 3) mm of the annulus's points, in several known motions.

    One share for all directions: the annulus goes along one axis for the most part, and what it does across is too little to tell
    another. As in targets it is clipped where it is no shrinkage.
    """
    e, u = (np.array([one.ravel() for one in of]) for of in (errors, displacements))
    share, sd = share_of(e, u)
    left = e - share * u
    # one motion is given for the share
    square = float((left**2).mean()) * 3.0 * len(e) / max(len(e) - 1, 1)
    return AnnulusError(share, sd, float(np.sqrt(square)))
