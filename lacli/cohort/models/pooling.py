"""Regions that vary about a common level: between one stiffness for all and one for each without a word on the others.

A uniform prior on the box for every region says that regions may differ by a factor of eight as well as by a tenth; evidence
charges a model for all that it might have said, so that moderate differences are never claimed. Here the logarithms of the
regions' values are normal about that of a common level, cut off at the box, with a standard deviation that is itself not known:
0 to ``WIDEST``, uniform. At 0 it is the global model, whose one number has the same prior as the level (partial pooling; Gelman
2006).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import ndtr, ndtri

from lacli.base.arrays import FloatArray
from lacli.inference.box import Box

WIDEST = 1.0  # sd of the logarithms between regions at most: a factor of 2.7
_LEAST = 1e-6


def pooled(
    box: Box, groups: Sequence[Sequence[str]], shared: Sequence[tuple[float, float]]
) -> tuple[Box, Callable[[FloatArray], FloatArray]]:
    """The box of what is free, and the map of its points (m, k) to those of ``box`` (m, d), in its units.

    groups: inputs that vary about one level; shared: the level's range by group. Free are the other inputs, of each group the
    level, the spread of the logarithms, and of each of its inputs the place in its distribution, 0 to 1.
    """
    apart = {name for group in groups for name in group}
    names, low, high = list(box.names), dict(zip(box.names, box.lower, strict=True)), dict(zip(box.names, box.upper, strict=True))
    free = [name for name in names if name not in apart]
    rows = [(name, float(low[name]), float(high[name])) for name in free]
    for group, (least, most) in zip(groups, shared, strict=True):
        rows += [(f"level.{group[0]}", least, most), (f"spread.{group[0]}", 0.0, WIDEST)]
        rows += [(f"place.{name}", 0.0, 1.0) for name in group]
    ordered = tuple((free.index(names[i]), free.index(names[j])) for i, j in box.ordered if names[i] in free and names[j] in free)
    wide = Box(tuple(r[0] for r in rows), np.array([r[1] for r in rows]), np.array([r[2] for r in rows]), ordered)

    def lift(x: FloatArray) -> FloatArray:
        found = np.empty((len(x), len(names)))
        found[:, [names.index(name) for name in free]] = x[:, : len(free)]
        at = len(free)
        for group in groups:
            level, spread = np.log(x[:, at]), np.maximum(x[:, at + 1], _LEAST)
            for k, name in enumerate(group):
                ends = [(np.log(end[name]) - level) / spread for end in (low, high)]
                below, above = ndtr(ends[0]), ndtr(ends[1])
                value = level + spread * ndtri(below + x[:, at + 2 + k] * (above - below))
                # the places 0 and 1 are the box's ends, which logarithm and exponential may miss by a digit
                found[:, names.index(name)] = np.clip(np.exp(value), low[name], high[name])
            at += 2 + len(group)
        return found

    return wide, lift
