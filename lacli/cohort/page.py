"""The page of a study: its patients, models, and statistics with their figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from lacli.base.documents import read_json
from lacli.base.errors import InputError
from lacli.base.version import __version__
from lacli.cohort.analysis.demographics import HEAD, demographics
from lacli.cohort.analysis.journal import MODEL_HEAD, PAIR_HEAD, SLOPE_HEAD, model_rows, pair_rows, slope_rows
from lacli.cohort.analysis.observations import Observations, read_observations
from lacli.cohort.analysis.statistics import Statistics, statistics
from lacli.cohort.files import CONTRASTS, DRAWS, FEATURES, MODELS, PATIENTS, REGIONS, STATE, SUMMARY
from lacli.cohort.sections import (
    anatomies_section,
    cells,
    emulators_section,
    files_of,
    fits_section,
    influences_section,
    numerics_section,
    table,
    transients_section,
)
from lacli.contracts.tables.file import read_frame
from lacli.report.cohort_figures import regions_figure, scatter_figure
from lacli.report.page.document import Figure, Page, Section, Table, number, picture
from lacli.report.page.methods import of_study
from lacli.report.page.run import closing

_LONG = {"d_mm": "displacement at ES (mm)", "alpha": "stiffness alpha", "c": "stiffness C (kPa)",
         "thickness_mm": "wall thickness (mm)", "fat_ml": "epicardial fat (mL)"}  # fmt: skip
_DRAWN = "alpha"  # what a study's joint draws are of
# of the published tables: what is asked of what
_QUESTIONS = (("d_mm", ("thickness_mm", "fat_ml", "alpha")), ("alpha", ("thickness_mm", "fat_ml")))
_OF_STUDY = ("participant_id", *STATE, "arm")  # columns that say nothing of a participant
_TOLD = "Warnings by participant"
_KEPT = (anatomies_section, influences_section, transients_section, fits_section, emulators_section, numerics_section)


def study_page(study: Path, pictures: Path) -> Page:
    """The page of a study's folder. pictures: where PDF and SVG of the figures are put too. Raises InputError."""
    summary = read_json(study / SUMMARY, missing="no such file; is this the folder of `lacli cohort`?")
    if not isinstance(summary, dict) or not {"patients", "done", "failed", "models", "notes"} <= set(summary):
        raise InputError(f"{study / SUMMARY}: not a study's summary.")
    people = read_frame(study / PATIENTS)
    general, of_patients = _notes(people, [str(words) for words in summary["notes"]])
    sections = [_patients(people, general, len(of_patients))]
    if (study / MODELS).is_file():
        sections.append(_models(study, summary["models"]))
    sections += [section for section in (make(study, pictures) for make in _KEPT) if section is not None]
    sections += _answers(study, pictures)
    if of_patients:
        sections.append(Section("warnings", _TOLD, text=of_patients))
    text, cited = of_study(__version__, [str(model["name"]) for model in summary["models"]])
    sections.append(closing(text, cited, {"versions": {"lacli": __version__}}))
    lead = f"{summary['done']} of {summary['patients']} participants done."
    return Page("A study of left atria", lead, tuple(sections))


def _notes(people: pd.DataFrame, notes: list[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is told of the study, and of single participants, whose words begin with their identifier."""
    known = set(people["participant_id"].astype(str))
    mine = [words.partition(": ")[0] in known for words in notes]
    return (
        tuple(words for words, one in zip(notes, mine, strict=True) if not one),
        tuple(words for words, one in zip(notes, mine, strict=True) if one),
    )


def _patients(people: pd.DataFrame, notes: tuple[str, ...], warned: int) -> Section:
    if warned:
        notes = (*notes, f"Calibration or comparison of {warned} participants told something: see {_TOLD}.")
    over = demographics(people, _OF_STUDY)
    tables = [Table("Over the participants", HEAD, tuple(over))] if over else []
    frame = people.drop(columns="warnings", errors="ignore")  # which have a section of their own
    tables.append(Table("Participants", tuple(map(str, frame.columns)), cells(frame)))
    return Section("patients", "Participants", notes, tables=tuple(tables))


def _models(study: Path, over: list[dict[str, object]]) -> Section:
    frame = read_frame(study / MODELS)
    columns = (
        "participant_id", "name", "log_evidence", "log_evidence_se", "emulator_se", "elpd", "elpd_se", "worst_k", "p_loo",
        "rmse_mm",
    )  # fmt: skip
    rows = cells(frame.reindex(columns=list(columns)))
    head = (
        "model", "patients", "RMSE mean, mm", "sd", "effective parameters", "sd", "elpd (PSIS-LOO), sum", "se", "over patients",
        "worst Pareto k", "elpd not to be trusted (k > .7 or no answer)",
    )  # fmt: skip
    keys = (
        "name", "patients", "rmse_mean_mm", "rmse_sd_mm", "p_loo_mean", "p_loo_sd", "elpd", "elpd_se", "elpd_patients", "worst_k",
        "elpd_not_trusted",
    )  # fmt: skip
    total = tuple(tuple(number(m.get(k), 3) for k in keys) for m in over)
    tables = [Table("Models over the patients", head, total)]
    if contrasts := table(study / CONTRASTS, "Log evidence of a model less another's, summed over the patients"):
        tables.append(contrasts)
    return Section("models", "Models", tables=(*tables, Table("By patient", columns, rows)))


def _answers(study: Path, pictures: Path) -> list[Section]:
    file = study / REGIONS
    if not file.is_file():
        return [Section("statistics", "Statistics", ("No patient is done: no statistics.",))]
    frame = read_frame(file)
    names = [name for name in _LONG if name in frame]
    if frame["participant_id"].nunique() < 2:
        return [Section("statistics", "Statistics", ("One patient is done; statistics over patients need at least 2.",))]
    targets = list(map(str, read_frame(study / FEATURES)["feature"])) if (study / FEATURES).is_file() else None
    sections = []
    for response, wanted in _QUESTIONS:
        if response not in names:
            continue
        asked = [response, *(name for name in wanted if name in names)]
        # joint draws tell how a patient's regions err together, which no sd does
        draws = study / DRAWS if _DRAWN in asked and (study / DRAWS).is_file() else None
        observed = read_observations(file, asked, draws=draws)
        predictors = [name for name in asked[1:] if _varies(observed, name)]
        enough = len(observed.patients) > 2 and len(observed.regions) > 1 and _varies(observed, response)
        found = statistics(observed, response, predictors if enough else [], targets)
        sections.append(_answer(found, observed, pictures))
    return sections


def _varies(observed: Observations, name: str) -> bool:
    values = observed.values[name]
    return bool(np.std(values - values.mean(axis=0)) > 1e-9 * (np.abs(values).max() or 1.0))


def _answer(found: Statistics, observed: Observations, pictures: Path) -> Section:
    name, regions = found.response, observed.regions
    figures = [files_of(pictures, name)]
    stars = {(pair.first, pair.second): pair.stars for pair in found.pairs}
    regions_figure(observed.values[name], regions, _LONG[name], figures[0], stars)
    said = "; stars: paired t, Bonferroni (* p < .05, ** < .01, *** < .001)" if any(stars.values()) else ""
    captions = [f"{_LONG[name]} by region, a marker a patient, joined by patient{said}."]
    tables = [Table("Paired t-tests between regions", PAIR_HEAD, tuple(map(tuple, pair_rows(found))))]
    if found.associations:
        tables.append(Table(f"{name} ~ region + predictor", SLOPE_HEAD, tuple(map(tuple, slope_rows(found)))))
        tables.append(Table(f"Mixed models of {name}, all coefficients", MODEL_HEAD, tuple(map(tuple, model_rows(found)))))
    for a in found.associations:
        files = files_of(pictures, f"{name}_{a.predictor}")
        error = observed.errors.get(a.predictor)
        sd = None if error is None else np.sqrt(np.diagonal(error, axis1=1, axis2=2))
        x, y = observed.values[a.predictor], observed.values[name]
        scatter_figure(x, y, regions, (_LONG[a.predictor], _LONG[name]), sd, files)
        figures.append(files)
        captions.append(f"{_LONG[name]} against {_LONG[a.predictor]}" + ("; bars: one posterior sd." if sd is not None else "."))
    shown: tuple[Figure, ...] = tuple(picture(files[0], words) for files, words in zip(figures, captions, strict=True))
    return Section(f"of-{name}", _LONG[name][0].upper() + _LONG[name][1:], found.warnings, tables=tuple(tables), figures=shown)
