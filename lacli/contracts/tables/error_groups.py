"""Which errors of features go together alike: pairs in groups, by their two kinds, one region or two, one time or two.

Few measurements do not tell how each single pair of features errs together; groups of pairs they tell. Errors of tracking and of
discretisation are both learnt so.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.contracts.features import family, kind_of
from lacli.contracts.tables.covariance import nearest_correlation

MOST = 0.98  # a correlation of a group is no larger


@dataclass(frozen=True)
class Groups:
    """Pairs of p names: ``kind`` (p,) of each, the groups' names, the group of each pair (p, p)."""

    kind: tuple[str, ...]
    names: tuple[str, ...]
    of: IntArray

    @classmethod
    def of_features(cls, features: Sequence[str], *, whole_with_all: bool = False) -> Groups:
        """Of features, at times or at end-systole; what is no feature is a kind of its own, at no other's time.

        whole_with_all: what is of the whole atrium is of one region with every region.
        """
        rows = [_label(name) for name in features]
        kind, region, time = (np.array(column) for column in zip(*rows, strict=True))
        kinds, at = np.unique(kind, return_inverse=True)
        one_region, one_time = region[:, None] == region, time[:, None] == time
        if whole_with_all:
            one_region |= (region == "")[:, None] | (region == "")
        first, second = np.minimum(at[:, None], at), np.maximum(at[:, None], at)
        code = ((first * len(kinds) + second) * 2 + one_region) * 2 + one_time
        known, of = np.unique(code, return_inverse=True)
        names = []
        for one in known.tolist():
            a, b = divmod(one // 4, len(kinds))
            names.append(group(str(kinds[a]), str(kinds[b]), bool(one // 2 % 2), bool(one % 2)))
        return cls(tuple(map(str, kind)), tuple(names), of.reshape(code.shape))

    def means(self, product: FloatArray) -> dict[str, float]:
        """By group the mean of a symmetric matrix (p, p) over its pairs of two different features."""
        apart = ~np.eye(len(self.of), dtype=bool)
        count = np.bincount(self.of[apart], minlength=len(self.names))
        total = np.bincount(self.of[apart], product[apart], minlength=len(self.names))
        return {name: float(t / c) for name, t, c in zip(self.names, total, count, strict=True) if c}

    def correlation(self, known: Mapping[str, float], kept: float, sign: FloatArray | None = None) -> FloatArray:
        """(p, p) correlation by those of groups, each times ``kept`` (the rest of an error goes with no other); groups not known
        have none. sign (p,): -1 for features that point the other way."""
        of_group = np.array([kept * float(np.clip(known.get(name, 0.0), -MOST, MOST)) for name in self.names])
        matrix = of_group[self.of]
        if sign is not None:
            matrix = matrix * np.outer(sign, sign)
        np.fill_diagonal(matrix, 1.0)
        return nearest_correlation(matrix)


def group(a: str, b: str, one_region: bool, one_time: bool) -> str:
    """The name of a group of pairs of two kinds."""
    first, second = sorted((a, b))
    return f"{first} {second}, {'one region' if one_region else 'two regions'}, {'one time' if one_time else 'two times'}"


def normalised(samples: Sequence[tuple[Groups, FloatArray]]) -> dict[str, float]:
    """Correlations by group from samples of errors (p,), each over its stated size; each sample counts the same.

    About zero: a bias that all errors share is what must not be missed.
    """
    products: dict[str, list[float]] = {}
    squares: dict[str, list[float]] = {}
    for groups, errors in samples:
        for name, mean in groups.means(np.outer(errors, errors)).items():
            products.setdefault(name, []).append(mean)
        kinds = np.array(groups.kind)
        for kind in sorted(set(groups.kind)):
            squares.setdefault(kind, []).append(float((errors[kinds == kind] ** 2).mean()))
    size = {kind: float(np.mean(values)) ** 0.5 for kind, values in squares.items()}
    found = {}
    for a, b, region, time in itertools.product(sorted(size), sorted(size), (True, False), (True, False)):
        if a <= b and (name := group(a, b, region, time)) in products:
            found[name] = float(np.clip(np.mean(products[name]) / max(size[a] * size[b], 1e-300), -MOST, MOST))
    return dict(sorted(found.items()))


def _label(name: str) -> tuple[str, str, str]:
    """Kind, region ("" for the whole), time ("" for end-systole)."""
    try:
        kind, region = kind_of(family(name))
    except ValueError:
        return name, "", name
    return kind, region, name.partition("@")[2]
