"""A synthetic cohort whose truth is known: atria like published ones, simulated on a finer mesh than they are calibrated on.

Three arms. ``heterogeneous``: every region its own stiffness. ``control``: one stiffness everywhere in a wall of one thickness,
so that nothing tells regions apart but shape and surroundings. ``thickness``: one stiffness, and a wall that is thin here and
thick there. What a study claims of an arm can so be held against what was put in.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd

from lacli.base.arrays import FloatArray
from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError, LacliError
from lacli.base.files import replacing, write_json, write_text
from lacli.contracts.bundle import Bundle, check, load, save
from lacli.contracts.features import at_time, parse
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.motion import Motion, save_motion
from lacli.contracts.priors import Prior
from lacli.contracts.scene import build_scene, dump_scene, with_parameters
from lacli.contracts.targets import Targets, write_targets
from lacli.mechanics.results import features_at_times
from lacli.mechanics.simulation import run_scene
from lacli.synthetic import kept
from lacli.synthetic.atrium import synthesize
from lacli.synthetic.cycle import LOADS, draw_parameters

Arm = Literal["heterogeneous", "control", "thickness"]
ARMS: tuple[Arm, ...] = get_args(Arm)
DESCRIPTION, PARTICIPANTS, SCENE, TRUTHS = "patient.json", "participants.csv", "scene.toml", "truths.csv"
FEATURES = ("esv_ml", "d_global_mm", *(f"d_{region}_mm" for region in BODY_REGIONS))
# what the targets are: those of the published calibration, what a tracked motion tells of each region at end-systole beside them,
# or that in frames of the reservoir phase too
_PARTS = ("n_{}_mm", "a_{}_mm", "b_{}_mm", "area_strain_{}")
_MOTION = tuple(part.format(r) for part in _PARTS for r in BODY_REGIONS)
FRAMES = (0.1, 0.2, 0.3)  # fractions of RR; end-systole is at .4
TARGETS = {
    "published": FEATURES,
    "motion": (*FEATURES, *_MOTION),
    "course": (*FEATURES, *_MOTION, *(at_time(key, t) for t in FRAMES for key in ("volume_ml", *_MOTION))),
}
FINER = 0.7  # edge length of the truth's cells over the calibration's; the truth's are quadratic as well
# errors of the targets (sd): those of displacements and volume at end-systole as tracking a CT of 1.5 mm has them
# (benchmarks/track.py); for the errors that registration really makes, image the atria (--gated)
SD_MM, SD_VOLUME = 0.35, 0.01  # of the end-diastolic volume
SD_STRAIN = 0.05
THIN_MM, THICK_MM = 1.2, 3.2
_MEAN_SD, _AROUND_SD = 0.25, 0.4  # of log alpha: between patients, and between a patient's regions
_STREAM = 20260417
_OF_MOTION = ("targets", "sd_strain")  # in a description only where targets are not the published ones


def drawn_parameters(seed: int, arm: Arm) -> dict[str, float]:
    """The truth of a seed's patient in an arm: alphas by region, pressures (mmHg), the pericardium's stiffness and end."""
    rng = np.random.default_rng([_STREAM, seed])
    patient, regions = rng.normal(0.0, _MEAN_SD), rng.normal(0.0, _AROUND_SD, len(BODY_REGIONS))
    log_alpha = np.log(1.4) + patient + (regions if arm == "heterogeneous" else 0.0)
    alpha = np.broadcast_to(np.clip(np.exp(log_alpha), 0.3, 3.6), (len(BODY_REGIONS),))
    drawn = {name: value for name, value in draw_parameters(seed).items() if not name.startswith("alpha_")}
    return {**{f"alpha_{r}": round(float(a), 4) for r, a in zip(BODY_REGIONS, alpha, strict=True)}, **drawn}


def varying(seed: int) -> Callable[[FloatArray], FloatArray]:
    """Wall thickness (k,) mm at points (k, 3) mm: THIN_MM to THICK_MM, its waves shifted by the seed."""
    shift = np.random.default_rng([_STREAM, seed, 1]).uniform(0.0, 2.0 * np.pi, 2)

    def thickness(points: FloatArray) -> FloatArray:
        x, y, z = points.T
        wave = np.sin(x / 14.0 + shift[0]) * np.cos(y / 12.0 + z / 16.0 + shift[1])
        return np.asarray(THIN_MM + (THICK_MM - THIN_MM) * 0.5 * (1.0 + wave))

    return thickness


def write_cohort(
    folder: Path,
    seeds: Sequence[int],
    arm: Arm,
    atrium: Mapping[str, Any],
    tell: Callable[[str], None],
    targets: str = "published",
) -> list[dict[str, Any]]:
    """A folder a patient (``bundle/``, ``targets.toml``, ``scene.toml``, ``truth.json``), participants.csv and truths.csv.

    atrium: the arguments of ``synthesize`` but the seed: those of the calibration's mesh. tell: called with what begins.
    targets: a key of ``TARGETS``. A patient who is there and was made from the same is kept. Gives what each patient.json says.
    Raises AnatomyError where a folder holds something else, LacliError where a simulation fails.
    """
    rows = []
    for seed in seeds:
        name = f"sub-{seed:02d}"
        tell(name)
        rows.append(_written(folder / name, seed, arm, dict(atrium), targets))
    people = pd.DataFrame(
        [
            {"participant_id": f"sub-{row['seed']:02d}", "arm": arm, "ed_volume_ml": round(row["edv_ml"], 1),
             **{column: f"sub-{row['seed']:02d}/{file}" for column, file in
                (("bundle", "bundle"), ("targets", "targets.toml"), ("scene", SCENE))}}
            for row in rows
        ]
    )  # fmt: skip
    truths = pd.DataFrame([{"participant_id": f"sub-{row['seed']:02d}", **row["parameters"]} for row in rows])
    for file, frame in ((PARTICIPANTS, people), (TRUTHS, truths)):
        with replacing(folder / file) as temporary:
            frame.to_csv(temporary, index=False)
    return rows


def _written(folder: Path, seed: int, arm: Arm, atrium: dict[str, Any], targets: str) -> dict[str, Any]:
    made_from: dict[str, Any] = {
        "seed": seed,
        "arm": arm,
        "atrium": atrium,
        "finer": FINER,
        "sd_mm": SD_MM,
        "sd_volume": SD_VOLUME,
        "priors": {name: [low, high] for name, (low, high, _) in LOADS.items()},
    }
    if targets != "published":
        made_from |= {"targets": targets, "sd_strain": SD_STRAIN}
    if (info := _finished(folder, made_from)) is not None:
        return {"folder": str(folder), **info}
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        info = {**made_from, **_write(partial, seed, arm, atrium, TARGETS[targets])}
        info[kept.FILES] = kept.digests(partial, DESCRIPTION)
        write_json(partial / DESCRIPTION, info)
        if folder.exists():
            folder.rmdir()
        partial.replace(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return {"folder": str(folder), **info}


def _finished(folder: Path, made_from: dict[str, Any]) -> dict[str, Any] | None:
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return None
    if not (folder / DESCRIPTION).is_file():
        raise AnatomyError(f"{folder} exists and is no patient of a synthetic cohort; choose another folder or remove it.")
    info = read_json(folder / DESCRIPTION, error=AnatomyError)
    if not isinstance(info, dict) or any(info.get(name) != made_from.get(name) for name in (*made_from, *_OF_MOTION)):
        raise AnatomyError(f"{folder} was made from another arm or other options; choose another folder or remove it.")
    kept.check(folder, info)
    return info


def _write(folder: Path, seed: int, arm: Arm, atrium: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    wall = varying(seed) if arm == "thickness" else None
    parameters = drawn_parameters(seed, arm)
    fine = {**atrium, "cell_size_mm": FINER * atrium["cell_size_mm"], "order": 2}
    _save(*synthesize(seed, **fine, wall=wall), folder / "truth_bundle")
    outputs: dict[str, Any] = {"frames": 0, "fields": "none"}
    if any("@" in name for name in names):
        outputs = {"times": FRAMES, "fields": "none"}
    scene = build_scene(
        {"anatomy": {"bundle": "truth_bundle"}, "numerics": {"order": 2}, "outputs": outputs},
        [], folder=folder.absolute(), where="the synthetic cohort",
    )  # fmt: skip
    result = run_scene(with_parameters(scene, parameters), folder / "runs")
    if result.status != "done":
        raise LacliError(f"{folder.name}: the simulation of the truth failed ({result.kind}): {result.message}")
    told = {**result.features, **features_at_times(result.folder)[0]}
    features = {name: float(told[name]) for name in (*names, "edv_ml")}
    for scrap in ("runs", "truth_bundle"):
        shutil.rmtree(folder / scrap)
    _save(*synthesize(seed, **atrium, wall=wall), folder / "bundle")
    _targets(folder / "targets.toml", features, names, seed)
    patients = build_scene(
        {"anatomy": {"bundle": "bundle"}, "numerics": {"order": atrium["order"]}, "outputs": {"frames": 0, "fields": "none"}},
        [], folder=folder.absolute(), where="the synthetic cohort",
    )  # fmt: skip
    write_text(folder / SCENE, dump_scene(patients).replace(str(folder.absolute()) + "/", ""))
    write_json(folder / "truth.json", {"parameters": parameters, "features": features})
    return {"parameters": parameters, "edv_ml": features["edv_ml"], "truth_cpu_s": float(result.features["cpu_s"])}


def _save(bundle: Bundle, motion: Motion, folder: Path) -> None:
    check(bundle, folder.name)
    save(bundle, folder)
    save_motion(motion, folder)
    load(folder)


def _targets(file: Path, features: Mapping[str, float], names: tuple[str, ...], seed: int) -> None:
    """The truth's features with errors drawn."""
    true = np.array([features[name] for name in names])
    of_unit = {"mm": SD_MM, "mL": SD_VOLUME * features["edv_ml"], "": SD_STRAIN}
    sd = np.array([of_unit[parse(name)[0].unit] for name in names])
    noise = np.random.default_rng([_STREAM, seed, 2]).standard_normal(len(true))
    # intervals promise something over the prior alone, and stiffness goes with the loads: what these are drawn from is stated
    write_targets(file, Targets(names, true + sd * noise, sd, priors=load_priors()))


def load_priors() -> tuple[Prior, ...]:
    """What is known of the loads: the ranges that they are drawn from."""
    return tuple(Prior(name, "uniform", math.nan, math.nan, low, high) for name, (low, high, _) in LOADS.items())
