"""Statistics of a cohort's table: paired tests, mixed models as published and with the posterior carried, and what to doubt."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lacli.base.errors import InputError, UsageError
from lacli.cohort.analysis.errors_in_variables import structural_slope
from lacli.cohort.analysis.mixed import DRAWS, MixedFit, known_error, normal_draws, published, rubin
from lacli.cohort.analysis.observations import Observations
from lacli.cohort.analysis.paired import PairedTest, paired_tests
from lacli.contracts.features import KEYS

_ANYWHERE = re.compile(r"alpha\d*|stiffness|c\d+")
_DISPLACEMENT = re.compile(r"([dnab]|displacement)(_(global|es|endo))?_mm")


@dataclass(frozen=True)
class Carried:
    """A slope with its posterior's error carried; method ``known error``, ``Rubin's rules`` or ``structural``."""

    method: str
    estimate: float
    low: float
    high: float
    p: float
    df: float
    reliability: float = math.nan


@dataclass(frozen=True)
class Association:
    """response ~ C(region) + predictor, random intercept a patient: plain, and carried (the first is the answer)."""

    response: str
    predictor: str
    plain: MixedFit
    carried: tuple[Carried, ...]


@dataclass(frozen=True)
class Statistics:
    """Paired tests of the response, associations with each predictor, warnings in words."""

    response: str
    patients: tuple[str, ...]
    regions: tuple[str, ...]
    pairs: tuple[PairedTest, ...]
    associations: tuple[Association, ...]
    warnings: tuple[str, ...]


def statistics(
    observed: Observations, response: str, predictors: Sequence[str], targets: Sequence[str] | None = None, seed: int = 0
) -> Statistics:
    """All of it. targets: features that the stiffness was calibrated to (default: end-systolic displacements and volume).

    Raises InputError where a mixed model cannot be fitted: fewer than 3 patients, or a quantity that does not vary.
    """
    if response in predictors or len(set(predictors)) < len(predictors):
        raise UsageError("each quantity once: a response, and predictors that are not it.")
    if predictors and len(observed.patients) < 3:
        raise InputError(
            f"{observed.where}: 2 patients; a mixed model needs at least 3. Without --predictor the paired tests are made."
        )
    if predictors and len(observed.regions) < 2:
        raise InputError(
            f"{observed.where}: one region; a mixed model needs two at least: with one row a patient nothing tells patients "
            "from errors. Give the patients' other regions too."
        )
    for name in predictors:
        _check_variation(observed, name)
    if predictors:
        _check_variation(observed, response)
    warnings = [*observed.notes, *circularity(response, predictors, targets)]
    count = len(observed.patients)
    if count < 6:
        warnings.append(f"{count} patients: a test over so few finds only large effects, and its p rests on normality.")
    associations = []
    for name in predictors:
        plain = published(observed, response, name)
        warnings += plain.notes
        carried = _carried(observed, response, name, seed)
        associations.append(Association(response, name, plain, carried))
        warnings += _of_carried(name, carried)
    pairs = paired_tests(observed, response)
    undefined = [f"{p.first} - {p.second}" for p in pairs if math.isnan(p.p)]
    if undefined:
        warnings.append(f"{response}: the differences {', '.join(undefined)} are the same in all patients: no test.")
    return Statistics(response, observed.patients, observed.regions, tuple(pairs), tuple(associations), tuple(warnings))


def circularity(response: str, predictors: Sequence[str], targets: Sequence[str] | None) -> list[str]:
    """A warning for each pair of a stiffness and a quantity that it was calibrated to, or that goes with one that it was."""
    fitted = {_quantity(name) for name in (targets if targets is not None else ("d_mm", "esv_ml"))}
    found = []
    for name in predictors:
        for stiffness, other in ((name, response), (response, name)):
            kind, time = _quantity(other)
            if not _is_stiffness(stiffness) or kind not in {of for of, _ in fitted}:
                continue
            if (kind, time) in fitted:
                found.append(
                    f"{response} against {name} is circular: {stiffness} was calibrated to {other}, or to the same motion by"
                    " another measure, so they agree whether or not stiffness determines motion. Calibrate to end-systole and"
                    " test on other times (d_mm@0.25), or leave the regions' displacements out of the targets; name the targets"
                    " used with --targets."
                )
            else:
                found.append(
                    f"{response} against {name} is nearly circular: {stiffness} was calibrated to the same motion in other"
                    f" frames, which go with {other}; it tells whether the model foretells these frames, not whether"
                    " stiffness determines motion."
                )
    return found


def _is_stiffness(name: str) -> bool:
    """Whether a column is one of stiffness: alpha or stiffness anywhere in its name, C (c1, log_c) where the quantity stands."""
    parts = name.lower().split("_")
    main = parts[1:] if parts[0] in ("log", "ln", "log10") else parts
    return any(_ANYWHERE.fullmatch(part) for part in parts) or main[:1] == ["c"]


def _quantity(name: str) -> tuple[str, str]:
    """What a column or target measures, and when ("" at end-systole): all measures of displacement are one, of all regions; the
    volumes are one; of others their own name without the region."""
    key, _, time = name.lower().partition("@")
    if key in KEYS and (region := KEYS[key].region):
        key = key.replace(f"_{region}", "")
    if _DISPLACEMENT.fullmatch(key):
        return "displacement", time
    if key in ("esv_ml", "volume_ml"):
        return "volume", time
    return key, time


def _check_variation(observed: Observations, name: str) -> None:
    values = observed.values[name]
    if not float(np.std(values - values.mean(axis=0))) > 1e-9 * float(np.abs(values).max() or 1.0):
        raise InputError(f"{observed.where}: {name} is the same in all patients; nothing can be told from it.")


def _carried(observed: Observations, response: str, predictor: str, seed: int) -> tuple[Carried, ...]:
    y, x = observed.values[response], observed.values[predictor]
    none = np.zeros((*y.shape, y.shape[1]))
    t, s = observed.errors.get(response, none), observed.errors.get(predictor, none)
    if s.any():
        if not float(np.abs(x - x.mean(axis=1, keepdims=True)).max()) > 1e-9 * float(np.abs(x).max()):
            raise InputError(
                f"{observed.where}: {predictor} has an error and is one number a patient; an error can be carried only for what"
                " varies between a patient's regions."
            )
        f = structural_slope(x, y, s, t)
        return (Carried("structural", f.beta, f.low, f.high, f.p, f.df, f.reliability),)
    if not t.any():
        return ()
    exact = known_error(y, x, t)[0]
    draws = observed.draws.get(response)
    if draws is None:
        draws = normal_draws(y, t, DRAWS, seed)
    by_draws = rubin(draws[np.linspace(0, len(draws) - 1, min(len(draws), DRAWS)).astype(int)], x)
    return tuple(
        Carried(method, c.estimate, c.low, c.high, c.p, c.df)
        for method, c in (("known error", exact), ("Rubin's rules", by_draws))
    )


def _of_carried(name: str, carried: tuple[Carried, ...]) -> list[str]:
    found = []
    for c in carried:
        if math.isfinite(c.reliability) and c.reliability < 0.2:
            share = f"{name}: {100 * c.reliability:.0f} % of its spread within patients is no error of its posterior"
            found.append(f"{share}; its slope is hardly known.")
        if not (math.isfinite(c.low) and math.isfinite(c.high)):
            found.append(f"{name}: the interval of its slope is unbounded: the posteriors are as wide as the regions differ.")
    return found
