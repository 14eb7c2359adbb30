"""How the patients' features converge with the mesh: the model's errors over sizes of cells, and those that were measured."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.errors import AnatomyError, InputError
from lacli.contracts.bundle import load
from lacli.contracts.features import PUBLISHED
from lacli.mechanics.numerics.accuracy import kept_errors
from lacli.mechanics.numerics.error_model import model_errors, resolution

MEASURED, MODEL = "measured", "model"
_SIZES = tuple(np.geomspace(0.25, 1.0, 5).tolist())  # over the patient's own cells: coarser than these nobody asks of


def convergence(patient: str, bundle: Path, result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row an order of the cells and a size (mean edge of the endocardium's triangles, mm; ``own``: the patient's mesh): errors
    (one standard deviation) at end-systole of the displacements, root mean square (mm), and of the volume (mL).

    source: ``model``, at the motion of the calibration's targets, or ``measured``, as `lacli tradeoff` left it with the bundle.
    None of targets without motion at end-systole. Raises InputError.
    """
    try:
        mesh = load(bundle)
    except AnatomyError as error:
        raise InputError(f"{patient}: {error}") from None
    told = {str(row["feature"]): float(row["target"]) for row in result["fit"]}
    moved = {name: value for name, value in told.items() if name in PUBLISHED}
    rows = []
    for order in (1, 2):
        own = resolution(mesh, order)
        for size in _SIZES if moved else ():
            errors = model_errors(moved, own.finer(size))
            rows.append(_row(patient, order, own.h_mm * size, bool(np.isclose(size, 1.0)), MODEL, errors))
        for numerics, errors in kept_errors(bundle):
            if numerics.startswith(f"p{order}_"):
                rows.append(_row(patient, order, own.h_mm, True, MEASURED, errors))
    return [row for row in rows if row["error_mm"] is not None]


def _row(patient: str, order: int, cell_mm: float, own: bool, source: str, errors: Mapping[str, float]) -> dict[str, Any]:
    lengths = [value for name, value in errors.items() if name.endswith("_mm")]
    return {
        "participant_id": patient, "order": order, "cell_mm": cell_mm, "own": own, "source": source,
        "error_mm": float(np.sqrt(np.mean(np.square(lengths)))) if lengths else None, "error_ml": errors.get("esv_ml"),
    }  # fmt: skip
