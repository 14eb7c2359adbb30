"""What a model is known to lack, beside the targets: an error of groups of features that goes together within the group.

[discrepancy.n]           # a kind of feature (n, a, b, d, area_strain, volume, ...) or a single one (n_roof_mm), at all times
sd = 0.2                  # in the features' unit
correlation = 0.5         # between the group's targets, 0 (each its own) to below 1
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.documents import brief
from lacli.base.errors import TableError
from lacli.contracts.features import KEYS, family, kind_of

_CORRELATION = 0.5
_MOST = 0.99
_VAGUEST = 1e6  # in any unit of a feature: beyond it nothing is told, and squares are lost beside it


def read_discrepancies(path: Path, tables: object, names: Sequence[str]) -> FloatArray | None:
    """(p, p) covariance of the table ``discrepancy`` of a targets file, in the targets' units; None where there is none.

    A target of several groups has the errors of all. Raises TableError with the key at fault, and for a group of no target.
    """
    if tables is None:
        return None
    if not isinstance(tables, Mapping) or not tables or not all(isinstance(v, Mapping) for v in tables.values()):
        raise TableError(f"{path}: discrepancy needs a table for each group, [discrepancy.KIND], found {brief(tables)}.")
    found = np.zeros((len(names), len(names)))
    for group, entry in tables.items():
        where = f"{path}: [discrepancy.{group}]"
        sd, correlation = _numbers(where, entry)
        own = np.array([group in _groups(name) for name in names])
        if not own.any():
            kinds = ", ".join(dict.fromkeys(_groups(name)[-1] for name in names))
            raise TableError(f"{where} is of no target; there are the groups {kinds}, and the targets' own names.")
        together = correlation + (1.0 - correlation) * np.eye(int(own.sum()))
        found[np.ix_(own, own)] += sd**2 * together
    return found


def _groups(name: str) -> tuple[str, ...]:
    """A target's name, its feature's, and its kind."""
    key = name.partition("@")[0]
    return name, key, kind_of(family(key) if key in KEYS else key)[0]


def _numbers(where: str, entry: Mapping[str, Any]) -> tuple[float, float]:
    if unknown := sorted(set(entry) - {"sd", "correlation", "source"}):
        raise TableError(f"{where} has a key {', '.join(unknown)}; the keys are sd and correlation.")
    values = (entry.get("sd"), entry.get("correlation", _CORRELATION))
    for key, value in zip(("sd", "correlation"), values, strict=True):
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise TableError(f"{where} needs a finite number for {key}, found {brief(value)}.")
    sd, correlation = map(float, values)
    if sd <= 0:
        raise TableError(f"{where} sd must be positive, found {sd:g}.")
    if sd > _VAGUEST:
        raise TableError(f"{where} sd {sd:g} tells nothing. Check the unit.")
    if not 0.0 <= correlation <= _MOST:
        raise TableError(f"{where} correlation must be 0 to {_MOST:g}, found {correlation:g}.")
    return sd, correlation
