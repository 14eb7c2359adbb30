"""What tracking leaves in a folder: motion.npz, the surfaces of all frames as a series, transients."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tomli_w

from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.base.errors import StorageError
from lacli.base.files import replacing, write_json, write_text
from lacli.base.schema import write_arrays
from lacli.contracts.bundle import Bundle
from lacli.contracts.features import kind_of, parse
from lacli.contracts.priors import prior_tables
from lacli.contracts.tables.covariance import write_covariance
from lacli.geometry.subdivision import straight
from lacli.motion.annulus import ERROR, annulus_points
from lacli.motion.axes import nodal_axes
from lacli.motion.errors.drift import widened
from lacli.motion.errors.uncertainty import ErrorModel
from lacli.motion.patient import Tracked
from lacli.motion.phases import Phases
from lacli.motion.targets import Covaried

COVARIANCE = "targets_covariance.npz"
# drawn later, of what is written here
PICTURES = ("transients.png", "surfaces.png", "slices.png", "motion.gif")
_PRODUCTS = ("motion.npz", "transients.csv", "targets.toml", COVARIANCE, "frames")


def write_series(folder: Path, bundle: Bundle, surface: Endocardium, times: FloatArray, positions: FloatArray) -> Path:
    """One VTP a frame of the cavity's surface and ``series.pvd``, which ParaView opens as an animation.

    positions (f, n, 3) mm of the bundle's points. Point arrays: wall_point (id in the bundle), displacement (3) mm from ED; on
    the points of the body also its components normal_mm (out of the cavity), alpha_mm, beta_mm along the universal coordinates.
    """
    import pyvista as pv

    folder.mkdir(parents=True, exist_ok=True)
    faces = bundle.cavity_triangles()
    # 6-node faces are cut in four, normals turned out of the cavity
    triangles = straight(faces)[:, ::-1]
    used, local = np.unique(triangles, return_inverse=True)
    cells = np.column_stack([np.full(len(triangles), 3), local.reshape(-1, 3)]).ravel()
    axes = nodal_axes(bundle, surface)
    entries = []
    for number, (time, x) in enumerate(zip(times, positions, strict=True)):
        mesh = pv.PolyData(x[used], cells)
        moved = (x - bundle.points)[used]
        mesh.point_data["wall_point"] = used.astype(np.int64)
        mesh.point_data["displacement"] = moved
        for name, axis in axes.items():
            mesh.point_data[f"{name}_mm"] = (moved * axis[used]).sum(axis=1)
        with replacing(folder / f"frame_{number:02d}.vtp") as temporary:
            mesh.save(temporary)
        entries.append(f'    <DataSet timestep="{time:.6g}" file="frame_{number:02d}.vtp"/>')
    head = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "  <Collection>"]
    write_text(folder / "series.pvd", "\n".join([*head, *entries, "  </Collection>", "</VTKFile>"]) + "\n")
    return folder / "series.pvd"


def check_replaceable(folder: Path) -> None:
    """Before the work: StorageError where results would replace files in the folder that tracking did not write."""
    in_the_way = [name for name in _PRODUCTS if (folder / name).exists()]
    if in_the_way and not (folder / "tracking.json").is_file():
        raise StorageError(f"{folder}: holds {', '.join(in_the_way)} that `lacli track` did not write; choose another --out.")


def write_all(folder: Path, bundle: Bundle, tracked: Tracked, found: Covaried, notes: Mapping[str, Any]) -> dict[str, Any]:
    """motion.npz, transients.csv, targets.toml with its covariance, frames/, tracking.json into a folder; what the last says."""
    course = tracked.course
    phases = course.phases
    ids = annulus_points(bundle)
    normal, tangential = _mean_error(tracked)
    endo = np.unique(bundle.cavity_triangles())
    annulus = _annulus(tracked, course.positions[:, ids])
    # one file: what a simulation needs of the annulus, and beside it what was tracked and how well
    arrays = {
        "times": course.times, "wall_point": ids, "es_time": phases.es,
        "positions": tracked.annulus.undone(course.positions[:, ids]),
        "endo_point": endo, "endo_positions": course.positions[:, endo], "engine": str(tracked.info["engine"]),
        "error_normal_mm": normal, "error_tangential_mm": tangential,
        "annulus_share": annulus["share"], ERROR: annulus["es_error_mm"],
    }  # fmt: skip
    write_arrays(folder / "motion.npz", arrays)
    rows = [
        {"time": float(t), "phase": phases.name(float(t)), **row} for t, row in zip(course.times, course.features, strict=True)
    ]
    with replacing(folder / "transients.csv") as temporary:
        pd.DataFrame(rows).to_csv(temporary, index=False)
    write_covaried(folder, found, phases, str(tracked.info["engine"]))
    write_series(folder / "frames", bundle, course.surface, course.times, course.positions)
    info = {
        **tracked.info,
        **notes,
        "times": course.times.tolist(),
        "phases": asdict(phases),
        **_errors(tracked),
        "annulus": annulus,
    }
    write_json(folder / "tracking.json", info)
    return info


def write_covaried(folder: Path, found: Covaried, phases: Phases, engine: str) -> None:
    """targets.toml, and targets_covariance.npz (names, covariance) that it names."""
    tables = {}
    for name, mean, sd in zip(found.targets.names, found.targets.mean, found.targets.sd, strict=True):
        tables[name] = {
            "mean": float(mean),
            "sd": float(sd),
            "unit": parse(name)[0].unit or "1",
            "source": f"lacli track, {engine}",
        }
    document: dict[str, Any] = {
        "es_time": phases.es,
        "nearest_frame_to_es": phases.es_gap,
        "covariance": COVARIANCE,
        "targets": tables,
    }
    if found.targets.priors:
        document["priors"] = prior_tables(found.targets.priors)
    write_covariance(folder / COVARIANCE, found.targets.names, found.covariance)
    write_text(folder / "targets.toml", tomli_w.dumps(document))


def _mean_error(tracked: Tracked) -> tuple[float, float]:
    """Means over the known motions, mm; where none was made, as stated."""
    if not tracked.known:
        return float(tracked.info["error_normal_mm"]), float(tracked.info["error_tangential_mm"])
    normal = [error.normal["global"] for _, error in tracked.known]
    tangential = [error.tangential["global"] for _, error in tracked.known]
    return float(np.mean(normal)), float(np.mean(tangential))


def _errors(tracked: Tracked) -> dict[str, Any]:
    return {
        "known_motion": [{"time": time, **asdict(error)} for time, error in tracked.known],
        "ed_residual": None if tracked.ed_residual is None else asdict(tracked.ed_residual),
        "closure_mm": tracked.closure_mm,
        "correlation_between_frames": _between(tracked.model),
        "sd": dict(zip(tracked.model.keys, tracked.model.sd.tolist(), strict=True)),
        "shrinkage": _shrinkage(tracked),
    }


def _between(model: ErrorModel) -> dict[str, float]:
    """By kind of feature, how an error goes along between frames."""
    by_key = np.broadcast_to(model.between, (len(model.keys),))
    return {kind_of(key)[0]: float(value) for key, value in zip(model.keys, by_key, strict=True)}


def _annulus(tracked: Tracked, positions: FloatArray) -> dict[str, float]:
    """What is said of the annulus, positions (f, n, 3) mm as tracked: the share found too much, which ``motion.npz`` no longer
    has, its sd, the error beside it; how far its points have gone at the frame nearest end-systole, and their error there."""
    course, error = tracked.course, tracked.annulus
    frame = int(np.argmin(np.abs(course.times - course.phases.es)))
    moved = error.undone(positions)[frame] - positions[0]
    wider = float(widened(course.times[frame], course.closed))
    length = float(np.linalg.norm(moved, axis=1).mean())
    return {**asdict(error), "es_displacement_mm": length, "es_error_mm": error.at(moved, wider)}


def _shrinkage(tracked: Tracked) -> dict[str, dict[str, float]] | None:
    """By kind of feature: the share of a change that registration finds too much, which targets and transients no longer have,
    its sd, and the sd by which a region's own differs from it."""
    found = tracked.model.shrinkage
    if found is None:
        return None
    return {
        kind_of(key)[0]: {"share": float(share), "sd": float(sd), "regional": float(regional)}
        for key, share, sd, regional in zip(
            found.keys, found.share, found.sd, np.broadcast_to(found.regional, (len(found.keys),)), strict=True
        )
    }
