"""How well the patients' calibrations fit, over the cohort: features at the most probable point, waves, models, anatomies."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError, InputError
from lacli.cohort.comparison import EXTRAPOLATED, STRONG, WORST_K
from lacli.cohort.patient import discretisation
from lacli.contracts.features import family, parse
from lacli.contracts.targets import Targets

VAGUE = 2 * STRONG  # standard error of a difference of log evidences beyond which it says nothing


@dataclass(frozen=True)
class Anatomy:
    """What a patient's bundle tells: cavity at end-diastole (mL), mean thickness by region along Laplace's lines and by the
    eikonal (mm), the median over the regions of their difference (mm); where the bundle is; end-systole's time in its motion
    (fraction of RR), None where it has none.
    """

    cavity_ml: float
    laplace_mm: Mapping[str, float]
    eikonal_mm: Mapping[str, float]
    median_difference_mm: float
    bundle: Path
    es_time: float | None = None


def read_anatomy(bundle: Path, patient: str) -> Anatomy | None:
    """Of a patient's bundle; None where there is none. Raises InputError where it is damaged."""
    from lacli.anatomy.surface_features import cavity_volume_ml
    from lacli.anatomy.wall.thickness import of_bundle
    from lacli.contracts.bundle import load
    from lacli.contracts.motion import FILE, load_motion

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
        found.median_difference_mm, bundle, load_motion(bundle).es_time if (bundle / FILE).is_file() else None,
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


def courses(patient: str, result: Mapping[str, Any], es_time: float | None) -> list[dict[str, Any]]:
    """A row a target that is a feature at a time (``es_time`` for those of end-systole; left out where that is not known): the
    feature, its time (fraction of RR), target, sd of its measurement, and the value at the most probable point."""
    rows = []
    for fit in result["fit"]:
        try:
            _, moment = parse(str(fit["feature"]))
        except ValueError:
            continue  # a target of the user's own
        time, value = es_time if moment is None else moment, _value(fit)
        if time is None or value is None:
            continue
        sd = fit.get("own_sd") or fit["sd"]
        rows.append({
            "participant_id": patient, "feature": family(str(fit["feature"])), "time": float(time),
            "target": float(fit["target"]), "sd": float(sd), "at_map": value,
        })  # fmt: skip
    return rows


def over_frames(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """By patient and time: root mean square of value at the most probable point less target, over displacements (mm) and over all
    in their sds."""
    found = []
    for patient, time in dict.fromkeys((row["participant_id"], row["time"]) for row in sorted(rows, key=lambda r: r["time"])):
        mine = [row for row in rows if (row["participant_id"], row["time"]) == (patient, time)]
        off = np.array([row["at_map"] - row["target"] for row in mine])
        length = np.array([str(row["feature"]).endswith("_mm") for row in mine])
        found.append({
            "participant_id": patient, "time": time, "targets": len(mine),
            "rmse_mm": float(np.sqrt((off[length] ** 2).mean())) if length.any() else None,
            "rmse_in_sd": float(np.sqrt(((off / [row["sd"] for row in mine]) ** 2).mean())),
        })  # fmt: skip
    return sorted(found, key=lambda row: (str(row["participant_id"]), row["time"]))


def over_numerics(results: Mapping[str, Mapping[str, Any]], targets: Mapping[str, Targets]) -> list[dict[str, Any]]:
    """By feature over the patients: the discretisation's part of its error, median and largest, and that over the measurement's
    sd; of features whose two parts are told. targets: of each such patient as they were given, by which what they state of the
    model and what the calibration found too small are told apart from it."""
    parts = {patient: discretisation(results[patient], given) for patient, given in targets.items()}
    rows: list[dict[str, Any]] = []
    fits = [(parts[patient], row) for patient in parts for row in results[patient]["fit"] if row.get("own_sd")]
    for name in dict.fromkeys(str(row["feature"]) for _, row in fits):
        mine = [(of[name], float(row["own_sd"])) for of, row in fits if row["feature"] == name and name in of]
        if not mine:
            continue
        part, own = np.array(mine).T
        rows.append({
            "feature": name, "patients": len(mine), "discretisation_median": float(np.median(part)),
            "discretisation_largest": float(part.max()), "over_measurement": float(np.median(part / own)),
        })  # fmt: skip
    return rows


def scores(patient: str, result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row an output of the calibration's last emulators: R2, and the share of runs within two standard deviations (ise:
    independent standard errors), of runs left out; None where the calibration tells none."""
    told = result.get("emulators") or {}
    if waves := [wave for wave in result.get("waves") or () if wave.get("r2")]:
        last = waves[-1]
        told = {name: {"r2": r2, "ise": (last.get("ise") or {}).get(name)} for name, r2 in last["r2"].items()}
    return [
        {"participant_id": patient, "output": str(name), "r2": float(row["r2"]), "ise": row.get("ise")}
        for name, row in told.items()
        if row.get("r2") is not None
    ]


def over_outputs(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """By output over the patients: R2 and ISE of the last emulators as ``scores`` has them, mean and least, and whose is the
    least."""
    found = []
    for name in dict.fromkeys(row["output"] for row in rows):
        row: dict[str, Any] = {"output": name}
        mine = [r for r in rows if r["output"] == name]
        row["patients"] = len(mine)
        for key, whose in (("r2", "of"), ("ise", "ise_of")):
            told = {str(r["participant_id"]): float(r[key]) for r in mine if r[key] is not None}
            worst = min(told, key=lambda patient, told=told: told[patient]) if told else None  # type: ignore[misc]
            row[f"{key}_mean"] = float(np.mean(list(told.values()))) if told else None
            row[f"{key}_least"], row[whose] = (None, None) if worst is None else (told[worst], worst)
        found.append(row)
    return found


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


@dataclass(frozen=True)
class Doubts:
    """What a patient's calibrations and comparison warned of, in words; the models whose evidence, and whose elpd, is not to be
    relied on."""

    words: tuple[str, ...] = ()
    evidence: frozenset[str] = frozenset()
    elpd: frozenset[str] = frozenset()


def doubts(calibrations: Mapping[str, Mapping[str, Any]], comparison: Mapping[str, Any]) -> Doubts:
    """Of results by the model's name, "" that of all models which have no calibration of their own, and of their comparison."""
    said: list[str] = []
    names = [str(fit["name"]) for fit in comparison["fits"]]
    evidence, elpd = set[str](), {str(fit["name"]) for fit in comparison["fits"] if (fit.get("worst_k") or 0.0) > WORST_K}
    for model, result in calibrations.items():
        verdict = result.get("verdict") or {}
        words = [str(w) for w in (*(verdict.get("warnings") or ()), *(result.get("notes") or ()))]
        if result.get("converged") is False:
            words.insert(0, "The sampler did not converge.")
        if verdict.get("plausible") is False:
            evidence |= {name for name in names if (name if name in calibrations else "") == model}
            words = words or ["The most probable point misses a target by more than the threshold: this is no answer."]
        said += [f"{model}: {w}" if model else w for w in dict.fromkeys(words)]
    warned = [str(w) for w in comparison.get("warnings") or ()]
    evidence |= {name for name in names if any(w.startswith(f"{name}: {EXTRAPOLATED}") for w in warned)}
    return Doubts((*said, *warned), frozenset(evidence), frozenset(elpd | evidence))


def over_models(models: Sequence[Mapping[str, Any]], doubted: Mapping[str, Doubts]) -> list[dict[str, Any]]:
    """Of each model over the patients: RMSE and effective number of parameters, mean and sd (None for one patient); the sum of
    elpd with its standard error over those patients who have all models (``elpd_patients``), for sums of others are not to be
    held against each other; the largest Pareto k of them, and whose elpd is not to be relied on."""
    rows = []
    told = [m for m in models if m.get("elpd") is not None and m.get("elpd_se") is not None]
    have: dict[str, set[str]] = {}
    for m in told:
        have.setdefault(m["participant_id"], set()).add(m["name"])
    common = [patient for patient, of in have.items() if of == {m["name"] for m in told}]
    for name in dict.fromkeys(m["name"] for m in models):
        mine = [m for m in models if m["name"] == name]
        values = np.array([m["rmse_mm"] for m in mine if m["rmse_mm"] is not None])
        if not len(values):
            continue
        rmse, sd = _mean_sd(values)
        row: dict[str, Any] = {"name": name, "patients": len(values), "rmse_mean_mm": rmse, "rmse_sd_mm": sd}
        if all(m.get("p_loo") is not None for m in mine):
            row["p_loo_mean"], row["p_loo_sd"] = _mean_sd(np.array([m["p_loo"] for m in mine]))
        if summed := [m for m in mine if m["participant_id"] in common]:
            row["elpd"] = float(sum(m["elpd"] for m in summed))
            row["elpd_se"] = float(np.sqrt(sum(m["elpd_se"] ** 2 for m in summed)))
            row["elpd_patients"] = len(summed)
            row["worst_k"] = max((m["worst_k"] for m in summed if m.get("worst_k") is not None), default=None)
            row["elpd_not_trusted"] = _not_trusted(common, {p: d.elpd for p, d in doubted.items()}, {name})
        rows.append(row)
    return rows


def _mean_sd(values: FloatArray) -> tuple[float, float | None]:
    return float(values.mean()), float(values.std(ddof=1)) if len(values) > 1 else None


def _not_trusted(patients: Iterable[str], doubted: Mapping[str, Collection[str]], models: Collection[str]) -> str:
    """Those of the patients of whom one of the models is doubted, in words; '' where none is."""
    return ", ".join(patient for patient in patients if any(name in doubted.get(patient, ()) for name in models))


def over_contrasts(
    contrasts: Mapping[str, Sequence[Mapping[str, Any]]], doubted: Mapping[str, Doubts] | None = None
) -> list[dict[str, Any]]:
    """By pair of models, over the patients: the sum of the differences of log evidence with its standard error, how many patients
    prefer each strongly, who is left out, and what the sum says.

    Patients are independent, so that log evidences add. Left out is who has evidence that is not to be relied on, or known to no
    better than ``VAGUE``: chosen by how well it is known, not by what it says.
    """
    rows = []
    beyond = {patient: of.evidence for patient, of in (doubted or {}).items()}
    every = [(patient, c) for patient, of_patient in contrasts.items() for c in of_patient]
    for pair in dict.fromkeys((str(c["model"]), str(c["against"])) for _, c in every):
        mine = {patient: c for patient, c in every if (c["model"], c["against"]) == pair}
        out = [p for p, c in mine.items() if set(pair) & set(beyond.get(p, ())) or not float(c["se"]) <= VAGUE]
        summed = [c for patient, c in mine.items() if patient not in out]
        total = float(sum(c["difference"] for c in summed))
        se = float(np.sqrt(sum(c["se"] ** 2 for c in summed)))
        first, other = (sum(c["verdict"] == f"{name} is strongly preferred" for c in summed) for name in pair)
        verdict = "no contrast can be claimed"
        if summed and abs(total) >= STRONG + 2 * se:
            verdict = f"{pair[0] if total > 0 else pair[1]} is strongly preferred"
        if out:
            verdict += f" (without {', '.join(out)}, whose evidence is not to be relied on)"
        rows.append({
            "model": pair[0], "against": pair[1], "patients": len(summed), "log_evidence": total, "se": se,
            "prefer_model": first, "prefer_against": other, "not_trusted": ", ".join(out), "verdict": verdict,
        })  # fmt: skip
    return rows
