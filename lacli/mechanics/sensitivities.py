"""Derivatives of a run's features by the study's inputs.

The deck has solved for the derivatives of its states (``solvers/freefem/sensitivities.idp``); here the chain rule takes them to
the features. ``sensitivities.csv`` has a row for each feature (``esv_ml``, ``d_roof_mm``, ``d_roof_mm@0.2``: at a frame's time)
and a column for each input of the scene's parameter table; the units are those in the two names, a feature's over an input's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.base.errors import SimulationError, TableError
from lacli.contracts.case import Case
from lacli.contracts.features import at_time
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.sections import KPA_PER_UM_KPA_PER_MM, MMHG_KPA
from lacli.freefem.names import Rates
from lacli.mechanics.features import regional_extras
from lacli.mechanics.results import Results

FILE = "sensitivities.csv"
VEIN_SPRING = "vein_spring_kpa_per_um"
# the engine's columns in order (plugin/sensitivities.hpp), with the engine's unit in units of the input
INPUTS: dict[str, float] = {
    **{f"c_{name}_kpa": 1.0 for name in BODY_REGIONS},
    **{f"alpha_{name}": 1.0 for name in BODY_REGIONS},
    "edp_mmhg": MMHG_KPA,
    "esp_mmhg": MMHG_KPA,
    "k_peri_kpa_per_um": KPA_PER_UM_KPA_PER_MM,
    "pth": 1.0,
    VEIN_SPRING: KPA_PER_UM_KPA_PER_MM,
}


def modelled(case: Case) -> list[str]:
    """The inputs that the case has: those of a pericardium or of vein springs only where they are modelled."""
    absent = set()
    if not case.plan.pericardium:
        absent |= {"k_peri_kpa_per_um", "pth"}
    if not case.plan.vein_springs:
        absent.add(VEIN_SPRING)
    return [name for name in INPUTS if name not in absent]


def read_rates(case: Case, name: str, folder: Path) -> FloatArray:
    """(inputs, n, 3) derivatives of a state's points along INPUTS, mm per unit of the input.

    Raises SimulationError where the deck's file is missing or incomplete.
    """
    n = len(case.bundle.points)
    try:
        rates = np.fromfile(folder / f"{name}.rates", dtype="<f8")
    except OSError as error:
        raise SimulationError("bad_output", f"{folder}: the sensitivities of {name} cannot be read ({error}).") from error
    if rates.size != len(INPUTS) * 3 * n or not np.isfinite(rates).all():
        raise SimulationError("bad_output", f"{folder}: {name}.rates is incomplete.")
    units = np.array(list(INPUTS.values()))
    return np.moveaxis(rates.reshape(len(INPUTS), 3, n), 1, 2) * units[:, None, None]


def feature_rates(case: Case, results: Results, folder: Path) -> pd.DataFrame | None:
    """Derivatives of all features by all inputs modelled; None where none are asked for or there are no unbroken ones.

    Index: features; columns: inputs. A state without derivatives (unstable, or a solver's failure: ``statement`` says which) has
    no rows. Raises SimulationError.
    """
    rows: dict[str, FloatArray] = {}
    endocardium = Endocardium.of(case.bundle)
    for name, given in _given(results).items():
        if not given:
            continue
        rates = read_rates(case, name, folder)
        found = endocardium.rates(results.states[name].x, rates)
        if name == "es":
            # the prestrain keeps the image, whatever the inputs; a wall that has settled from there does not
            settled = _given(results).get("ed")
            ed = read_rates(case, "ed", folder) if settled else np.zeros_like(rates)
            if settled is not False:
                rows["edv_ml"] = endocardium.rates(results.states["ed"].x, ed)["volume_ml"]
            rows["esv_ml"] = found.pop("volume_ml")
            rows |= found
            if settled is not False and case.scene.outputs.strain:
                rows |= _extras(case, results, rates, ed)
        elif name != "ed":
            time = next(phase.time_to for phase in case.plan.stretches() if phase.file == name)
            rows |= {at_time(key, time): value for key, value in found.items()}
    if not rows:
        return None
    return pd.DataFrame(rows, index=list(INPUTS)).T[modelled(case)] + 0.0  # no -0.0


def write(case: Case, results: Results, folder: Path) -> list[str]:
    """Write ``sensitivities.csv`` where there are any; the names of what was written, relative to ``folder``."""
    table = feature_rates(case, results, folder)
    if table is None:
        return []
    table.to_csv(folder / FILE, index_label="feature")
    return [FILE]


def _extras(case: Case, results: Results, rates: FloatArray, ed_rates: FloatArray) -> dict[str, FloatArray]:
    """Derivatives of ``regional_extras``: central differences of the function, along each input's move of the points."""
    ed, es = results.states["ed"].x, results.states["es"].x
    columns = []
    for move, ed_move in zip(rates, ed_rates, strict=True):
        size = float(max(np.abs(move).max(), np.abs(ed_move).max()))
        h = 1e-4 / size if size > 0 else 1.0
        ahead = regional_extras(case.bundle, ed + h * ed_move, es + h * move)
        behind = regional_extras(case.bundle, ed - h * ed_move, es - h * move)
        columns.append({key: (ahead[key] - behind[key]) / (2 * h) for key in ahead})
    return {key: np.array([column[key] for column in columns]) for key in columns[0]} if columns else {}


def _given(results: Results) -> dict[str, bool]:
    """States that the deck was asked for, and whether it gave their derivatives."""
    prefix = "sensitivities_"
    return {key.removeprefix(prefix): bool(value["given"]) for key, value in results.numbers.items() if key.startswith(prefix)}


_WRONG: dict[int, str] = {
    Rates.STATE: "the prestrain's tangent", Rates.FACTORS: "its factors", Rates.SLOPES: "the residual's derivatives",
    Rates.SOLUTION: "the linear solver", Rates.FILE: "writing",
}  # fmt: skip


def statement(case: Case, results: Results) -> dict[str, Any] | None:
    """What features and manifest say: whether there are any, by state ``given`` or ``none`` and why; None where sensitivities
    were not asked for."""
    if not case.scene.outputs.sensitivities:
        return None
    if not case.plan.sensitivities:
        if case.plan.rest_sweeps:
            return {"given": False, "why": "springs at rest where the wall relaxes have none; set numerics.rest_sweeps to 0"}
        return {"given": False, "why": "backward displacement has none; set numerics.unloading to prestrain"}
    if not _given(results):
        return {"given": False, "why": "only the compiled engine has them; `lacli doctor` says what it needs"}
    said: dict[str, Any] = {"given": any(_given(results).values())}
    for name, given in _given(results).items():
        line = results.numbers[f"sensitivities_{name}"]
        modes, wrong = int(line["unstable"]), int(line["wrong"])
        if given:
            said[name] = "given"
        elif modes != 0:
            said[name] = f"none: {modes} unstable modes" if modes > 0 else "none: the tangent cannot be factorised"
        else:
            said[name] = f"none: {_WRONG.get(wrong, 'the deck')} failed"
    if case.plan.unloading:
        said["ed_unstable_modes"] = int(results.numbers["ed_modes"]["unstable"])
    return said


def load_sensitivities(folder: Path) -> pd.DataFrame | None:
    """Of a run's folder: rows features, columns inputs; None where the run has none. Raises TableError for a damaged file."""
    file = folder / FILE
    if not file.is_file():
        return None
    try:
        table = pd.read_csv(file, index_col="feature")
        values = table.to_numpy(dtype=float)
    except (OSError, ValueError, KeyError) as error:
        raise TableError(f"{file}: no table of sensitivities ({error}); remove the run's folder and simulate again.") from error
    if not values.size or not np.isfinite(values).all():
        raise TableError(f"{file}: a derivative is missing or not finite; remove the run's folder and simulate again.")
    return table
