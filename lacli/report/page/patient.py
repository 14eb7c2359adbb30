"""The page of one patient, from the folder of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError, InputError
from lacli.base.version import __version__
from lacli.contracts.identity import bundle_digest, flatten, of_own_runs
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.parameters import QUANTITIES
from lacli.report.page import methods
from lacli.report.page.document import Page, Section, Table, number
from lacli.report.page.run import Run, Thickness, closing, kept_pictures, read_run, shape_section, transients_section

if TYPE_CHECKING:
    import pandas as pd

RESULT = "result.json"
_SAME = 0.01  # a parameter is the most probable one within this share
_POSTERIOR = {"corner.png": "Posterior, by pairs of inputs.", "region.png": "What history matching leaves (NROY)."}
_FIT = {"fit.png": "Targets, and the features of the posterior."}
_DIAGNOSTICS = {"trace.png": "Traces of the sampler.", "outputs.png": "Features over the samples of each wave."}
_NEEDED = ("posterior", "fit", "verdict", "samples", "converged", "stopped")


def read_result(folder: Path) -> dict[str, Any]:
    """The calibration's document. Raises InputError."""
    result = read_json(folder / RESULT, missing="no such file; is this the folder of a finished calibration?")
    needed = (*_NEEDED, "runs_by_stage" if isinstance(result, dict) and _sequential(result) else "waves")
    missing = [key for key in needed if not isinstance(result, dict) or key not in result]
    if missing:
        raise InputError(f"{folder / RESULT}: {', '.join(missing)} is missing; is it a calibration's result?")
    found: dict[str, Any] = result
    return found


def patient_page(folder: Path, pictures: Path, run: Path | None, thickness: Thickness | None, note: str = "") -> Page:
    """The page. run: the folder of a simulation, best at the most probable parameters, for anatomy and transients (without it
    there is no 3D); thickness, note and pictures as of ``run_page``. Raises InputError."""
    result = read_result(folder)
    text, keys = methods.of_calibration(result)
    sections = [_posterior(folder, result), _fit(folder, result), _diagnostics(folder, result), _costs(folder, result)]
    manifest: Mapping[str, Any] = {"versions": {"lacli": __version__}}
    if run is not None:
        one = read_run(run)
        _check_anatomy(folder, one)
        shape = shape_section(one, thickness, note, _stiffness(result))
        shape = replace(shape, warnings=(*_elsewhere(one, result), *shape.warnings))
        sections[:0] = [shape, transients_section(one, pictures)]
        before, cited = methods.of_run(one.scene, one.manifest.get("versions") or {})
        text, keys, manifest = f"{before} {text}", [*cited, *keys], one.manifest
    sections.append(closing(text, keys, manifest))
    if _sequential(result):
        made = f"{result['runs']} runs, sought by their derivatives"
    else:
        made = f"{len(result['waves'])} wave{'s' if len(result['waves']) > 1 else ''}"
    lead = f"Calibration in {folder.name}: {made}; stopped because {result['stopped']}."
    return Page("A patient's left atrium", lead, tuple(sections))


def _sequential(result: Mapping[str, Any]) -> bool:
    return result.get("method") == "sequential"


def _check_anatomy(folder: Path, run: Run) -> None:
    """Raises InputError where the calibration's bundle is another than the run's."""
    file = folder / "calibration.json"
    known = of_own_runs(file, "bundle") if file.is_file() else None
    if known is None:
        return
    try:
        of_run = f"content {bundle_digest(Path(run.scene.anatomy.bundle))[:16]}"
    except AnatomyError:
        return  # gone: that is said where the thickness is
    if of_run != known:
        raise InputError(f"{run.folder}: the run's bundle, {run.scene.anatomy.bundle}, is not the calibration's.")


def _elsewhere(run: Run, result: Mapping[str, Any]) -> list[str]:
    """What to say where the run was not made at the most probable parameters."""
    content = flatten(run.scene.content())
    apart = []
    for row in result["posterior"]:
        name, best = str(row["input"]), float(row["map"])
        value = content.get(QUANTITIES[name].key) if name in QUANTITIES else None
        if isinstance(value, (int, float)) and abs(value - best) > _SAME * max(abs(best), 1e-12):
            apart.append(f"{name} {value:.4g} (most probable {best:.4g})")
    if not apart:
        return []
    words = f"The run shown was not made at the most probable parameters: {', '.join(apart)}."
    return [f"{words} Its motion is not the patient's best fit."]


def _stiffness(result: Mapping[str, Any]) -> dict[str, tuple[str, dict[str, float]]]:
    rows = {row["input"]: row for row in result["posterior"]}
    found: dict[str, tuple[str, dict[str, float]]] = {}
    for title, what in (("stiffness alpha, posterior mean", "mean"), ("stiffness alpha, posterior sd", "sd")):
        values = {name: float(rows[f"alpha_{name}"][what]) for name in BODY_REGIONS if f"alpha_{name}" in rows}
        if values:
            found[title] = ("", values)
    return found


def _posterior(folder: Path, result: Mapping[str, Any]) -> Section:
    columns = ("input", "most probable", "mean", "sd", "2.5 %", "97.5 %", "R-hat", "ESS")
    rows = tuple(
        (str(r["input"]), *(number(r.get(k)) for k in ("map", "mean", "sd", "low95", "high95", "rhat", "ess")))
        for r in result["posterior"]
    )
    warnings = tuple(map(str, result["verdict"].get("warnings") or ()))
    if not result["verdict"].get("plausible", True) and not _sequential(result):
        warnings = ("The most probable point misses a target by more than the threshold: this is no answer.", *warnings)
    return Section(
        "posterior", "Posterior", warnings, tables=(Table("Posterior", columns, rows),), figures=kept_pictures(folder, _POSTERIOR)
    )


def _fit(folder: Path, result: Mapping[str, Any]) -> Section:
    columns = ("feature", "target", "sd", "emulated", "simulated")
    rows = tuple(
        (str(r["feature"]), *(number(r.get(k)) for k in ("target", "sd", "emulated", "simulated"))) for r in result["fit"]
    )
    rmse = result.get("rmse_mm")
    said = (f"RMSE of the displacements at the most probable parameters: {number(rmse, 3)} mm.",) if rmse is not None else ()
    table = Table("Fit at the most probable parameters", columns, rows)
    return Section("fit", "Fit", text=said, tables=(table,), figures=kept_pictures(folder, _FIT))


def _diagnostics(folder: Path, result: Mapping[str, Any]) -> Section:
    warnings = () if result["converged"] else ("The sampler did not converge.",)
    said = f"{result['samples']} posterior samples, acceptance {number(result.get('acceptance'), 3)}."
    pictures = kept_pictures(folder, _DIAGNOSTICS)
    if _sequential(result):
        stages = tuple((str(name), str(count)) for name, count in result["runs_by_stage"].items())
        moved = tuple((name, number(value, 2)) for name, value in result["emulator_change_sd"].items())
        tables = (Table("Runs", ("stage", "runs"), stages), Table("Emulator's part of the mean", ("input", "sd"), moved))
        return Section("diagnostics", "Diagnostics", warnings, (said,), tables=tables, figures=pictures)
    columns = ("wave", "runs", "failed", "threshold", "NROY %", "change %", "worst R2")
    rows = []
    for w in result["waves"]:
        share, change = w.get("share"), w.get("change")
        worst = min((float(v) for v in w["r2"].values() if v is not None), default=None)
        percent = [number(None if v is None else 100 * float(v), 3) for v in (share, change)]
        rows.append((str(w["wave"]), str(w["runs"]), str(w["failed"]), number(w["threshold"]), *percent, number(worst)))
    notes = tuple(dict.fromkeys(str(note) for w in result["waves"] for note in w.get("notes") or ()))
    table = Table("Waves of history matching", columns, tuple(rows))
    return Section("diagnostics", "Diagnostics", warnings, (said, *notes), tables=(table,), figures=pictures)


def _costs(folder: Path, result: Mapping[str, Any]) -> Section:
    from lacli.calibration.sequential.outputs import CHEAP, LOG
    from lacli.contracts.tables.file import read_frame

    tables = []
    for name, text in ((LOG, "Runs"), (CHEAP, "Cheap runs, corrected by the others")):
        if (folder / name).is_file():
            tables.append(Table(text, ("what", "value"), _of_runs(read_frame(folder / name))))
    if not tables:
        return Section("costs", "Costs", text=("The runs were made elsewhere: their cost is not known here.",))
    return Section("costs", "Costs", tables=tuple(tables))


def _of_runs(frame: pd.DataFrame) -> tuple[tuple[str, str], ...]:
    """Number, failures and CPU time of a table of runs."""
    import pandas as pd

    rows = [("runs", str(len(frame)))]
    if "status" in frame:
        rows.append(("failed", str(int((frame["status"].astype(str) != "done").sum()))))
    if "cpu_s" in frame:
        seconds = pd.to_numeric(frame["cpu_s"], errors="coerce")
        rows.append(("CPU time of all runs, h", number(float(seconds.sum()) / 3600, 3)))
        rows.append(("CPU time of a run, s, median", number(float(seconds.median()), 3)))
    return tuple(rows)
