"""Targets: what the patient's images say, mean and standard deviation of each feature."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w

from lacli.base.arrays import FloatArray
from lacli.base.errors import TableError
from lacli.contracts.covariance import read_covariance


@dataclass(frozen=True)
class Targets:
    """names (p,), mean (p,) and sd (p,) in the features' own units; covariance (p, p) of the errors, None: independent."""

    names: tuple[str, ...]
    mean: FloatArray
    sd: FloatArray
    covariance: FloatArray | None = None

    def select(self, names: Sequence[str]) -> Targets:
        """The targets in the order of ``names``; TableError if one is missing."""
        missing = [name for name in names if name not in self.names]
        if missing:
            raise TableError(f"targets: no value for {', '.join(missing)}; there are {', '.join(self.names)}.")
        j = [self.names.index(name) for name in names]
        covariance = None if self.covariance is None else self.covariance[np.ix_(j, j)]
        return Targets(tuple(names), self.mean[j], self.sd[j], covariance)

    def widened(self, error_sd: FloatArray) -> Targets:
        """The targets with the simulator's own error (p,), one standard deviation, added to their uncertainty: what a run
        says differs from the truth by both."""
        if not error_sd.any():
            return self
        covariance = None if self.covariance is None else self.covariance + np.diag(error_sd**2)
        return Targets(self.names, self.mean, np.hypot(self.sd, error_sd), covariance)


def read_targets(path: Path) -> Targets:
    """Read ``targets.toml``: a table for each feature with ``mean`` and ``sd``, at the top or under ``[targets]``.

    Example: ``[targets.esv_ml]``, ``mean = 92.0``, ``sd = 4.6``. ``covariance = "file.npz"`` at the top names the covariance of
    the errors, in the same folder (contracts.covariance). Raises TableError with the key at fault.
    """
    path = Path(path)
    if not path.is_file():
        raise TableError(f"{path}: no such targets file. Write a table for each feature with mean and sd.")
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise TableError(f"{path}: not valid TOML ({error}).") from error
    tables = document.get("targets", document)
    names, means, sds = [], [], []
    for name, entry in tables.items() if isinstance(tables, dict) else []:
        if not isinstance(entry, dict):
            continue
        unknown = set(entry) - {"mean", "sd", "unit", "source"}
        if unknown:
            raise TableError(f"{path}: [{name}] has an unknown key {', '.join(sorted(unknown))}; the keys are mean and sd.")
        values = []
        for key in ("mean", "sd"):
            value = entry.get(key)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise TableError(f"{path}: [{name}] needs a finite number for {key}, found {value!r}.")
            values.append(float(value))
        if values[1] <= 0:
            raise TableError(f"{path}: [{name}] sd must be positive, found {values[1]:g}. A measurement has an uncertainty.")
        names.append(name)
        means.append(values[0])
        sds.append(values[1])
    if not names:
        raise TableError(f"{path}: no target in it. Write a table for each feature with mean and sd.")
    file = document.get("covariance")
    covariance = None if file is None else read_covariance(path, file, names, np.array(sds))
    return Targets(tuple(names), np.array(means), np.array(sds), covariance)


def write_targets(path: Path, targets: Targets) -> None:
    """Write the targets as TOML that ``read_targets`` reads."""
    document = {
        "targets": {
            name: {"mean": float(mean), "sd": float(sd)}
            for name, mean, sd in zip(targets.names, targets.mean, targets.sd, strict=True)
        }
    }
    Path(path).write_text(tomli_w.dumps(document), encoding="utf-8")
