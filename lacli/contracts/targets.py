"""Targets: what the patient's images say, mean and standard deviation of each feature."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from lacli.base.arrays import FloatArray
from lacli.base.documents import brief, read_toml
from lacli.base.errors import TableError
from lacli.base.notes import note
from lacli.contracts.features import KEYS
from lacli.contracts.priors import Prior, prior_tables, read_priors
from lacli.contracts.tables.absent import CODES, is_code
from lacli.contracts.tables.covariance import read_covariance, write_covariance
from lacli.contracts.tables.discrepancy import read_discrepancies

# a measurement is not as exact as a billionth of a thousandth of itself, nor worth the name beyond a million times itself
# (a mean near 0 is what rounding left of nothing: there the unit is the measure)
_EXACTEST, _VAGUEST = 1e-12, 1e6
_NOTHING, _LARGEST = 1e-100, 1e100
SAME_ES = 0.02  # of the cycle: a frame as near to end-systole shows end-systole itself


@dataclass(frozen=True)
class Targets:
    """Targets of features by name: names (p,), mean (p,) and sd (p,) in the features' own units; covariance (p, p) of the errors,
    None: independent; priors of the simulator's inputs, None: uniform; added (p,): what of sd is not the measurement's, None:
    nothing (``widened``); measured (p,): what of it is, None: all; errors (p, p): covariance of what was added, None: nothing;
    es_time: end-systole in the images, as a share of the cycle, None: not stated."""

    names: tuple[str, ...]
    mean: FloatArray
    sd: FloatArray
    covariance: FloatArray | None = None
    priors: tuple[Prior, ...] | None = None
    added: FloatArray | None = None
    measured: FloatArray | None = None
    errors: FloatArray | None = None
    es_time: float | None = field(default=None, metadata={"determines": False})  # held against the scene's, which runs take

    @property
    def own_sd(self) -> FloatArray:
        """(p,) standard deviations of the measurement alone."""
        return self.sd if self.measured is None else self.measured

    def as_given(self) -> dict[str, Any]:
        """The fields that stand for others where it is asked what determines a result: measured and added errors apart."""
        return {"sd": self.own_sd, "measured": None}

    def select(self, names: Sequence[str]) -> Targets:
        """The targets in the order of ``names``; TableError if one is missing."""
        missing = [name for name in names if name not in self.names]
        if missing:
            raise TableError(f"targets: no value for {', '.join(missing)}; there are {', '.join(self.names)}.")
        j = [self.names.index(name) for name in names]
        covariance = None if self.covariance is None else self.covariance[np.ix_(j, j)]
        added, measured = (None if value is None else value[j] for value in (self.added, self.measured))
        errors = None if self.errors is None else self.errors[np.ix_(j, j)]
        return Targets(tuple(names), self.mean[j], self.sd[j], covariance, self.priors, added, measured, errors, self.es_time)

    def widened(self, errors: Mapping[str, float], correlation: FloatArray | None = None) -> Targets:
        """The targets with errors (sd, in the features' units) of what is held against them added to their own.

        correlation (p, p): that of the errors added; None: they are independent.
        """
        more = np.array([errors.get(name, 0.0) for name in self.names])
        before = 0.0 if self.added is None else self.added
        added = np.diag(more**2) if correlation is None else np.outer(more, more) * correlation
        sd = np.sqrt(self.sd**2 + more**2)
        in_all = added if self.errors is None else self.errors + added
        told = (self.priors, np.hypot(before, more), self.own_sd, in_all, self.es_time)
        if self.covariance is None and np.array_equal(added, np.diag(np.diag(added))):
            return Targets(self.names, self.mean, sd, None, *told)
        own = np.diag(self.sd**2) if self.covariance is None else self.covariance
        return Targets(self.names, self.mean, sd, own + added, *told)

    def with_errors_times(self, factor: float) -> Targets:
        """The targets with what was added to their own errors ``factor`` times as large."""
        if self.errors is None or factor == 1.0:
            return self
        assert self.added is not None, "errors are added with their standard deviations"
        more = (factor**2 - 1.0) * self.errors
        return replace(
            self,
            sd=np.sqrt(self.sd**2 + np.diag(more)),
            covariance=None if self.covariance is None else self.covariance + more,
            added=factor * self.added,
            errors=factor**2 * self.errors,
        )


_AT_THE_TOP = ("covariance", "es_time", "nearest_frame_to_es")


def read_targets(path: Path) -> Targets:
    """Read ``targets.toml``: a table for each feature with ``mean`` and ``sd``, at the top or under ``[targets]``.

    Example: ``[targets.esv_ml]``, ``mean = 92.0``, ``sd = 4.6``. ``covariance = "file.npz"`` at the top names the covariance of
    the errors, in the same folder (contracts.tables.covariance); ``[priors.NAME]`` tells what is known of an input
    (contracts.priors), ``[discrepancy.KIND]`` what the model lacks (contracts.tables.discrepancy). Raises TableError with the key
    at fault.
    """
    path = Path(path)
    document = read_toml(path, error=TableError, missing="no such targets file. Write a table for each feature with mean and sd")
    priors = read_priors(path, document.pop("priors", None))
    lacking = document.pop("discrepancy", None)
    tables = document
    if "targets" in document:
        tables = document["targets"]
        beside = [key for key, value in document.items() if key != "targets" and isinstance(value, dict)]
        if beside:
            raise TableError(f"{path}: [{'], ['.join(beside)}] stands beside [targets] and is not read. Move or remove it.")
        if not isinstance(tables, dict):
            raise TableError(f"{path}: targets needs a table for each feature, found {brief(tables)}.")
        stray = [key for key, value in tables.items() if not isinstance(value, dict)]
        if stray:
            raise TableError(f"{path}: {', '.join(stray)} under [targets] is no table with mean and sd.")
    found = {name: _target(path, name, entry) for name, entry in tables.items() if isinstance(entry, dict)}
    if not found:
        raise TableError(f"{path}: no target in it. Write a table for each feature with mean and sd.")
    unread = sorted(key for key, value in document.items() if not isinstance(value, dict) and key not in _AT_THE_TOP)
    if unread:
        raise TableError(f"{path}: {', '.join(unread)} at the top is not read; there may stand {', '.join(_AT_THE_TOP)}.")
    alike: dict[str, str] = {}
    for name in found:
        if (other := alike.setdefault(name.strip().lower(), name)) != name:
            raise TableError(f"{path}: {other} and {name} are one name but for its spelling. Keep one.")
    values = np.array(list(found.values()))
    file = document.get("covariance")
    covariance = None if file is None else read_covariance(path, file, list(found), values[:, 1])
    targets = Targets(tuple(found), values[:, 0], values[:, 1], covariance, priors, es_time=_es_time(path, document))
    discrepancy = read_discrepancies(path, lacking, list(found))
    if discrepancy is None:
        return targets
    sd = np.sqrt(np.diag(discrepancy))
    unit = np.where(sd > 0, sd, 1.0)
    correlation = discrepancy / np.outer(unit, unit)
    return targets.widened(dict(zip(found, map(float, sd), strict=True)), correlation)


def _es_time(path: Path, document: Mapping[str, Any]) -> float | None:
    value = document.get("es_time")
    if value is None or isinstance(value, dict):
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < value < 1.0:
        raise TableError(f"{path}: es_time is {brief(value)}; it is a share of the cycle between 0 and 1.")
    return float(value)


def _target(path: Path, name: str, entry: dict[str, Any]) -> tuple[float, float]:
    """Mean and sd of one target, each a number that can be worked with."""
    unknown = set(entry) - {"mean", "sd", "unit", "source"}
    if unknown:
        raise TableError(f"{path}: [{name}] has an unknown key {', '.join(sorted(unknown))}; the keys are mean and sd.")
    for key in ("mean", "sd"):
        value = entry.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise TableError(f"{path}: [{name}] needs a finite number for {key}, found {brief(value)}.")
    mean, sd = float(entry["mean"]), float(entry["sd"])
    if code := next((key for key in ("mean", "sd") if is_code(float(entry[key]))), None):
        raise TableError(f"{path}: [{name}] {code} is {entry[code]:g}: a mark of a missing value. Leave the target out.")
    feature = KEYS.get(name.partition("@")[0])
    if feature is not None and not feature.possible[0] <= mean <= feature.possible[1]:
        low, high = feature.possible
        unit = f" {feature.unit}" if feature.unit else ""
        raise TableError(
            f"{path}: [{name}] mean {mean:g}{unit} is not possible (allowed: {low:g} to {high:g}{unit}); it is the"
            f" {feature.definition}. Check its unit, or leave the target out."
        )
    if mean in CODES:
        note(f"{path}: [{name}] mean {mean:g} is what programs write for a missing value; leave the target out if it is one.")
    if sd <= 0:
        raise TableError(f"{path}: [{name}] sd must be positive, found {sd:g}. A measurement has an uncertainty.")
    if sd < _EXACTEST * abs(mean) or sd < _NOTHING:
        raise TableError(f"{path}: [{name}] sd {sd:g} beside a mean of {mean:g}: no measurement is that exact. Check it.")
    if sd > _VAGUEST * max(abs(mean), 1.0) or abs(mean) > _LARGEST:
        raise TableError(f"{path}: [{name}] mean {mean:g} with sd {sd:g} tells nothing. Check the units.")
    return mean, sd


def write_targets(path: Path, targets: Targets) -> None:
    """Write the targets, and priors of inputs if any, as TOML that ``read_targets`` reads; a covariance as the file
    ``<name>_covariance.npz`` beside it, which it names.

    Raises TableError of targets to which errors were added: a file has the measurement's own, and states what the model lacks by
    kinds of features.
    """
    path = Path(path)
    if targets.errors is not None and targets.errors.any():
        raise TableError(f"{path}: errors were added to these targets. Write them as measured, and [discrepancy.KIND] by hand.")
    document: dict[str, Any] = {} if targets.es_time is None else {"es_time": targets.es_time}
    if targets.covariance is not None:
        document["covariance"] = f"{path.stem}_covariance.npz"
        write_covariance(path.with_name(document["covariance"]), targets.names, targets.covariance)
    document["targets"] = {
        name: {"mean": float(mean), "sd": float(sd)}
        for name, mean, sd in zip(targets.names, targets.mean, targets.sd, strict=True)
    }
    if targets.priors:
        document["priors"] = prior_tables(targets.priors)
    path.write_text(tomli_w.dumps(document), encoding="utf-8")
