"""A study's tables from its patients' folders: who was done, regions for ``lacli stats``, joint draws, models."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lacli.base.documents import read_json
from lacli.base.errors import InputError, UsageError
from lacli.base.files import replacing, write_json
from lacli.calibration.annulus import read_effects, with_annulus
from lacli.cohort.analysis.convergence import convergence
from lacli.cohort.analysis.fits import (
    Anatomy,
    Doubts,
    courses,
    doubts,
    over_contrasts,
    over_features,
    over_frames,
    over_models,
    over_numerics,
    over_outputs,
    over_waves,
    read_anatomy,
    scores,
)
from lacli.cohort.analysis.influences import influences
from lacli.cohort.analysis.transients import at_end_systole, over_transients, transients
from lacli.cohort.analysis.walls import walls
from lacli.cohort.files import (
    ANATOMIES,
    CONTRASTS,
    CONVERGENCE,
    COURSES,
    DISCRETISATION,
    DRAWS,
    FEATURES,
    FRAMES,
    INFLUENCES,
    MISFITS,
    MODELS,
    OUTPUTS,
    PATIENTS,
    REGIONS,
    SCORES,
    SUMMARY,
    TRANSIENTS,
    WALLS,
    WAVES,
)
from lacli.cohort.participants import Participant
from lacli.cohort.study import Outcome
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.targets import Targets, read_targets

_DRAWS = 200


Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class _Patient:
    """What one patient's folder has for the study's tables: the calibration's result, its targets where errors are told in two
    parts, what is to be doubted, and rows."""

    result: dict[str, Any]
    given: Targets | None
    doubts: Doubts
    contrasts: Rows
    anatomies: Rows
    convergence: Rows
    courses: Rows
    transients: Rows
    scores: Rows
    walls: Rows
    influences: Rows
    regions: Rows
    draws: Rows
    models: Rows


def write_summary(
    study: Path, participants: Sequence[Participant], outcomes: Sequence[Outcome], notes: Sequence[str] = ()
) -> tuple[tuple[Outcome, ...], dict[str, Any]]:
    """Write the tables of all patients that are done; what is left out is said in ``notes``, after those given.

    Gives the outcomes as well: a patient whose results cannot be read has failed. Raises StorageError.
    """
    state = {o.participant_id: o for o in outcomes}
    read: dict[str, _Patient] = {}
    for patient in participants:
        name = patient.identifier
        if name not in state or state[name].status != "done":
            continue
        try:
            read[name] = _read(study, patient)
        except (InputError, UsageError) as error:
            state[name] = replace(state[name], status="failed", step="summary", reason=str(error))
    found = tuple(state.values())
    table, partial = _complete([row for of in read.values() for row in of.regions])
    said = [*notes, *partial]
    said += [f"{name}: {' '.join(of.doubts.words)}" for name, of in read.items() if of.doubts.words]
    people = [
        _person(p, state[p.identifier], study, read[p.identifier].doubts if p.identifier in read else Doubts())
        for p in participants if p.identifier in state
    ]  # fmt: skip
    models = over_models([row for of in read.values() for row in of.models], {name: of.doubts for name, of in read.items()})
    for name, frame in {PATIENTS: pd.DataFrame(people), REGIONS: table, **_tables(read)}.items():
        if frame.empty:
            (study / name).unlink(missing_ok=True)  # an earlier call's would show another result
            continue
        with replacing(study / name) as temporary:
            frame.to_csv(temporary, index=False)
    summary = {
        "patients": len(participants), "done": len(read), "failed": [o.participant_id for o in found if o.status == "failed"],
        "models": models, "notes": said,
    }  # fmt: skip
    write_json(study / SUMMARY, summary)
    return found, summary


def _read(study: Path, patient: Participant) -> _Patient:
    """Raises InputError, UsageError where something of it is missing or damaged."""
    name, folder = patient.identifier, study / patient.identifier
    result, comparison = read_json(folder / "calibration" / "result.json"), read_json(folder / "comparison.json")
    targets = patient.paths.get("targets", folder / "motion" / "targets.toml")
    in_two = any(row.get("own_sd") for row in result["fit"])
    anatomy = read_anatomy(patient.paths.get("bundle", folder / "anatomy"), name)
    fat = _fat(folder)
    own = courses(name, result, None if anatomy is None else anatomy.es_time)
    _tracked(folder)  # read again for the table of patients, who fail of it here
    return _Patient(
        result,
        with_annulus(read_targets(targets), read_effects(folder / "calibration")) if in_two else None,
        doubts({"": result, **_other_calibrations(folder, comparison)}, comparison),
        list(comparison.get("contrasts") or []),
        [] if anatomy is None else [_of_anatomy(patient, anatomy, fat, study)],
        [] if anatomy is None else convergence(name, anatomy.bundle, result),
        own,
        transients(name, folder, result, own),
        scores(name, result),
        walls(name, anatomy, fat),
        influences(name, folder / "calibration", result),
        _regions(
            patient,
            result,
            {} if anatomy is None else anatomy.laplace_mm,
            fat.get("standard", {}),
            at_end_systole(targets.parent),
        ),
        _draws(patient, folder),
        [{"participant_id": name, **fit} for fit in comparison["fits"]],
    )


def _other_calibrations(folder: Path, comparison: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Results by the model's name of those models that have a calibration of their own: on another anatomy."""
    files = {str(fit["name"]): folder / f"calibration_{fit['name']}" / "result.json" for fit in comparison["fits"]}
    return {name: read_json(file) for name, file in files.items() if file.is_file()}


def _tables(read: Mapping[str, _Patient]) -> dict[str, pd.DataFrame]:
    """The tables over the patients and by patient, by their files' names."""

    def rows(key: str) -> Rows:
        return [row for of in read.values() for row in getattr(of, key)]

    results = {name: of.result for name, of in read.items()}
    given = {name: of.given for name, of in read.items() if of.given is not None}
    found = {
        DRAWS: rows("draws"), MODELS: rows("models"), FEATURES: over_features(results), WAVES: over_waves(results),
        CONTRASTS: over_contrasts(
            {name: of.contrasts for name, of in read.items()}, {name: of.doubts for name, of in read.items()}
        ),
        ANATOMIES: rows("anatomies"),
        COURSES: rows("courses"), FRAMES: over_frames(rows("courses")), DISCRETISATION: over_numerics(results, given),
        OUTPUTS: over_outputs(rows("scores")), SCORES: rows("scores"), TRANSIENTS: rows("transients"),
        MISFITS: over_transients(rows("transients")), WALLS: rows("walls"), CONVERGENCE: rows("convergence"),
        INFLUENCES: rows("influences"),
    }  # fmt: skip
    return {name: pd.DataFrame(of) for name, of in found.items()}


def _complete(regions: Rows) -> tuple[pd.DataFrame, list[str]]:
    """The table of regions without what a patient lacks: a column's cells of that region, or the column where nothing is left;
    and words on it."""
    table = pd.DataFrame(regions)
    lacking, said = list[str](), list[str]()
    for name in table.columns:
        empty = table.loc[table[name].isna(), "region"].unique().tolist()
        if not empty:
            continue
        if set(empty) == set(table["region"]):
            lacking.append(str(name))
        else:
            table.loc[table["region"].isin(empty), name] = np.nan
            if not str(name).endswith("_sd"):
                said.append(f"regions.csv has no {name} of {', '.join(empty)}: not every patient has it.")
    if lacking:
        said.append(f"regions.csv lacks {', '.join(lacking)}: not every patient has them.")
    return table.drop(columns=lacking), said


def _person(patient: Participant, outcome: Outcome, study: Path, doubted: Doubts) -> dict[str, Any]:
    """A participant's row."""
    tracked: dict[str, Any] = {}
    with contextlib.suppress(InputError):  # of one who failed; of others it has been read
        tracked = _tracked(study / patient.identifier)
    return {
        "participant_id": patient.identifier, "status": outcome.status, "step": outcome.step, "reason": outcome.reason,
        "cpu_s": sum(outcome.cpu_s.values()), "warnings": " ".join(doubted.words), **tracked, **patient.others,
    }  # fmt: skip


def median_cpu_s(study: Path) -> tuple[float | None, float | None]:
    """Median CPU seconds of the simulations that a study has made so far, and of the scenes' own that corrected cheap ones; None
    where there are none."""
    found: tuple[list[float], list[float]] = ([], [])
    for file in sorted(study.glob("*/calibration/runs.csv")):
        cheap = file.with_name("runs_cheap.csv")
        for known, table in zip(found, (cheap, file) if cheap.is_file() else (file,), strict=False):
            known += _cpu_s(table)
    of_runs, of_own = (float(np.median(known)) if known else None for known in found)
    return of_runs, of_own


def _cpu_s(table: Path) -> list[float]:
    from lacli.contracts.tables.file import read_frame

    frame = read_frame(table)
    if "cpu_s" not in frame:
        return []
    seconds = pd.to_numeric(frame["cpu_s"], errors="coerce").to_numpy(float)
    return list(map(float, seconds[np.isfinite(seconds)]))


def _tracked(folder: Path) -> dict[str, Any]:
    """Frames and largest side of the voxels (mm) of the images that were tracked; nothing where none were."""
    file = folder / "motion" / "tracking.json"
    info = read_json(file) if file.is_file() else {}
    sides = info.get("voxel_mm")
    return {"frames": len(info["times"]), **({"voxel_mm": max(sides)} if sides else {})} if "times" in info else {}


def _fat(folder: Path) -> dict[str, dict[str, float]]:
    """Epicardial fat by window and region, mL; empty where there is no CT."""
    file = folder / "fat" / "fat.json"
    windows = read_json(file)["windows"] if file.is_file() else {}
    return {str(name): dict(window["per_region_ml"]) for name, window in windows.items()}


def _of_anatomy(patient: Participant, anatomy: Anatomy, fat: dict[str, dict[str, float]], study: Path) -> dict[str, Any]:
    """A patient's row: cavity measured beside the given one, thickness two ways, fat in each window."""
    given = pd.to_numeric(pd.Series([patient.others.get("ed_volume_ml")]), errors="coerce").iloc[0]
    means = [float(np.mean(list(of.values()))) for of in (anatomy.laplace_mm, anatomy.eikonal_mm)]
    bundle = anatomy.bundle.absolute()
    row = {
        "participant_id": patient.identifier, "ed_volume_ml_given": given, "ed_volume_ml_measured": anatomy.cavity_ml,
        "thickness_laplace_mm": means[0], "thickness_eikonal_mm": means[1],
        "thickness_median_difference_mm": anatomy.median_difference_mm,
        **{f"fat_{name}_ml": float(sum(of.values())) for name, of in fat.items()},
    }  # fmt: skip
    return {**row, "bundle": str(bundle.relative_to(study.absolute()) if bundle.is_relative_to(study.absolute()) else bundle)}


def _regions(
    patient: Participant,
    result: dict[str, Any],
    thickness: Mapping[str, float],
    fat: Mapping[str, float],
    tracked: Mapping[str, tuple[float, float]],
) -> list[dict[str, Any]]:
    """A patient's rows; a displacement that was no target is of the tracked motion beside the targets, where there is one."""
    posterior = {row["input"]: row for row in result["posterior"]}
    fit = {row["feature"]: row for row in result["fit"]}
    rows = []
    for region in BODY_REGIONS:
        row: dict[str, Any] = {"participant_id": patient.identifier, "region": region}
        for part in ("alpha", "c"):
            for name in (f"{part}_{region}", f"{part}_{region}_kpa"):
                if name in posterior:
                    row[part], row[f"{part}_sd"] = posterior[name]["mean"], posterior[name]["sd"]
        seen = tracked.get(f"d_{region}_mm", (np.nan, np.nan))
        if target := fit.get(f"d_{region}_mm"):
            seen = target["target"], target.get("own_sd", target["sd"])
        row["d_mm"], row["d_mm_sd"] = seen
        row["thickness_mm"], row["fat_ml"] = thickness.get(region, np.nan), fat.get(region, np.nan)
        rows.append(row)
    return rows


def _draws(patient: Participant, folder: Path) -> list[dict[str, Any]]:
    """At most 200 joint draws of the regions' alpha; none where not all of them were calibrated."""
    from lacli.inference.sampling.posterior import load_chain

    chain = load_chain(folder / "calibration" / "chain.npz")
    names = [f"alpha_{region}" for region in BODY_REGIONS]
    if not set(names) <= set(chain.names):
        return []
    flat = chain.flat()[:, [chain.names.index(name) for name in names]]
    chosen = flat[np.linspace(0, len(flat) - 1, min(_DRAWS, len(flat))).astype(int)]
    return [
        {"participant_id": patient.identifier, "region": region, "draw": k, "alpha": value}
        for k, draw in enumerate(chosen)
        for region, value in zip(BODY_REGIONS, draw.tolist(), strict=True)
    ]
