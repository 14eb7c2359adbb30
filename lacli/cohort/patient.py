"""One patient's calibration as a study reads it, from the folder that `lacli calibrate` left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.documents import read_json
from lacli.base.errors import InputError, UsageError
from lacli.calibration.annulus import read_effects, with_annulus
from lacli.cohort.comparison import REGIONAL, Model
from lacli.contracts.identity import of_own_runs
from lacli.contracts.targets import Targets
from lacli.inference.box import Box, make_box
from lacli.inference.emulation.emulator_set import load_emulators
from lacli.mechanics.numerics.error_correlation import correlation

RESULT, IDENTITY = "result.json", "calibration.json"
_ROUNDING = 1e-8  # of a variance: what is left of it beside others that are as large is nothing


def read_result(folder: Path) -> Mapping[str, Any]:
    """The calibration's result. Raises InputError where there is none."""
    result = read_json(folder / RESULT, missing="no such file; is this the folder of a finished calibration?")
    made = isinstance(result, dict) and (result.get("waves") or result.get("method") == "sequential")
    if not made or not isinstance(result.get("fit"), list):
        raise InputError(f"{folder / RESULT}: not a calibration's result.")
    return result


def held_against(folder: Path, targets: Targets) -> Targets:
    """The targets as that calibration was held against them: with the errors that it added, of its tracked annulus and of
    discretisation. Raises InputError.

    Those that it left out (of frames whose states the runs do not settle) are left out here too: no error that they would need is
    known, so that they would count for more than all others, and the runs do not foretell them.
    """
    result = read_result(folder)
    features = {str(row["feature"]) for row in result["fit"]}
    targets = with_annulus(targets.select([name for name in targets.names if name in features]), read_effects(folder))
    errors = discretisation(result, targets)
    if not any(errors.values()):
        return targets.with_errors_times(_factor(result))
    order = of_own_runs(folder / IDENTITY, "numerics.order")
    if order not in (1, 2):
        raise InputError(f"{folder / IDENTITY}: tells no order of the cells, by which its discretisation errors go together.")
    return targets.widened(errors, correlation(targets.names, targets.mean, order)).with_errors_times(_factor(result))


def discretisation(result: Mapping[str, Any], targets: Targets) -> dict[str, float]:
    """By feature, the standard deviation of the discretisation errors that the calibration added to these targets' own.

    The result's sd holds discrepancies that the targets state as well, and the factor that was found on all that was added; both
    are taken out.
    """
    added = np.zeros(len(targets.names)) if targets.added is None else targets.added
    told = dict(zip(targets.names, map(float, added), strict=True))
    found = {}
    for row in result["fit"]:
        if (name := str(row["feature"])) in told:
            whole, own = ((sd / _factor(result)) ** 2 for sd in (float(row["sd"]), _own_sd(row)))
            rest = whole - own - told[name] ** 2
            found[name] = float(np.sqrt(rest)) if rest > _ROUNDING * whole else 0.0
    return found


def _factor(result: Mapping[str, Any]) -> float:
    """What all that was added to the measurement's errors was multiplied by."""
    return float((result.get("error_factor") or {}).get("value", 1.0))


def box_of(folder: Path) -> Box:
    """The box of a calibration. Raises InputError where its folder does not say it."""
    document = read_json(folder / IDENTITY)
    content = document.get("content", {}) if isinstance(document, dict) else {}
    try:
        names = list(content["box.names"])
        low, high = ([float(content[f"box.{end}.{name}"]) for name in names] for end in ("lower", "upper"))
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{folder / IDENTITY}: does not say the box; calibrate again.") from None
    return make_box(names, low, high)


def _own_sd(row: Mapping[str, Any]) -> float:
    """The measurement's own sd; of calibrations that added nothing, sd."""
    return float(row.get("own_sd", row["sd"]))


def shared(read: Sequence[tuple[Path, Model]]) -> tuple[tuple[str, ...], str]:
    """The features that the models of all these calibrations foretell, and a word on those that one of them left out.

    Evidences of different targets cannot be held against each other: what one model does not foretell, none is held against.
    Raises UsageError where a calibration was made to other features than the first, or nothing is left.
    """
    out = [set(map(str, read_result(folder).get("targets_left_out") or ())) for folder, _ in read]
    given = [left | set(model.emulators.outputs) for left, (_, model) in zip(out, read, strict=True)]
    for (_, model), features in zip(read, given, strict=True):
        if features != given[0]:
            raise UsageError(f"compare: {model.name} was calibrated to other features than {read[0][0]}.")
    lost = set().union(*out)
    names = tuple(name for name in read[0][1].emulators.outputs if name not in lost)
    if not names:
        raise UsageError("compare: of every target one of the calibrations says that its runs do not tell it; nothing is left.")
    if not lost:
        return names, ""
    whose = ", ".join(model.name for left, (_, model) in zip(out, read, strict=True) if left)
    return names, (
        f"{len(lost)} targets are held against no model: the calibration of {whose} left them out, as its runs do not tell them"
        f" ({', '.join(sorted(lost)[:3])}{' ...' if len(lost) > 3 else ''})."
    )


def read_model(folder: Path, targets: Targets, name: str = REGIONAL) -> Model:
    """The emulators and the box of a calibration to these targets: of the last wave, or of all runs of a sequential one.

    Raises InputError where the folder holds no finished calibration, UsageError where it was made to other targets.
    """
    result = read_result(folder)
    for row in result["fit"]:
        feature = str(row["feature"])
        if feature not in targets.names:
            raise UsageError(f"{folder}: was calibrated to {feature}, which the targets given lack; give those it was made to.")
        j = targets.names.index(feature)
        own = _own_sd(row)
        if not np.allclose([row["target"], own], [targets.mean[j], targets.own_sd[j]], rtol=1e-9, atol=0):
            raise UsageError(
                f"{folder}: was calibrated to {feature} {row['target']:g} ± {own:g}, the targets given say"
                f" {targets.mean[j]:g} ± {targets.own_sd[j]:g}; give those it was made to."
            )
    features = [str(row["feature"]) for row in result["fit"]]
    box = box_of(folder)
    if result.get("method") == "sequential":
        from lacli.calibration.sequential.outputs import features_of

        return Model(name, features_of(folder / "runs.csv", box, held_against(folder, targets)), box)
    emulators = load_emulators(folder / f"wave_{len(result['waves'])}" / "emulators.npz")
    missing = [feature for feature in features if feature not in emulators.outputs]
    if missing:
        raise InputError(f"{folder}: its emulators have no {', '.join(missing)}; calibrate again.")
    if box.names != emulators.inputs:
        raise InputError(f"{folder}: the emulators' inputs are not the box's; calibrate again.")
    return Model(name, emulators.select(features), box)
