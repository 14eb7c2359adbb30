"""Where to run the simulator: space-filling designs of the parameter box, and choice of points from a sample."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from lacli.base.arrays import FloatArray
from lacli.base.errors import UsageError
from lacli.inference.box import Box

Method = Literal["sobol", "lhs", "maximin"]
METHODS: tuple[Method, ...] = ("sobol", "lhs", "maximin")

# candidates for each point that a maximin design or a steered design chooses
_CANDIDATES = 64


def design(
    box: Box, count: int, method: Method = "sobol", seed: int = 0, accept: Callable[[FloatArray], NDArray[np.bool_]] | None = None
) -> FloatArray:
    """A design (count, d) of points that keep the box's orderings and, if given, that ``accept`` allows.

    sobol: scrambled Sobol' sequence (points that are not allowed are skipped); lhs: Latin hypercube (of the box; where
    points are not allowed, of as many more points as it takes); maximin: greedily farthest from one another.
    Raises UsageError if hardly any point is allowed.
    """
    if count < 1:
        raise UsageError(f"design: {count} runs asked for; at least 1.")

    def allowed(u: FloatArray) -> FloatArray:
        x = box.from_unit(u)
        keep = box.contains(x)
        if accept is not None:
            keep &= accept(x)
        return x[keep]

    if method == "lhs":
        size = count
        for attempt in range(20):
            x = allowed(qmc.LatinHypercube(box.d, rng=np.random.default_rng([seed, attempt])).random(size))
            if len(x) >= count:
                return x[:count]
            size = int(np.ceil(size * max(1.1, min(8.0, 1.05 * count / max(1, len(x))))))
        raise UsageError(_nothing(count))
    pool = _sobol(box.d, allowed, count if method == "sobol" else _CANDIDATES * count, seed)
    if len(pool) < count:
        raise UsageError(_nothing(count))
    return pool if method == "sobol" else pool[farthest(box.to_unit(pool), count)]


def _nothing(count: int) -> str:
    return f"design: fewer than {count} points of the box keep the orderings and avoid the failures. Widen the box."


def _sobol(d: int, allowed: Callable[[FloatArray], FloatArray], count: int, seed: int) -> FloatArray:
    engine = qmc.Sobol(d, scramble=True, rng=np.random.default_rng(seed))
    found = [allowed(engine.random(size := 1 << max(0, count - 1).bit_length()))]
    for _ in range(12):
        if sum(map(len, found)) >= count:
            break
        found.append(allowed(engine.random(size)))
        size *= 2  # a Sobol' sequence keeps its balance at powers of two
    return np.vstack(found)[:count]


def farthest(u: FloatArray, count: int, existing: FloatArray | None = None) -> NDArray[np.int64]:
    """Numbers (count,) of the points of u (m, d) chosen one by one, each farthest from those chosen and from ``existing``.

    With no existing points the first chosen is the one nearest the mean.
    """
    count = min(count, len(u))
    if existing is not None and len(existing):
        distance = np.full(len(u), np.inf)
        for point in existing:
            np.minimum(distance, ((u - point) ** 2).sum(1), out=distance)
        first = int(distance.argmax())
    else:
        distance = np.full(len(u), np.inf)
        first = int(((u - u.mean(0)) ** 2).sum(1).argmin())
    chosen = [first]
    for _ in range(count - 1):
        np.minimum(distance, ((u - u[chosen[-1]]) ** 2).sum(1), out=distance)
        chosen.append(int(distance.argmax()))
    return np.array(chosen, np.int64)
