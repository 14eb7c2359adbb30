"""Questions that a study asks of its method: does thickness matter, does the law of Laplace hold?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.api.progress import Cancel, OnProgress
    from lacli.cohort.studies.laplace import LaplaceStudy
    from lacli.cohort.studies.thickness import ThicknessStudy

QUESTIONS = ("thickness", "laplace")
_FORMATS = ("png", "pdf", "svg")


def study(
    question: str,
    run: Path | None = None,
    *,
    thicknesses_mm: Sequence[float] | None = None,
    out: Path | None = None,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> ThicknessStudy | LaplaceStudy:
    """What the method says of ``thickness`` or of the law of ``laplace``.

    ``thickness``: hemispherical shells of these thicknesses (mm; default 1 to 4) under pressure, alone and on springs.
    ``laplace``: the law of Laplace beside the wall stress (kPa) of a ``run`` that kept its fields, by region.

    out: folder for <question>.csv, <question>.json and the figure (PNG, PDF, SVG). Raises InputError, UsageError, AnatomyError,
    SolverMissingError, SimulationError, StorageError, Cancelled.
    """
    from lacli.api.progress import Stage
    from lacli.base.files import check_folder

    if question not in QUESTIONS:
        raise UsageError(f"{question}: no such study; there are {', '.join(QUESTIONS)}.")
    if (question == "laplace") != (run is not None):
        raise UsageError("the folder of a run goes with `laplace`, and only with it.")
    if thicknesses_mm and question == "laplace":
        raise UsageError("thicknesses are of the study `thickness`; the law is held against the run's own wall.")
    if out is not None:
        check_folder(out)
    found: ThicknessStudy | LaplaceStudy
    if run is not None:
        from lacli.cohort.studies.laplace import of_run

        stage = Stage(question, 1, progress, cancel).begin()
        found = of_run(run)
        stage.step()
    else:
        from lacli.cohort.studies import thickness

        chosen = tuple(thicknesses_mm or thickness.THICKNESSES_MM)
        found = thickness.study(chosen, tick=Stage(question, 4 * len(set(chosen)), progress, cancel).begin().step)
    if out is not None:
        _write(found, out, question)
    return found


def rows(found: ThicknessStudy | LaplaceStudy) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """The table of a study, a dict a row, and its numbers."""
    from dataclasses import asdict

    from lacli.cohort.studies.laplace import LaplaceStudy

    if isinstance(found, LaplaceStudy):
        table = [
            {**asdict(row), "ratio": row.ratio, "fails": row.fails, "compared": row.region not in found.left_out}
            for row in found.regions
        ]
        return table, {"correlation": found.correlation, "slope": found.slope, "pressure_kpa": found.pressure_kpa}
    return [asdict(shell) for shell in found.shells], {"slope": found.slope, "slope_on_springs": found.slope_on_springs}


def notes(found: ThicknessStudy | LaplaceStudy) -> list[str]:
    """What must be said of a study's numbers."""
    return list(getattr(found, "notes", ()))


def _write(found: ThicknessStudy | LaplaceStudy, out: Path, question: str) -> None:
    import pandas as pd

    from lacli.base.files import replacing, write_json
    from lacli.cohort.studies.laplace import LaplaceStudy
    from lacli.report import study_figures

    table, numbers = rows(found)
    out.mkdir(parents=True, exist_ok=True)
    with replacing(out / f"{question}.csv") as temporary:
        pd.DataFrame(table).to_csv(temporary, index=False)
    known = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
    write_json(out / f"{question}.json", {**known, "notes": notes(found), "rows": table})
    files = [out / f"{question}.{suffix}" for suffix in _FORMATS]
    if isinstance(found, LaplaceStudy):
        stresses = {r.region: (r.laplace_kpa, r.stress_kpa) for r in found.regions}
        study_figures.laplace_figure(stresses, found.slope, files, found.left_out)
    else:
        study_figures.thickness_figure(table, files)
