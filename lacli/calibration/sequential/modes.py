"""Other modes: the emulator of all runs over the whole box, asked what posterior probability may lie away from the modes known.

At a point the likelihood is averaged over what the emulator, its standard deviations doubled, leaves possible: Gaussian with the
measurement's and the emulator's variance. A valley that the emulated misfit falls to, away from the known modes, has the
probability of its Gaussian approximation; the rest of the box that of points spread over it. History matching's verdict (what is
not ruled out at three standard deviations) is told beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logsumexp
from scipy.stats import chi2, qmc

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.descent import lowest
from lacli.calibration.sequential.emulator import Components
from lacli.calibration.sequential.laplace import Laplace

_POINTS = 1 << 13
_DOUBLED = 4.0  # of the emulator's variance
_FAVOUR = 3.0  # emulator's standard deviations
NEAR = 6.0  # Mahalanobis, from a mode whose runs are known
_LEVEL = 1e-4  # of a chi-square in the inputs: of this little posterior mass a point may be the boundary
_DESCENTS = 48
APART = 0.1  # widths of the box between two valleys
_CONTENDER = 1e-3  # posterior probability from which a valley is looked at with a run
_RULED_OUT = 0.01  # of the box: as little left open is ruled out
_ASUNDER, _DOUBTFUL = 0.3, 12  # widths of the box between doubtful points, and how many of them
_NOTHING = 0.01  # as improbable, other modes are no matter


@dataclass(frozen=True)
class Sweep:
    """Of ``points`` of the box, low-discrepancy: ``elsewhere``, the posterior probability that may lie away from the known modes;
    open_: the share of the box that history matching does not rule out there; candidates (k, d): valleys elsewhere that are not
    negligible, the most probable first; doubtful (k, d): points that are not ruled out, far from each other."""

    points: int
    elsewhere: float
    open_: float
    candidates: FloatArray
    doubtful: FloatArray

    @property
    def settled(self) -> bool:
        """Whether nothing is left to look at."""
        return not len(self.candidates) and (self.open_ < _RULED_OUT or not len(self.doubtful))

    def words(self) -> str:
        """How surely there is no other mode."""
        share = f"{self.open_:.2%} of the box" if self.open_ > 0 else f"none of {self.points} points of the box"
        matched = f"history matching at {_FAVOUR:g} standard deviations leaves {share} open away from the answer"
        if self.elsewhere > _NOTHING:
            return (
                f"another mode may hold {self.elsewhere:.1%} of the posterior's probability, by the emulator of all runs over "
                f"the box ({matched}). More runs (--max-runs) would tell."
            )
        return (
            f"no other mode: less than {max(self.elsewhere, 1e-4):.0e} of the posterior's probability lies elsewhere, by the "
            f"emulator of all runs over the box with its standard deviations doubled ({matched})."
        )


def sweep(components: Components, known: list[Laplace], best: float, seed: int) -> Sweep:
    """Weigh the box; ``best``: chi^2 of the best run, ``known``: the modes found."""
    d = components.z.shape[1]
    components = components.reduced()
    z = qmc.Sobol(d, rng=np.random.default_rng(seed)).random(_POINTS)
    optimistic, likelihood = _judged(components, z)
    away = np.min([mode.distance(z) for mode in known], axis=0) >= NEAR
    open_ = away & (optimistic < best + float(chi2.isf(_LEVEL, d)))
    # log of the known modes' integral, and of the points' mean
    whole = -0.5 * best + max(mode.log_volume for mode in known)
    beside = float(logsumexp(likelihood[away]) - np.log(len(z))) if away.any() else -np.inf
    order = np.flatnonzero(away)[np.argsort(-likelihood[away])]
    found: list[tuple[float, FloatArray]] = []
    for i in order[:_DESCENTS]:
        end = same_valley(components, known, z[i])
        if end is None or any(np.abs(end - other).max() < APART for _, other in found):
            continue
        mean, slope = components.mean(end[None])[0], components.slope(end)
        spread = 1.0 + _DOUBLED * components.predict(end[None])[1][0]
        there = Laplace.at(end, mean / np.sqrt(spread), slope / np.sqrt(spread)[:, None])
        found.append((float(_judged(components, end[None])[1][0]) + there.log_volume, end))
    found.sort(key=lambda valley: -valley[0])
    other = float(logsumexp([beside, *(mass for mass, _ in found)]))
    odds = [valley for valley in found if valley[0] - whole > np.log(_CONTENDER)]
    elsewhere = float(expit(other - whole))
    doubtful: list[FloatArray] = []
    for i in np.flatnonzero(open_)[np.argsort(optimistic[open_])]:
        if len(doubtful) < _DOUBTFUL and all(np.abs(z[i] - other).max() > _ASUNDER for other in doubtful):
            doubtful.append(z[i])
    return Sweep(
        _POINTS, elsewhere, float(open_.mean()), np.array([end for _, end in odds]).reshape(-1, d),
        np.array(doubtful).reshape(-1, d),
    )  # fmt: skip


def same_valley(components: Components, known: list[Laplace], z: FloatArray) -> FloatArray | None:
    """None where the emulated misfit falls from z (d,) to a known mode; else the lowest point it falls to."""
    end, _ = lowest(components, z)
    return None if min(float(mode.distance(end[None])[0]) for mode in known) < NEAR else end


def _judged(components: Components, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """chi^2 with the emulator's errors in the point's favour, and the log likelihood averaged over them; both (m,).

    In favour, of two bounds the sharper: all components at once, each by so many standard deviations; and so many of chi^2's
    own, whose mean and variance are sum(c^2 + V) and sum(4 c^2 V + 2 V^2): many components do not all err in favour.
    """
    mean, variance = components.predict(z)
    each = (np.maximum(np.abs(mean) - _FAVOUR * np.sqrt(variance), 0.0) ** 2).sum(1)
    size, spread = (mean**2 + variance).sum(1), (4.0 * mean**2 * variance + 2.0 * variance**2).sum(1)
    wide = 1.0 + _DOUBLED * variance
    return np.maximum(each, size - _FAVOUR * np.sqrt(spread)), -0.5 * (mean**2 / wide + np.log(wide)).sum(1)
