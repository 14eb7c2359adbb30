"""How discretisation errors go together: between times, regions and kinds of features, as they did on anatomies measured.

Coarse cells are too stiff everywhere at once: their errors are no independent noise, and many targets do not average them out. An
error counts positive where it makes the feature larger in size. Correlations are means about zero (a common bias is what must
not be missed) of the errors over the stated ones, by the cells' order, the two kinds, whether the regions and the times are the
same; ``error_correlation.json``, written by ``benchmarks/errors.py --times --write``, of quadratic cells with ``--images``.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.documents import read_json
from lacli.base.errors import InputError
from lacli.contracts.tables.error_groups import Groups, normalised

FILE = Path(__file__).with_name("error_correlation.json")
# share of an error that goes with no other: groups of pairs do not tell how each single pair goes together, and what they seem to
# exclude is not excluded (errors of anatomies left out, linear and quadratic cells: mean chi^2 over their number 1.6 and 1.4
# without, 1.05 and .79 with it; benchmarks/errors.py --times; linear ones before their fall with the motion was fitted)
APART = 0.1


def correlation(names: Sequence[str], values: FloatArray, order: int) -> FloatArray:
    """(p, p) correlation between the discretisation errors of features with these values, for cells of that order.

    Features of which nothing was measured go together with nothing. Raises InputError where the file is damaged.
    """
    if not names:
        return np.zeros((0, 0))
    return of_groups(names, values, _table()[str(order)]["groups"], APART)


def of_groups(names: Sequence[str], values: FloatArray, known: Mapping[str, float], apart: float) -> FloatArray:
    """(p, p) correlation of features with these values by the correlations of groups, as ``measured`` gives them; apart: the
    share of an error that goes with no other."""
    groups = Groups.of_features(names)
    return groups.correlation(known, 1.0 - apart, _sign(groups, np.asarray(values, dtype=float)))


def measured(samples: Iterable[tuple[Sequence[str], FloatArray, FloatArray]]) -> dict[str, float]:
    """Correlations by group from samples of errors over their stated ones: names, values of the features, errors (p,).

    A sample is one anatomy at one resolution; each counts the same.
    """
    signed = []
    for names, values, errors in samples:
        groups = Groups.of_features(names)
        signed.append((groups, _sign(groups, values) * errors))
    return normalised(signed)


def _sign(groups: Groups, values: FloatArray) -> FloatArray:
    """(p,): 1, or -1 for components that point the other way."""
    return np.where((values < 0) & np.isin(groups.kind, ["n", "a", "b"]), -1.0, 1.0)


@functools.cache
def _table() -> dict[str, Any]:
    return dict(read_json(FILE, error=InputError))
