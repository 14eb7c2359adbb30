"""What a finished deck left in its folder: states of the wall, features, transients, fields for ParaView."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pandas as pd

from lacli.anatomy.surface_features import Endocardium, cavity_volume_ml
from lacli.base.arrays import FloatArray
from lacli.base.errors import SimulationError
from lacli.base.files import write_text
from lacli.contracts.bundle import Bundle
from lacli.contracts.case import Case
from lacli.contracts.features import KEYS, at_time
from lacli.contracts.sections import MMHG_KPA
from lacli.freefem.files import read_history, read_state
from lacli.mechanics.features import cell_gradient, regional_extras

FIELDS, HISTORY = "fields", "history.txt"
EQUILIBRIA = "equilibria"  # the history's line of a second way to end-systole
OTHER = "es_other"  # among the fields: the equilibrium that was found too
_RAW = ("txt", "txt.part", "rates", "state", "start")  # endings of what a deck reads and writes
_STATE = "state_"  # begins a state's line of the history


@dataclass(frozen=True)
class State:
    """Positions x and reference positions X (n, 3) mm in the bundle's numbering; pressure in kPa."""

    x: FloatArray
    reference: FloatArray
    pressure: float
    min_jacobian: float


TRANSIENTS = "transients.csv"


@dataclass(frozen=True)
class Results:
    """states by name in order of time (``ed``, the frames, ``es``, and ``unloaded`` where it was found); counts and errors of
    the deck's history by name, under the first word of their line; other: positions (n, 3) mm of the end-systole that was
    found too and is not the result."""

    states: dict[str, State]
    numbers: dict[str, dict[str, float]]
    other: FloatArray | None = None


def read(case: Case, folder: Path) -> Results:
    """The results in the folder of a deck that has run. Raises SimulationError where they are incomplete."""
    try:
        return _read(case, folder)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise SimulationError("bad_output", f"{folder}: FreeFEM's results cannot be read ({error}).") from error


def _read(case: Case, folder: Path) -> Results:
    states: dict[str, State] = {}
    numbers: dict[str, dict[str, float]] = {}
    lines = read_history(folder / HISTORY)
    if "end" not in lines:
        raise ValueError(f"{HISTORY} has no end")
    for word, said in lines.items():
        if word.startswith(_STATE):
            name = word.removeprefix(_STATE)
            x, reference = read_state(folder / f"{name}.txt", len(case.bundle.points))
            states[name] = State(x, reference, said["pressure_kpa"], said["min_j"])
        elif word != "end":
            numbers[word] = said
    lacking = [name for name in ("ed", "es") if name not in states]
    needed = ("counts", "es_modes", *(("ed_error", "ed_modes") if case.plan.unloading else ()))
    lacking += [name for name in needed if name not in numbers]
    if lacking:
        raise ValueError(f"{HISTORY} lacks {', '.join(lacking)}")
    found = numbers.get(EQUILIBRIA, {}).get("found")
    other = read_state(folder / "other.txt", len(case.bundle.points))[0] if found == 2 else None
    return Results(states, numbers, other)


def stand(folder: Path) -> bool:
    """Whether end-systole was reached: only the unloaded state, an extra, may still be missing."""
    try:
        return "end" in read_history(folder / HISTORY)
    except (OSError, ValueError):
        return False


def features(case: Case, results: Results) -> dict[str, Any]:
    """Features at end-systole and what is known of the way there, by name with unit."""
    bundle, states, numbers = case.bundle, results.states, results.numbers
    es = states["es"]
    surface = Endocardium.of(bundle).features(es.x)
    found: dict[str, Any] = {
        "edv_ml": cavity_volume_ml(bundle, states["ed"].x),
        "esv_ml": surface.pop("volume_ml"),
        **surface,
        "unloaded_volume_ml": _unloaded_volume(case, results),
    }
    if case.plan.unloading:
        error = numbers["ed_error"]
        found |= {
            "ed_volume_error": error["volume"], "ed_shape_error_mean_mm": error["mean_mm"],
            "ed_shape_error_p95_mm": error["p95_mm"], "unloading_iterations": int(error["iterations"]),
            "ed_unstable_modes": int(numbers["ed_modes"]["unstable"]),
        }  # fmt: skip
        if rest := numbers.get("rest"):
            found |= {"rest_move_mean_mm": rest["mean_mm"], "rest_move_max_mm": rest["max_mm"]}
    else:
        found |= {"ed_volume_error": 0.0, "ed_shape_error_mean_mm": 0.0, "ed_shape_error_p95_mm": 0.0}
    counts = {name: int(value) for name, value in numbers["counts"].items()}
    found |= {
        "es_unstable_modes": int(numbers["es_modes"]["unstable"]),
        "min_jacobian": min(state.min_jacobian for name, state in states.items() if name != "unloaded"),
        "unknowns": counts["unknowns"],
        "newton_iterations": counts["newton"],
        "load_steps": counts["steps"],
        "steps_back": counts["backs"],
        "factorisations": counts["factors"],
    }
    if case.scene.outputs.strain:
        found |= regional_extras(bundle, states["ed"].x, es.x)
    return found


def _unloaded_volume(case: Case, results: Results) -> float | None:
    """Cavity volume without pressure, mL; None where it was not asked for or did not converge."""
    free = _unloaded(case, results)
    return None if free is None else cavity_volume_ml(case.bundle, free)


def _unloaded(case: Case, results: Results) -> FloatArray | None:
    """Points (n, 3) mm without pressure; None where they are not known."""
    if "unloaded" in results.states:
        return results.states["unloaded"].x
    return None if case.plan.prestrain else results.states["es"].reference


def unstable_modes(results: Results) -> dict[str, int]:
    """Unstable modes of the states whose tangents the run has looked at, by name: of end-diastole under pressure, of end-systole,
    and of frames with derivatives."""
    lines = {name: results.numbers.get(f"sensitivities_{name}", {}) for name in results.states}
    lines |= {name: results.numbers.get(f"{name}_modes", {}) for name in ("ed", "es")}
    # less than 0: it cannot be factorised
    return {name: int(line["unstable"]) for name, line in lines.items() if line.get("unstable", -1) >= 0}


def transients(case: Case, results: Results) -> pd.DataFrame:
    """Pressure, volume and the endocardium's features from end-diastole, a row for each state in order of time; last the
    unstable modes, where they are known."""
    endocardium = Endocardium.of(case.bundle)
    unstable = unstable_modes(results)
    by_file = {phase.file: phase for phase in case.plan.stretches()}
    rows = []
    for name, state in results.states.items():
        if name == "unloaded":
            continue
        phase = by_file.get(name)
        rows.append(
            {
                "time": phase.time_to if phase else 0.0,
                "phase": phase.name if phase else "ed",
                "pressure_mmhg": state.pressure / MMHG_KPA,
                **endocardium.features(state.x),
                "unstable_modes": unstable.get(name),
            }
        )
    return pd.DataFrame(rows).astype({"unstable_modes": "Int64"}).sort_values("time", ignore_index=True)


def features_at_times(folder: Path) -> tuple[dict[str, float], float]:
    """Features at each time of a stored run's transients by name, ``<key>@<time>``, and end-systole's (fractions of RR)."""
    table = pd.read_csv(folder / TRANSIENTS)
    found = {at_time(key, float(row["time"])): float(row[key]) for row in table.to_dict("records") for key in KEYS if key in row}
    reservoir = table.loc[table["phase"] == "reservoir", "time"]
    return found, float(reservoir.max())


def write_fields(case: Case, results: Results, folder: Path) -> list[str]:
    """Write VTU files of the states that the scene wants and a .pvd; their names relative to ``folder``."""
    wanted = case.scene.outputs.fields
    if wanted == "none":
        return []
    place = folder / FIELDS
    place.mkdir(exist_ok=True)
    states = results.states
    times = {phase.file: phase.time_to for phase in case.plan.stretches()}
    names = ["ed", "es"] if wanted == "es" else sorted(states.keys() - {"unloaded"}, key=lambda name: times.get(name, 0.0))
    free = _unloaded(case, results)
    entries = []
    for name in names:
        write_state(case.bundle, states[name].x, free, place / f"{name}.vtu")
        entries.append(f'    <DataSet timestep="{times.get(name, 0.0):.6g}" file="{name}.vtu"/>')
    if free is not None:
        write_state(case.bundle, free, free, place / "unloaded.vtu")
        names = [*names, "unloaded"]
    if results.other is not None:
        write_state(case.bundle, results.other, free, place / f"{OTHER}.vtu")
        names = [*names, OTHER]
    pvd = [
        '<?xml version="1.0"?>',
        '<VTKFile type="Collection" version="0.1">',
        "  <Collection>",
        *entries,
        "  </Collection>",
        "</VTKFile>",
    ]
    write_text(place / "series.pvd", "\n".join(pvd) + "\n")
    return [*(f"{FIELDS}/{name}.vtu" for name in names), f"{FIELDS}/series.pvd"]


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


def keep_last_state(case: Case, folder: Path) -> None:
    """The state a failed run had reached, as VTU, where the deck wrote one."""
    with contextlib.suppress(OSError, ValueError):
        x, reference = read_state(folder / "last.txt", len(case.bundle.points))
        (folder / FIELDS).mkdir(exist_ok=True)
        write_state(case.bundle, x, None if case.plan.prestrain else reference, folder / FIELDS / "last.vtu")


def tidy(folder: Path) -> None:
    """Remove the deck's inputs and raw states: they are written again from the scene, what is in them is in ``fields``."""
    raw = [file for ending in _RAW for file in folder.glob(f"*.{ending}")]
    for file in [*raw, folder / "wall.mesh"]:
        file.unlink(missing_ok=True)
