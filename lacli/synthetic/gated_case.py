"""A synthetic patient in a folder: bundle, gated CT, and beside it the truth that tracking and calibration should find."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lacli.anatomy.bundle_folder import check_replaceable
from lacli.anatomy.inputs import image as images
from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError
from lacli.base.files import write_json, write_text
from lacli.contracts.bundle import Bundle, load, save
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import dump_scene
from lacli.motion.annulus import annulus_points, descend
from lacli.motion.phases import phases_of, volume_spline
from lacli.motion.store import write_series
from lacli.synthetic import cycle, gated, kept
from lacli.synthetic.atrium import synthesize
from lacli.synthetic.gated import Acquisition

Monitor = Callable[[str, int, int], None]
ES_TIME = 0.4
DESCRIPTION = "gated.json"
METHOD = 3  # how a patient is made of seed and options: raised with what changes images or truth


def write_case(
    folder: Path,
    seed: int,
    atrium: dict[str, Any],
    parameters: dict[str, float],
    acquisition: Acquisition,
    heart_rate: float,
    monitor: Monitor,
) -> dict[str, Any]:
    """Write ``bundle/``, ``frames/``, ``scene.toml`` and ``truth/`` (transients.csv, endocardium.npz, surfaces, parameters.json).

    atrium: the arguments of synthesize but the seed. The folder appears whole or not at all. Returns what gated.json says.
    """
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        info = _write(partial, seed, atrium, parameters, acquisition, heart_rate, monitor)
        if folder.exists():
            folder.rmdir()
        partial.replace(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return info


def write_patient(
    folder: Path,
    seed: int,
    atrium: dict[str, Any],
    given: Mapping[str, float],
    acquisition: Acquisition,
    heart_rate: float,
    monitor: Monitor,
) -> dict[str, Any]:
    """What ``write_case`` returns, and the folder; a case that is there and was made from the same is kept as it is.

    given: known parameters; the others are drawn from the seed. Raises AnatomyError where the folder holds something else.
    """
    parameters = {**cycle.draw_parameters(seed), **given}
    made_from = {"seed": seed, "atrium": atrium, "acquisition": asdict(acquisition), "parameters": parameters}
    made_from |= {"heart_rate_bpm": heart_rate, "method": METHOD}
    info = finished(folder, made_from)
    if info is None:
        info = write_case(folder, seed, atrium, parameters, acquisition, heart_rate, monitor)
    return {"folder": str(folder), **info}


def finished(folder: Path, made_from: dict[str, Any]) -> dict[str, Any] | None:
    """What gated.json says of a folder made from the same; None where there is nothing. AnatomyError where there is another."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return None
    try:
        info = read_json(folder / DESCRIPTION, error=AnatomyError)
        same = all(info.get(name) == json.loads(json.dumps(value)) for name, value in made_from.items())
    except (AnatomyError, AttributeError, TypeError) as error:
        raise AnatomyError(f"{folder} exists and is no synthetic patient; choose another folder or remove it.") from error
    if not same:
        raise AnatomyError(f"{folder} holds a synthetic patient made from other options; choose another folder or remove it.")
    kept.check(folder, info)
    return dict(info)


def _write(
    folder: Path,
    seed: int,
    atrium: dict[str, Any],
    parameters: dict[str, float],
    acquisition: Acquisition,
    heart_rate: float,
    monitor: Monitor,
) -> dict[str, Any]:
    # cut where `mesh` cuts what it finds in the images: vein springs and pericardium are then at the same places
    bundle, _ = synthesize(seed, **atrium, at_ostia=True)
    # twenty frames of the annulus: its own course is finer than that of the images
    annulus = descend(bundle, frames=20, descent_mm=atrium["descent_mm"], es_time=ES_TIME)
    check_replaceable(folder / "bundle")
    save(bundle, folder / "bundle")
    save_motion(annulus, folder / "bundle")
    bundle = load(folder / "bundle")
    scene = cycle.cycle_scene((folder / "bundle").absolute(), parameters, annulus.es_time, bundle.order)
    monitor("simulating the cycle", 0, 1)
    moved = cycle.simulate(scene, folder / "runs")
    shutil.rmtree(folder / "runs")
    monitor("extending the motion", 0, 1)
    motion = cycle.SpaceMotion.extend(moved, bundle.points)
    image = gated.still(seed, atrium["volume_ml"], atrium["thickness_mm"], acquisition)
    for number, frame in enumerate(gated.frames(image.ct, motion, acquisition, seed)):
        monitor("imaging", number, acquisition.frames)
        images.write(frame, folder / "frames" / f"frame_{number:02d}.nrrd")
    write_text(folder / "scene.toml", dump_scene(scene).replace(str(folder.absolute()) + "/", ""))
    info = _write_truth(folder / "truth", bundle, motion, acquisition.times, parameters)
    info |= {
        "seed": seed,
        "atrium": atrium,
        "acquisition": asdict(acquisition),
        "heart_rate_bpm": heart_rate,
        "parameters": parameters,
        "method": METHOD,
    }
    info |= {"rr_ms": 60000.0 / heart_rate, "frame_times_ms": (acquisition.times * 60000.0 / heart_rate).tolist()}
    info[kept.FILES] = kept.digests(folder, DESCRIPTION)
    write_json(folder / DESCRIPTION, info)
    return info


def _write_truth(
    folder: Path, bundle: Bundle, motion: cycle.SpaceMotion, times: FloatArray, parameters: dict[str, float]
) -> dict[str, Any]:
    """The extended field itself is the truth: the bundle's points under it, and their features."""
    surface = Endocardium.of(bundle)
    positions = np.stack([bundle.points + motion.at(float(t))(bundle.points) for t in times])
    rows = [{"time": float(t), **surface.features(x)} for t, x in zip(times, positions, strict=True)]
    frame = pd.DataFrame(rows)
    dense = np.linspace(0.0, 1.0, 41)[:-1]
    volume = np.array([surface.features(bundle.points + motion.at(float(t))(bundle.points))["volume_ml"] for t in dense])
    phases = phases_of(dense, volume)
    at_es = surface.features(bundle.points + motion.at(phases.es)(bundle.points))
    folder.mkdir(parents=True)
    frame.to_csv(folder / "transients.csv", index=False)
    pd.DataFrame({"time": dense, "volume_ml": volume}).to_csv(folder / "volume.csv", index=False)
    write_json(folder / "parameters.json", parameters)
    write_json(folder / "es.json", {"es_time": phases.es, **at_es})
    points = np.unique(bundle.triangles[bundle.tags != 3])
    np.savez_compressed(
        folder / "points.npz", times=times, point=points, positions=positions[:, points], annulus=annulus_points(bundle)
    )
    write_series(folder / "surfaces", bundle, surface, times, positions)
    fitted = volume_spline(times, frame["volume_ml"].to_numpy())
    return {
        "es_time": phases.es,
        "edv_ml": float(frame["volume_ml"].iloc[0]),
        "esv_ml": at_es["volume_ml"],
        "d_global_mm": at_es["d_global_mm"],
        "frames_miss_es_volume_by_ml": at_es["volume_ml"] - float(np.max(fitted(np.linspace(0, 1, 500)))),
    }
