"""One scene from start to end: deck, FreeFEM, features, files. The run's folder is complete or is not there."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pandas as pd

from lacli.anatomy.surface_features import cavity_volume_ml, displacements_mm
from lacli.base import resources
from lacli.base.arrays import FloatArray
from lacli.base.errors import SimulationError
from lacli.base.files import write_json, write_text
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle
from lacli.contracts.motion import Motion
from lacli.contracts.scene import MMHG_KPA, Scene
from lacli.freefem import program as freefem
from lacli.mechanics import engine, inputs
from lacli.mechanics.accuracy import known_errors
from lacli.mechanics.deck import render
from lacli.mechanics.features import cell_gradient, regional_extras
from lacli.mechanics.plan import Plan, make_plan
from lacli.mechanics.store import OpenRun, StoredRun, open_run
from lacli.motion.annulus import scene_motion

OnProgress = Callable[[freefem.Progress], None]


@dataclass(frozen=True)
class RunResult:
    """An ended run; ``features`` as in features.json (empty for a failed one), ``kind`` and ``message`` of a failure."""

    key: str
    folder: Path
    status: str
    kind: str | None
    message: str
    features: dict[str, Any]
    manifest: dict[str, Any]


@dataclass(frozen=True)
class State:
    """Positions x and reference positions X (n, 3) mm in the bundle's numbering; pressure in kPa."""

    x: FloatArray
    reference: FloatArray
    pressure: float
    min_jacobian: float


def run_scene(scene: Scene, root: Path, on_progress: OnProgress | None = None) -> RunResult:
    """Simulate, or return what is stored for the same content. A simulation that fails is a result, not an exception.

    Raises AnatomyError, SceneError, SolverMissingError, StorageError.
    """
    bundle = bundles.load(scene.anatomy.bundle)
    motion = scene_motion(scene, bundle)
    plan = make_plan(scene, bundle, motion)
    with open_run(root, scene) as run:
        if run.stored is None:
            _simulate(run, scene, bundle, motion, plan, on_progress)
        assert run.stored is not None
        return _result(run.stored)


def _result(stored: StoredRun) -> RunResult:
    features = stored.features() if stored.status == "done" else {}
    return RunResult(stored.key, stored.folder, stored.status, stored.kind, stored.message, features, stored.manifest)


def _simulate(
    run: OpenRun, scene: Scene, bundle: Bundle, motion: Motion | None, plan: Plan, on_progress: OnProgress | None
) -> None:
    folder = run.folder
    work = inputs.as_order(bundle, scene.numerics.order)
    moved = _renumbered(motion, bundle, scene.numerics.order)
    inputs.write_inputs(work, scene, plan, moved, folder)
    script = folder / "deck.edp"
    plugin = engine.choose(scene)
    write_text(script, render(scene, plan, plugin))

    def listen(line: str) -> None:
        progress = freefem.parse_progress(line)
        if progress is not None and on_progress is not None:
            on_progress(progress)

    solvers = resources.folder("solvers") / "freefem"
    outcome = freefem.run(freefem.find(), script, folder, scene.numerics.timeout_s, listen, includes=(solvers,))
    usage: dict[str, Any] = {
        "cpu_s": outcome.cpu_s,
        "peak_memory_mb": outcome.peak_memory_mb,
        "engine": engine.name(plugin),
        "versions": {"freefem": freefem.find().version},
    }
    if outcome.kind is not None and not (outcome.kind == "timeout" and _results_stand(folder)):
        _keep_last_state(work, plan, folder)
        _tidy(folder)
        run.finish("failed", kind=outcome.kind, message=outcome.message, **usage)
        return
    try:
        states, history = _read_states(work, plan, folder)
        features = _features(work, scene, plan, states, history)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise SimulationError("bad_output", f"{folder}: FreeFEM's results cannot be read ({error}).") from error
    features |= {"cpu_s": outcome.cpu_s, "peak_memory_mb": outcome.peak_memory_mb}
    if errors := known_errors(scene):
        features["discretisation_error"] = errors
    write_json(folder / "features.json", features)
    _write_transients(work, plan, states, folder)
    products = ["scene.toml", "deck.edp", "features.json", "transients.csv"]
    products += _write_fields(work, scene, plan, states, folder)
    _tidy(folder)
    run.finish("done", products=products, newton_iterations=features["newton_iterations"], **usage)


def _history(folder: Path) -> list[str]:
    """Whole lines of the deck's history; [] where there is none."""
    with contextlib.suppress(OSError):
        return (folder / "history.txt").read_text(encoding="ascii").split("\n")[:-1]
    return []


def _results_stand(folder: Path) -> bool:
    """Whether end-systole was reached: only the unloaded state, an extra, may still be missing."""
    return "end" in _history(folder)


def _renumbered(motion: Motion | None, bundle: Bundle, order: int) -> Motion | None:
    """The motion with point ids of the mesh of that order."""
    if motion is None or order == bundle.order:
        return motion
    kept = inputs.corner_ids(bundle, order)
    inside = np.isin(motion.wall_point, kept)
    ids = np.searchsorted(kept, motion.wall_point[inside])
    return Motion(motion.times, ids, motion.positions[:, inside], motion.es_time)


def _read_states(bundle: Bundle, plan: Plan, folder: Path) -> tuple[dict[str, State], dict[str, list[float]]]:
    """States by name in order of time, and the other lines of the history."""
    states: dict[str, State] = {}
    other: dict[str, list[float]] = {}
    lines = _history(folder)
    if "end" not in lines:
        raise ValueError("history.txt has no end")
    for line in lines:
        words = line.split()
        if len(words) >= 5 and words[0] == "state":
            table = np.loadtxt(folder / f"{words[1]}.txt").reshape(-1, 6)
            if len(table) != len(bundle.points) or not np.isfinite(table).all():
                raise ValueError(f"{words[1]}.txt is incomplete")
            states[words[1]] = State(table[:, :3], table[:, 3:], float(words[2]), float(words[4]))
        elif words and words[0] != "end":
            other[words[0]] = [float(word) for word in words[1:]]
    if "ed" not in states or "es" not in states:
        raise ValueError("history.txt lacks a state")
    return states, other


def _features(
    bundle: Bundle, scene: Scene, plan: Plan, states: dict[str, State], history: dict[str, list[float]]
) -> dict[str, Any]:
    image = bundle.points
    es = states["es"]
    features: dict[str, Any] = {
        "edv_ml": cavity_volume_ml(bundle, states["ed"].x),
        "esv_ml": cavity_volume_ml(bundle, es.x),
        **displacements_mm(bundle, image, es.x),
        "unloaded_volume_ml": _unloaded_volume(bundle, plan, states),
    }
    if plan.unloading:
        volume, mean, p95, iterations = history["ed_error"]
        features |= {"ed_volume_error": volume, "ed_shape_error_mean_mm": mean, "ed_shape_error_p95_mm": p95}
        features |= {"unloading_iterations": int(iterations), "ed_unstable_modes": int(history["ed_modes"][0])}
    else:
        features |= {"ed_volume_error": 0.0, "ed_shape_error_mean_mm": 0.0, "ed_shape_error_p95_mm": 0.0}
    unknowns, newton, steps, backs = (int(v) for v in history["counts"])
    features |= {
        "es_unstable_modes": int(history["es_modes"][0]),
        "min_jacobian": min(state.min_jacobian for name, state in states.items() if name != "unloaded"),
        "unknowns": unknowns,
        "newton_iterations": newton,
        "load_steps": steps,
        "steps_back": backs,
    }
    if scene.outputs.strain:
        features |= regional_extras(bundle, states["ed"].x, es.x)
    return features


def _unloaded_volume(bundle: Bundle, plan: Plan, states: dict[str, State]) -> float | None:
    """Cavity volume without pressure, mL; None where it was not asked for or did not converge."""
    if plan.prestrain:
        return cavity_volume_ml(bundle, states["unloaded"].x) if "unloaded" in states else None
    return cavity_volume_ml(bundle, states["es"].reference)


def _write_transients(bundle: Bundle, plan: Plan, states: dict[str, State], folder: Path) -> None:
    by_file = {phase.file: phase for phase in plan.phases if phase.name != "load"}
    rows = []
    for name, state in states.items():
        if name == "unloaded":
            continue
        phase = by_file.get(name)
        rows.append(
            {
                "time": phase.time_to if phase else 0.0,
                "phase": phase.name if phase else "ed",
                "pressure_mmhg": state.pressure / MMHG_KPA,
                "volume_ml": cavity_volume_ml(bundle, state.x),
                **displacements_mm(bundle, bundle.points, state.x),
            }
        )
    pd.DataFrame(rows).to_csv(folder / "transients.csv", index=False)


def _write_fields(bundle: Bundle, scene: Scene, plan: Plan, states: dict[str, State], folder: Path) -> list[str]:
    """VTU files of the asked states and a .pvd; their names relative to the folder."""
    if scene.outputs.fields == "none":
        return []
    (folder / "fields").mkdir(exist_ok=True)
    names = ["ed", "es"] if scene.outputs.fields == "es" else [name for name in states if name != "unloaded"]
    free = states["unloaded"].x if "unloaded" in states else None if plan.prestrain else states["es"].reference
    times = {phase.file: phase.time_to for phase in plan.phases if phase.name != "load"}
    entries, products = [], []
    for name in names:
        file = f"fields/{name}.vtu"
        write_state(bundle, states[name].x, free, folder / file)
        entries.append(f'    <DataSet timestep="{times.get(name, 0.0):.6g}" file="{name}.vtu"/>')
        products.append(file)
    if free is not None:
        write_state(bundle, free, free, folder / "fields" / "unloaded.vtu")
        products.append("fields/unloaded.vtu")
    pvd = [
        '<?xml version="1.0"?>',
        '<VTKFile type="Collection" version="0.1">',
        "  <Collection>",
        *entries,
        "  </Collection>",
        "</VTKFile>",
    ]
    write_text(folder / "fields" / "series.pvd", "\n".join(pvd) + "\n")
    return [*products, "fields/series.pvd"]


def write_state(bundle: Bundle, x: FloatArray, unloaded: FloatArray | None, file: Path) -> None:
    """One state as VTU: deformed points, displacement from the image and, where known, from the unloaded state (mm), regions,
    fibres."""
    kind = "tetra" if bundle.order == 1 else "tetra10"
    cell_data: dict[str, list[Any]] = {"region": [bundle.region.astype(np.int32)]}
    if bundle.fibre is not None:
        moved = np.einsum("mij,mj->mi", cell_gradient(bundle, bundle.points, x), bundle.fibre)
        cell_data["fibre"] = [moved / np.linalg.norm(moved, axis=1, keepdims=True)]
    point_data = {"displacement": x - bundle.points}
    if unloaded is not None:
        point_data["displacement_from_unloaded"] = x - unloaded
    meshio.Mesh(x, [(kind, bundle.tets)], point_data=point_data, cell_data=cell_data).write(file, binary=True, compression="zlib")


def _keep_last_state(bundle: Bundle, plan: Plan, folder: Path) -> None:
    """The state a failed run had reached, as VTU, where the deck wrote one."""
    file = folder / "last.txt"
    with contextlib.suppress(OSError, ValueError):
        table = np.loadtxt(file).reshape(-1, 6)
        if len(table) == len(bundle.points) and np.isfinite(table).all():
            (folder / "fields").mkdir(exist_ok=True)
            write_state(bundle, table[:, :3], None if plan.prestrain else table[:, 3:], folder / "fields" / "last.vtu")


def _tidy(folder: Path) -> None:
    """Remove the deck's inputs and raw states; all that is in them is in the bundle and in fields/."""
    for file in [*folder.glob("*.txt"), *folder.glob("*.txt.part"), folder / "wall.mesh"]:
        file.unlink(missing_ok=True)
