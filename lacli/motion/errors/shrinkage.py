"""By how much registration finds too little motion: measured by known motions, and undone.

A regular field is stiffer than the heart: it misses a share of what moves, about the same in each frame and region of one kind of
feature (2 to 3 % at voxels of 1 mm). That is no noise, and is not left in the targets as if it were.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.features import kind_of

# a known motion tells a true one's shrinkage to about this share of it (docs/methods.md)
_TOLD = 0.5
_MOST = 0.15
# the volume is what the wall moves along its normal, the whole's displacement a mean of the regions': one shrinkage, one error
_ONE = {"volume": "n", "d_global": "d"}


def group_of(key: str) -> str:
    """What has one error of shrinkage with it, as a name."""
    kind = kind_of(key)[0]
    return _ONE.get(kind, kind)


@dataclass(frozen=True)
class Shrinkage:
    """By key (k,): ``share`` of a change that is found too much (negative: too little), and its sd; ``regional``: the sd by which
    a region's own share differs from that of its kind, in all frames alike."""

    keys: tuple[str, ...]
    share: FloatArray
    sd: FloatArray
    regional: FloatArray | float = 0.0

    def undoing(self, keys: Sequence[str]) -> FloatArray:
        """(p,): what a change of each key, and its error, is multiplied with."""
        share = dict(zip(self.keys, self.share.tolist(), strict=True))
        return np.array([1.0 / (1.0 + share.get(key, 0.0)) for key in keys])

    def undone(self, row: Mapping[str, float], ed: Mapping[str, float]) -> dict[str, float]:
        """Features as they would be without it; ``ed``: those at end-diastole, from which changes count."""
        share = dict(zip(self.keys, self.share.tolist(), strict=True))
        return {key: ed[key] + (value - ed[key]) / (1.0 + share.get(key, 0.0)) for key, value in row.items()}

    def covariance(self, keys: Sequence[str], changes: FloatArray) -> FloatArray:
        """(p, p) of targets of these keys whose changes (p,) were corrected: all that one group's share moves together, and each
        feature in all frames what its region's own share does."""
        total = np.zeros((len(keys),) * 2)
        own = np.broadcast_to(self.regional, (len(self.keys),))
        for size, names in ((self.sd, [group_of(key) for key in keys]), (own, list(keys))):
            sd = dict(zip(self.keys, size.tolist(), strict=True))
            moved = np.array([sd.get(key, 0.0) for key in keys]) * changes * self.undoing(keys)
            name = np.array(names)
            total += np.where(name[:, None] == name[None], np.outer(moved, moved), 0.0)
        return total


def shrinkage_of(keys: Sequence[str], errors: FloatArray, changes: FloatArray) -> Shrinkage:
    """From errors and changes (m, k) of features in known motions: by kind, the slope of the errors on the changes.

    Its sd has the slope's own, motions being independent, and half of the slope, since known motions are easier than true ones.
    Regions have slopes of their own: by how much more these differ than their errors make them is ``regional``.
    """
    kinds = np.array([kind_of(key)[0] for key in keys])
    share, sd, regional = np.zeros(len(keys)), np.zeros(len(keys)), np.zeros(len(keys))
    for kind in set(kinds.tolist()):
        here = kinds == kind
        share[here], sd[here] = share_of(errors[:, here], changes[:, here])
        regional[here] = _apart(errors[:, here], changes[:, here])
    return Shrinkage(tuple(keys), share, sd, regional)


def _apart(errors: FloatArray, changes: FloatArray) -> float:
    """The sd between regions of the slopes of errors on changes (m, r), less what the slopes' own errors make of it."""
    seen = [k for k in range(changes.shape[1]) if changes[:, k].any()]
    if len(seen) < 2:
        return 0.0
    slope, variance = np.array([slope_of(errors[:, [k]], changes[:, [k]]) for k in seen]).T
    # a region that hardly moves tells little of its share, and little hangs on it
    weight = (changes[:, seen] ** 2).sum(axis=0)
    weight = weight / weight.sum()
    middle = float(weight @ slope)
    excess = float(weight @ (slope - middle) ** 2) / max(1.0 - float(weight @ weight), 1e-9) - float(weight @ variance)
    return float(min(np.sqrt(max(excess, 0.0)), _MOST))


def share_of(errors: FloatArray, changes: FloatArray) -> tuple[float, float]:
    """The share of changes (m, r) in m known motions that is found too much, within what shrinkage can be, and its sd."""
    slope, variance = slope_of(errors, changes)
    kept = float(np.clip(slope, -_MOST, _MOST))
    return kept, float(np.sqrt(variance + (_TOLD * slope) ** 2 + (slope - kept) ** 2))


def slope_of(errors: FloatArray, changes: FloatArray) -> tuple[float, float]:
    """Slope of errors on changes (m, r) of one kind, and its variance: motions are independent, features of one are not.

    Few motions: what is left has given one of them for the slope (as CR1 of Cameron, Miller 2015, J Hum Resour 50:317).
    """
    size, m = float((changes**2).sum()), len(errors)
    if size <= 0.0:
        return 0.0, 0.0
    slope = float((errors * changes).sum()) / size
    by_motion = ((errors - slope * changes) * changes).sum(axis=1)
    return slope, float((by_motion**2).sum()) / size**2 * m / max(m - 1, 1)


def spread(key: str, sd: float | FloatArray, change: FloatArray, stated: Mapping[str, Mapping[str, float]] | None) -> FloatArray:
    """Standard deviation (in the feature's unit) where it has changed by so much since end-diastole; ``stated``: the shrinkage by
    kind, as in tracking.json, or None. The change is the corrected one."""
    part = (stated or {}).get(kind_of(key)[0], {"share": 0.0, "sd": 0.0})
    return np.asarray(
        np.hypot(sd, np.hypot(part["sd"], part.get("regional", 0.0)) * np.asarray(change, dtype=float)) / (1.0 + part["share"])
    )
