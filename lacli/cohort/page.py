"""The page of a study: its patients, models, and statistics with their figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from lacli.base.documents import read_json
from lacli.base.errors import InputError
from lacli.base.version import __version__
from lacli.cohort.analysis.influences import over_patients
from lacli.cohort.analysis.journal import MODEL_HEAD, PAIR_HEAD, SLOPE_HEAD, model_rows, pair_rows, slope_rows
from lacli.cohort.analysis.observations import Observations, read_observations
from lacli.cohort.analysis.statistics import Statistics, statistics
from lacli.cohort.files import (
    ANATOMIES,
    CONTRASTS,
    COURSES,
    DISCRETISATION,
    FEATURES,
    FRAMES,
    INFLUENCES,
    MODELS,
    OUTPUTS,
    PATIENTS,
    REGIONS,
    SUMMARY,
    WAVES,
)
from lacli.cohort.gallery import atria, with_fibrillation
from lacli.contracts.tables.file import read_frame
from lacli.report.cohort_figures import courses_figure, gallery_figure, influence_figure, regions_figure, scatter_figure
from lacli.report.page.document import Figure, Page, Section, Table, number, picture
from lacli.report.page.methods import of_study
from lacli.report.page.run import closing

_FORMATS = ("png", "pdf", "svg")
_LONG = {"d_mm": "displacement at ES (mm)", "alpha": "stiffness alpha", "c": "stiffness C (kPa)",
         "thickness_mm": "wall thickness (mm)", "fat_ml": "epicardial fat (mL)"}  # fmt: skip
# of the published tables: what is asked of what
_QUESTIONS = (("d_mm", ("thickness_mm", "fat_ml", "alpha")), ("alpha", ("thickness_mm", "fat_ml")))


def study_page(study: Path, pictures: Path) -> Page:
    """The page of a study's folder. pictures: where PDF and SVG of the figures are put too. Raises InputError."""
    summary = read_json(study / SUMMARY, missing="no such file; is this the folder of `lacli cohort`?")
    if not isinstance(summary, dict) or not {"patients", "done", "failed", "models", "notes"} <= set(summary):
        raise InputError(f"{study / SUMMARY}: not a study's summary.")
    sections = [_patients(study, summary["notes"])]
    if (study / MODELS).is_file():
        sections.append(_models(study, summary["models"]))
    parts = (_anatomies(study, pictures), _influences(study, pictures), _fits(study, pictures))
    sections += [section for section in parts if section is not None]
    sections += _answers(study, pictures)
    text, cited = of_study(__version__, [str(model["name"]) for model in summary["models"]])
    sections.append(closing(text, cited, {"versions": {"lacli": __version__}}))
    lead = f"{summary['done']} of {summary['patients']} participants done."
    return Page("A study of left atria", lead, tuple(sections))


def _patients(study: Path, notes: list[str]) -> Section:
    frame = read_frame(study / PATIENTS)
    names = [str(n) for n in frame.columns]
    rows = _cells(frame)
    return Section("patients", "Participants", tuple(map(str, notes)), tables=(Table("Participants", tuple(names), rows),))


def _cells(frame: pd.DataFrame) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(number(v.item() if hasattr(v, "item") else v) for v in row) for row in frame.itertuples(index=False))


def _models(study: Path, over: list[dict[str, object]]) -> Section:
    frame = read_frame(study / MODELS)
    columns = ("participant_id", "name", "log_evidence", "log_evidence_se", "elpd", "elpd_se", "p_loo", "rmse_mm")
    rows = _cells(frame[list(columns)])
    head = ("model", "patients", "RMSE mean, mm", "sd")
    total = tuple(tuple(number(m[k], 3) for k in ("name", "patients", "rmse_mean_mm", "rmse_sd_mm")) for m in over)
    tables = [Table("RMSE over the patients", head, total)]
    if contrasts := _table(study / CONTRASTS, "Log evidence of a model less another's, summed over the patients"):
        tables.append(contrasts)
    return Section("models", "Models", tables=(*tables, Table("By patient", columns, rows)))


def _table(file: Path, title: str) -> Table | None:
    """A table of the study as it stands; None where it is not there."""
    if not file.is_file():
        return None
    frame = read_frame(file)
    return Table(title, tuple(str(name).replace("_", " ") for name in frame.columns), _cells(frame))


def _fits(study: Path, pictures: Path) -> Section | None:
    """Features at the most probable point, frame by frame, emulators, waves and numerics, over the patients."""
    found = (
        _table(study / FEATURES, "Simulated less target at the most probable point, by feature over the patients"),
        _table(study / FRAMES, "The same by patient and time"),
        _table(study / OUTPUTS, "Emulators of the last wave, by output over the patients"),
        _table(study / WAVES, "Waves of history matching, by patient"),
        _table(study / DISCRETISATION, "The discretisation's part of the errors, by feature over the patients"),
    )
    figures: tuple[Figure, ...] = ()
    if (study / COURSES).is_file():
        frame = read_frame(study / COURSES)
        if frame["time"].nunique() > 1:
            files = _files(pictures, "courses")
            courses_figure(frame, files)
            words = "Over the cycle, a column a patient: targets with 2 sd, lines through the values at the most probable point."
            figures = (picture(files[0], words),)
    tables = tuple(table for table in found if table is not None)
    return Section("fits", "Fits", tables=tables, figures=figures) if tables or figures else None


def _influences(study: Path, pictures: Path) -> Section | None:
    """Which inputs make the features vary, mean over the patients."""
    if not (study / INFLUENCES).is_file():
        return None
    rows = [{str(k): v for k, v in row.items()} for row in read_frame(study / INFLUENCES).to_dict("records")]
    inputs, features, shares = over_patients(rows)
    if not features:
        return None
    # features in frames would make the map unreadable; all are in the table beside the study
    shown = [i for i, name in enumerate(features) if "@" not in name] or list(range(len(features)))
    names, part = [features[i] for i in shown], shares[:, shown]
    files = _files(pictures, "influences")
    influence_figure(inputs, names, part, files)
    mean = part.mean(axis=1)
    ranking = sorted(zip(inputs, mean.tolist(), part.max(axis=1).tolist(), strict=True), key=lambda row: -row[1])
    cells = tuple((name, number(of_all, 2), number(most, 2)) for name, of_all, most in ranking)
    table = Table("Ranking", ("input", "mean share", "largest share"), cells)
    count = len({row["participant_id"] for row in rows})
    whose = f"mean over {count} patients" if count > 1 else "of one patient"
    said = (
        f"To first order about each patient's most probable point, under the prior; {whose}."
        " In colour: the inputs that together make 90 % of a feature's variance.",
    )
    figure = picture(files[0], "Share of each feature's variance by input (%, where 5 or more).")
    return Section("sensitivity", "Sensitivity", text=said, tables=(table,), figures=(figure,))


def _anatomies(study: Path, pictures: Path) -> Section | None:
    """The gallery, volumes measured and given, thickness two ways, fat by window."""
    if not (study / ANATOMIES).is_file():
        return None
    frame = read_frame(study / ANATOMIES)
    shown, lacking = atria(frame, study)
    people = read_frame(study / PATIENTS)
    marked = [
        str(r["participant_id"]) for r in people.to_dict("records") if with_fibrillation({str(k): str(v) for k, v in r.items()})
    ]
    figures: tuple[Figure, ...] = ()
    if shown:
        files = _files(pictures, "gallery")
        gallery_figure(shown, marked, files)
        stars = "; a star: atrial fibrillation" if marked else ""
        figures = (picture(files[0], f"The atria from the back at end-diastole, at one scale{stars}."),)
    table = frame.drop(columns="bundle")
    head = tuple(str(name).replace("_", " ") for name in table.columns)
    return Section("anatomies", "Anatomies", tuple(lacking), tables=(Table("Anatomies", head, _cells(table)),), figures=figures)


def _answers(study: Path, pictures: Path) -> list[Section]:
    table = study / REGIONS
    if not table.is_file():
        return [Section("statistics", "Statistics", ("No patient is done: no statistics.",))]
    frame = read_frame(table)
    names = [name for name in _LONG if name in frame]
    if frame["participant_id"].nunique() < 2:
        return [Section("statistics", "Statistics", ("One patient is done; statistics over patients need at least 2.",))]
    observed = read_observations(table, names)
    sections = []
    for response, wanted in _QUESTIONS:
        if response not in names:
            continue
        predictors = [name for name in wanted if name in names and _varies(observed, name)]
        enough = len(observed.patients) > 2 and _varies(observed, response)
        found = statistics(observed, response, predictors if enough else [])
        sections.append(_answer(found, observed, pictures))
    return sections


def _varies(observed: Observations, name: str) -> bool:
    values = observed.values[name]
    return bool(np.std(values - values.mean(axis=0)) > 1e-9 * (np.abs(values).max() or 1.0))


def _answer(found: Statistics, observed: Observations, pictures: Path) -> Section:
    name, regions = found.response, observed.regions
    figures = [_files(pictures, name)]
    regions_figure(observed.values[name], regions, _LONG[name], figures[0])
    captions = [f"{_LONG[name]} by region, a marker a patient, joined by patient."]
    tables = [Table("Paired t-tests between regions", PAIR_HEAD, tuple(map(tuple, pair_rows(found))))]
    if found.associations:
        tables.append(Table(f"{name} ~ region + predictor", SLOPE_HEAD, tuple(map(tuple, slope_rows(found)))))
        tables.append(Table(f"Mixed models of {name}, all coefficients", MODEL_HEAD, tuple(map(tuple, model_rows(found)))))
    for a in found.associations:
        files = _files(pictures, f"{name}_{a.predictor}")
        error = observed.errors.get(a.predictor)
        sd = None if error is None else np.sqrt(np.diagonal(error, axis1=1, axis2=2))
        x, y = observed.values[a.predictor], observed.values[name]
        scatter_figure(x, y, regions, (_LONG[a.predictor], _LONG[name]), sd, files)
        figures.append(files)
        captions.append(f"{_LONG[name]} against {_LONG[a.predictor]}" + ("; bars: one posterior sd." if sd is not None else "."))
    shown: tuple[Figure, ...] = tuple(picture(files[0], words) for files, words in zip(figures, captions, strict=True))
    return Section(f"of-{name}", _LONG[name][0].upper() + _LONG[name][1:], found.warnings, tables=tuple(tables), figures=shown)


def _files(pictures: Path, name: str) -> list[Path]:
    return [pictures / f"{name}.{suffix}" for suffix in _FORMATS]
