"""How well the patients' calibrations fit, over the cohort: features at the most probable point, waves, models, anatomies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError, InputError
from lacli.cohort.comparison import STRONG


@dataclass(frozen=True)
class Anatomy:
    """What a patient's bundle tells: cavity at end-diastole (mL), mean thickness by region along Laplace's lines and by the
    eikonal (mm), the median over the regions of their difference (mm); where the bundle is."""

    cavity_ml: float
    laplace_mm: Mapping[str, float]
    eikonal_mm: Mapping[str, float]
    median_difference_mm: float
    bundle: Path


def read_anatomy(bundle: Path, patient: str) -> Anatomy | None:
    """Of a patient's bundle; None where there is none. Raises InputError where it is damaged."""
    from lacli.anatomy.surface_features import cavity_volume_ml
    from lacli.anatomy.wall.thickness import of_bundle
    from lacli.contracts.bundle import load

    if not bundle.is_dir():
        return None
    try:
        it = load(bundle)
        found = of_bundle(it)
    except AnatomyError as error:
        raise InputError(f"{patient}: {error}") from None
    both = found.per_region
    return Anatomy(
        cavity_volume_ml(it, it.points), {n: v for n, (_, v) in both.items()}, {n: v for n, (v, _) in both.items()},
        found.median_difference_mm, bundle,
    )  # fmt: skip


def over_features(results: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """By feature over the patients: root mean square of simulated less target at the most probable point with the sd of its
    absolute value over patients (None for one), and of the difference in sds of the target."""
    rows: list[dict[str, Any]] = []
    fits = [row for result in results.values() for row in result["fit"]]
    for name in dict.fromkeys(str(row["feature"]) for row in fits):
        mine = [row for row in fits if row["feature"] == name]
        pairs = [(_value(row), float(row["target"]), float(row["sd"])) for row in mine]
        known = [(value - target, sd) for value, target, sd in pairs if value is not None]
        if not known:
            continue
        d, sd = (np.array(column) for column in zip(*known, strict=True))
        spread = float(np.abs(d).std(ddof=1)) if len(d) > 1 else None
        rms = float(np.sqrt((d**2).mean()))
        rows.append(
            {"feature": name, "patients": len(d), "rmse": rms, "sd": spread, "rmse_in_sd": float(np.sqrt(((d / sd) ** 2).mean()))}
        )
    return rows


def _value(row: Mapping[str, Any]) -> float | None:
    """The feature at the most probable point: simulated, else emulated."""
    value = row.get("simulated")
    value = row.get("emulated") if value is None else value
    return None if value is None else float(value)


def over_waves(results: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """By patient and wave, where there were waves: runs, failed ones, share of the box not ruled out, least R2 and whose."""
    rows = []
    for patient, result in results.items():
        for wave in result.get("waves") or ():
            r2 = {str(k): float(v) for k, v in (wave.get("r2") or {}).items() if v is not None}
            worst = min(r2, key=lambda name: r2[name]) if r2 else None
            rows.append({
                "participant_id": patient, "wave": wave.get("wave"), "runs": wave.get("runs"), "failed": wave.get("failed"),
                "nroy_share": wave.get("share"), "least_r2": None if worst is None else r2[worst], "of": worst,
            })  # fmt: skip
    return rows


def over_contrasts(contrasts: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """By pair of models, over the patients: the sum of the differences of log evidence with its standard error, how many patients
    prefer each strongly, and what the sum says. Patients are independent, so that log evidences add."""
    rows = []
    every = [c for of_patient in contrasts.values() for c in of_patient]
    for pair in dict.fromkeys((str(c["model"]), str(c["against"])) for c in every):
        mine = [c for c in every if (c["model"], c["against"]) == pair]
        total = float(sum(c["difference"] for c in mine))
        se = float(np.sqrt(sum(c["se"] ** 2 for c in mine)))
        said = [str(c["verdict"]) for c in mine]
        first, other = (sum(words == f"{name} is strongly preferred" for words in said) for name in pair)
        verdict = "no contrast can be claimed"
        if abs(total) >= STRONG + 2 * se:
            verdict = f"{pair[0] if total > 0 else pair[1]} is strongly preferred"
        rows.append({
            "model": pair[0], "against": pair[1], "patients": len(mine), "log_evidence": total, "se": se,
            "prefer_model": first, "prefer_against": other, "verdict": verdict,
        })  # fmt: skip
    return rows


def read_contrasts(folder: Path) -> list[dict[str, Any]]:
    """The contrasts of a patient's comparison."""
    found = read_json(folder / "comparison.json").get("contrasts") or []
    return list(found)
