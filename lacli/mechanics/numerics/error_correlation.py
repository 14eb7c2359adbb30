"""How discretisation errors go together: between times, regions and kinds of features, as they did on anatomies measured.

Coarse cells are too stiff everywhere at once: their errors are no independent noise, and many targets do not average them out. An
error counts positive where it makes the feature larger in size. Correlations are means about zero (a common bias is what must
not be missed) of the errors over the stated ones, by the cells' order, the two kinds, whether the regions and the times are the
same; ``error_correlation.json``, written by ``benchmarks/errors.py --times --write``.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.documents import read_json
from lacli.base.errors import InputError
from lacli.contracts.features import family, kind_of
from lacli.contracts.tables.covariance import nearest_correlation

FILE = Path(__file__).with_name("error_correlation.json")
# share of an error that goes with no other: groups of pairs do not tell how each single pair goes together, and what they seem to
# exclude is not excluded (errors of anatomies left out, linear and quadratic cells: mean chi^2 over their number 1.6 and 8.6
# without, 1.05 and .69 with it; benchmarks/errors.py --times)
APART = 0.1


@dataclass(frozen=True)
class _Labels:
    """Of names: kind, region ("" for the whole), time ("" for end-systole); of what is no feature the name itself."""

    kind: tuple[str, ...]
    region: tuple[str, ...]
    time: tuple[str, ...]

    @classmethod
    def of(cls, names: Sequence[str]) -> _Labels:
        rows = []
        for name in names:
            try:
                kind, region = kind_of(family(name))
            except ValueError:
                rows.append((name, "", name))
                continue
            rows.append((kind, region, name.partition("@")[2]))
        kinds, regions, times = zip(*rows, strict=True) if rows else ((), (), ())
        return cls(kinds, regions, times)

    def same(self) -> tuple[BoolArray, BoolArray]:
        """(p, p): whether two are of one region, of one time."""
        region, time = np.array(self.region), np.array(self.time)
        return region[:, None] == region[None], time[:, None] == time[None]


def _group(a: str, b: str, region: bool, time: bool) -> str:
    first, second = sorted((a, b))
    return f"{first} {second}, {'one region' if region else 'two regions'}, {'one time' if time else 'two times'}"


def correlation(names: Sequence[str], values: FloatArray, order: int) -> FloatArray:
    """(p, p) correlation between the discretisation errors of features with these values, for cells of that order.

    Features of which nothing was measured go together with nothing. Raises InputError where the file is damaged.
    """
    if not names:
        return np.zeros((0, 0))
    return of_groups(names, values, _table()[str(order)], APART)


def of_groups(names: Sequence[str], values: FloatArray, known: Mapping[str, float], apart: float) -> FloatArray:
    """(p, p) correlation of features with these values by the correlations of groups, as ``measured`` gives them; apart: the
    share of an error that goes with no other."""
    labels = _Labels.of(names)
    one_region, one_time = labels.same()
    sign = _sign(labels, np.asarray(values, dtype=float))
    kinds, at = np.unique(np.array(labels.kind), return_inverse=True)
    table = np.array(
        [[[[known.get(_group(a, b, bool(r), bool(t)), 0.0) for t in (0, 1)] for r in (0, 1)] for b in kinds] for a in kinds]
    )
    result = (1.0 - apart) * np.outer(sign, sign) * table[at[:, None], at[None], one_region.astype(int), one_time.astype(int)]
    np.fill_diagonal(result, 1.0)
    return nearest_correlation(result)


def _sign(labels: _Labels, values: FloatArray) -> FloatArray:
    """(p,): 1, or -1 for components that point the other way."""
    return np.where((values < 0) & np.isin(labels.kind, ["n", "a", "b"]), -1.0, 1.0)


def measured(samples: Iterable[tuple[Sequence[str], FloatArray, FloatArray]]) -> dict[str, float]:
    """Correlations by group from samples of errors over their stated ones: names, values of the features, errors (p,).

    A sample is one anatomy at one resolution; each counts the same.
    """
    products: dict[str, list[float]] = {}
    squares: dict[str, list[float]] = {}
    for names, values, errors in samples:
        labels = _Labels.of(names)
        one_region, one_time = labels.same()
        z = _sign(labels, values) * errors
        kinds = np.array(labels.kind)
        for a in sorted(set(labels.kind)):
            squares.setdefault(a, []).append(float((z[kinds == a] ** 2).mean()))
            for b in sorted(set(labels.kind)):
                if b < a:
                    continue
                pair = (kinds == a)[:, None] & (kinds == b)[None] & ~np.eye(len(z), dtype=bool)
                for region in (True, False):
                    for time in (True, False):
                        here = pair & (one_region == region) & (one_time == time)
                        if here.any():
                            group = _group(a, b, region, time)
                            products.setdefault(group, []).append(float(np.outer(z, z)[here].mean()))
    size = {kind: float(np.mean(values)) ** 0.5 for kind, values in squares.items()}
    found = {}
    for group, means in products.items():
        a, b = group.split(",")[0].split(" ")
        found[group] = float(np.clip(np.mean(means) / max(size[a] * size[b], 1e-300), -0.98, 0.98))
    return dict(sorted(found.items()))


@functools.cache
def _table() -> dict[str, Any]:
    return dict(read_json(FILE, error=InputError)["orders"])
