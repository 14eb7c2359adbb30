"""What is known of inputs before any target: a normal, log-normal or uniform distribution each, beside the targets.

[priors.edp_mmhg]
mean = 8.0          # measured, with sd, in the input's unit
sd = 1.5
distribution = "normal"   # or "lognormal" (mean and sd of the input itself), "uniform" (lower and upper alone)
lower = 4.0         # optional ends; the box is one in any case
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.documents import brief, read_toml
from lacli.base.errors import TableError, UsageError

Distribution = Literal["normal", "lognormal", "uniform"]
_KEYS = {"normal": ("mean", "sd"), "lognormal": ("mean", "sd"), "uniform": ("lower", "upper")}
# a box that holds less of a prior than this contradicts it
_LEAST_SHARE = 1e-3
_LEAST_SD = 1e-6  # of the mean
_MOST_SD = 1e3  # of a lognormal prior's mean


@dataclass(frozen=True)
class Prior:
    """Of one input: the distribution's mean and sd in the input's unit (NaN of a uniform one), cut off at lower and upper."""

    name: str
    distribution: Distribution
    mean: float
    sd: float
    lower: float = -math.inf
    upper: float = math.inf

    def table(self) -> dict[str, Any]:
        """As a targets file has it, which ``read_priors`` reads."""
        values = {"mean": self.mean, "sd": self.sd, "lower": self.lower, "upper": self.upper}
        return {"distribution": self.distribution, **{key: value for key, value in values.items() if math.isfinite(value)}}

    def log_density(self, x: FloatArray) -> FloatArray:
        """log p (m,) at values x (m,), up to a constant; -inf where it is cut off."""
        inside = (x >= self.lower) & (x <= self.upper)
        value = np.zeros(len(x))
        if self.distribution == "normal":
            value = -0.5 * ((x - self.mean) / self.sd) ** 2
        elif self.distribution == "lognormal":
            centre, spread = self._of_the_logarithm()
            inside &= x > 0
            log = np.log(np.where(inside, x, 1.0))
            value = -0.5 * ((log - centre) / spread) ** 2 - log
        return np.where(inside, value, -np.inf)

    def residual(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """r (m,) and dr/dx (m,) at x (m,) within the ends, with -1/2 r^2 the log density up to a constant.

        Of a log-normal -1/2 ((l - c) / s)^2 - l, l = log x, is a square too: of (l - c + s^2) / s.
        Raises ValueError of a uniform one.
        """
        if self.distribution == "uniform":
            raise ValueError("a uniform prior has no residual")
        if self.distribution == "normal":
            return (x - self.mean) / self.sd, np.full(len(x), 1.0 / self.sd)
        centre, spread = self._of_the_logarithm()
        return (np.log(x) - centre + spread**2) / spread, 1.0 / (spread * x)

    def share(self, low: float, high: float) -> float:
        """Probability of values from low to high, of the distribution that is not cut off (of a uniform one: where it is)."""
        from scipy.stats import norm

        if self.distribution == "uniform":
            return max(0.0, min(high, self.upper) - max(low, self.lower)) / (self.upper - self.lower)
        low, high = max(low, self.lower), min(high, self.upper)
        if low >= high:
            return 0.0
        if self.distribution == "normal":
            return float(np.diff(norm.cdf([low, high], self.mean, self.sd))[0])
        ends = np.log(np.maximum([low, high], 1e-300))
        return float(np.diff(norm.cdf(ends, *self._of_the_logarithm()))[0])

    def extent(self) -> tuple[float, float]:
        """The ends between which all but 1e-15 of it lies."""
        low, high = -math.inf, math.inf
        if self.distribution == "normal":
            low, high = self.mean - 8.0 * self.sd, self.mean + 8.0 * self.sd
        if self.distribution == "lognormal":
            centre, spread = self._of_the_logarithm()
            low, high = math.exp(centre - 8.0 * spread), math.exp(min(centre + 8.0 * spread, 700.0))
        return max(low, self.lower), min(high, self.upper)

    def _of_the_logarithm(self) -> tuple[float, float]:
        spread = math.sqrt(math.log1p((self.sd / self.mean) ** 2))
        return math.log(self.mean) - 0.5 * spread**2, spread


def prior_tables(priors: Sequence[Prior]) -> dict[str, dict[str, Any]]:
    """The tables by name that ``read_priors`` reads."""
    return {prior.name: prior.table() for prior in priors}


def read_prior_file(path: Path) -> tuple[Prior, ...]:
    """Priors of a file that has them alone, tables ``[priors.NAME]``. Raises TableError with the key at fault."""
    document = read_toml(path, error=TableError, missing="no such file of priors. Write a table [priors.NAME] for each input")
    if other := sorted(set(document) - {"priors"}):
        raise TableError(f"{path}: {', '.join(other)} is no table of priors; there are [priors.NAME] alone.")
    found = read_priors(path, document.get("priors"))
    if found is None:
        raise TableError(f"{path}: no prior in it. Write a table [priors.NAME] for each input.")
    return found


def read_priors(path: Path, tables: object) -> tuple[Prior, ...] | None:
    """Priors of the table ``priors`` of a targets file, None where there is none. Raises TableError with the key at fault."""
    if tables is None:
        return None
    if not isinstance(tables, Mapping) or not tables or not all(isinstance(v, Mapping) for v in tables.values()):
        raise TableError(f"{path}: priors needs a table for each input, [priors.NAME], found {brief(tables)}.")
    return tuple(_prior(path, name, entry) for name, entry in tables.items())


def _prior(path: Path, name: str, entry: Mapping[str, Any]) -> Prior:
    where = f"{path}: [priors.{name}]"
    kind = entry.get("distribution", "uniform" if "mean" not in entry and "sd" not in entry else "normal")
    if kind not in tuple(_KEYS):  # a list among them has no hash
        raise TableError(f"{where} distribution is {brief(kind)}; there are {', '.join(_KEYS)}.")
    allowed = {"distribution", "lower", "upper", "unit", "source", *_KEYS[kind]}
    if unknown := sorted(set(entry) - allowed):
        raise TableError(f"{where} has a key {', '.join(unknown)}; a {kind} one has {', '.join(sorted(allowed))}.")
    values = {}
    for key in ("mean", "sd", "lower", "upper"):
        if key not in entry and key not in _KEYS[kind]:
            continue
        value = entry.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise TableError(f"{where} needs a finite number for {key}, found {brief(value)}.")
        values[key] = float(value)
    mean, sd = values.get("mean", math.nan), values.get("sd", math.nan)
    lower, upper = values.get("lower", -math.inf), values.get("upper", math.inf)
    if sd <= 0 or (kind == "lognormal" and mean <= 0):
        raise TableError(f"{where} {'sd' if sd <= 0 else 'mean of a lognormal one'} must be positive.")
    if sd < _LEAST_SD * abs(mean):
        raise TableError(f"{where} sd {sd:g} of a mean of {mean:g}: nothing is known so exactly. Check sd and unit.")
    if kind == "lognormal" and sd > _MOST_SD * mean:
        raise TableError(f"{where} sd {sd:g} of a mean of {mean:g}: more than {_MOST_SD:g} times as much. Check sd and unit.")
    if lower >= upper:
        raise TableError(f"{where} lower is {lower:g}, upper {upper:g}: the lower end must be below the upper one.")
    found = Prior(name, kind, mean, sd, lower, upper)
    if kind != "uniform" and found.share(-math.inf, math.inf) < _LEAST_SHARE:
        raise TableError(f"{where} next to nothing of it lies from {lower:g} to {upper:g}. Check mean, sd and ends.")
    return found


def check_priors(priors: Sequence[Prior] | None, names: Sequence[str], lower: FloatArray, upper: FloatArray) -> None:
    """Raises UsageError for a prior of what is no input of the box, or one that lies outside of it."""
    for prior in priors or ():
        if prior.name not in names:
            raise UsageError(f"prior of {prior.name}: no input of the box; its inputs are {', '.join(names)}.")
        i = list(names).index(prior.name)
        if prior.share(float(lower[i]), float(upper[i])) < _LEAST_SHARE:
            raise UsageError(
                f"prior of {prior.name}: next to nothing of it lies within the box, {lower[i]:g} to {upper[i]:g}."
                " Check its unit, or widen the box."
            )


def log_prior(priors: Sequence[Prior] | None, names: Sequence[str], x: FloatArray) -> FloatArray:
    """Sum of the priors' log densities (m,) at x (m, d), up to a constant: 0 where there are none."""
    value = np.zeros(len(x))
    for prior in priors or ():
        value += prior.log_density(x[:, list(names).index(prior.name)])
    return value


def prior_sd(priors: Sequence[Prior] | None, names: Sequence[str], lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Standard deviation (d,) of each input before any target, within the box: uniform where nothing else is told."""
    result = (np.asarray(upper, float) - lower) / math.sqrt(12.0)
    for prior in priors or ():
        i = list(names).index(prior.name)
        # the middle of many thin slices of where it is: no closed form for a log-normal that is cut off
        low, high = prior.extent()
        low, high = max(low, float(lower[i])), min(high, float(upper[i]))
        x = low + (np.arange(20_000) + 0.5) / 20_000 * (high - low)
        log = prior.log_density(x)
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        mean = weight @ x
        result[i] = math.sqrt(weight @ (x - mean) ** 2)
    return result
