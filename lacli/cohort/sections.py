"""Sections of a study's page that show its tables as they stand, each with its figures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from lacli.cohort.analysis.influences import TOTAL, by_patient, over_patients
from lacli.cohort.analysis.walls import EIKONAL, LAPLACE, over_walls, windows_of
from lacli.cohort.files import (
    ANATOMIES,
    CONVERGENCE,
    COURSES,
    DISCRETISATION,
    FEATURES,
    FRAMES,
    INFLUENCES,
    MISFITS,
    OUTPUTS,
    PATIENTS,
    SCORES,
    TRANSIENTS,
    WALLS,
    WAVES,
)
from lacli.cohort.gallery import atria, with_fibrillation
from lacli.contracts.tables.file import read_frame
from lacli.report import cohort_figures_fits as fits
from lacli.report.cohort_figures import courses_figure, gallery_figure, influence_figure
from lacli.report.page.document import Figure, Section, Table, number, picture

FORMATS = ("png", "pdf", "svg")
_MOST_PATIENTS = 20  # whose transients are on the page; all are in the folder of figures
_MOST_SCORES = 60  # outputs of a readable map


def files_of(pictures: Path, name: str) -> list[Path]:
    """A figure's files, the first of them for the page."""
    return [pictures / f"{name}.{suffix}" for suffix in FORMATS]


def cells(frame: pd.DataFrame) -> tuple[tuple[str, ...], ...]:
    """A table's rows as they are printed."""
    return tuple(tuple(number(v.item() if hasattr(v, "item") else v) for v in row) for row in frame.itertuples(index=False))


def table_of(frame: pd.DataFrame, title: str) -> Table:
    """A table under its own columns' names."""
    return Table(title, tuple(str(name).replace("_", " ") for name in frame.columns), cells(frame))


def table(file: Path, title: str) -> Table | None:
    """A table of the study as it stands; None where it is not there."""
    return table_of(read_frame(file), title) if file.is_file() else None


def _drawn(pictures: Path, name: str, words: str, draw: Callable[[list[Path]], None]) -> Figure:
    files = files_of(pictures, name)
    draw(files)
    return picture(files[0], words)


def fits_section(study: Path, pictures: Path) -> Section | None:
    """Features at the most probable point and frame by frame, over the patients."""
    found = (
        table(study / FEATURES, "Simulated less target at the most probable point, by feature over the patients"),
        table(study / FRAMES, "The same by patient and time"),
    )
    figures: tuple[Figure, ...] = ()
    if (study / COURSES).is_file():
        frame = read_frame(study / COURSES)
        if frame["time"].nunique() > 1:
            words = "Over the cycle, a column a patient: targets with 2 sd, lines through the values at the most probable point."
            figures = (_drawn(pictures, "courses", words, lambda files: courses_figure(frame, files)),)
    return _section("fits", "Fits", found, figures)


def transients_section(study: Path, pictures: Path) -> Section | None:
    """The images' transients against those of the first runs and of the most probable one, by patient and over all."""
    if not (study / TRANSIENTS).is_file():
        return None
    frame = read_frame(study / TRANSIENTS)
    frame = frame.assign(phase=frame["phase"].fillna("").astype(str))
    figures = []
    if fits.over_grid(frame, "volume_ml", "image", fits.GRID).shape[0] > 1:
        words = "Over the patients: the images' courses and the most probable runs', mean and one sd; thin: each run."
        figures.append(_drawn(pictures, "transients", words, lambda files: fits.cohort_transients_figure(frame, files)))
    people = list(dict.fromkeys(frame["participant_id"]))
    for number_, person in enumerate(people):
        mine = frame[frame["participant_id"] == person]
        words = (
            f"{person}: image with 2 sd, first runs (2.5 to 97.5 %, of fewer than 40 all) with their median, the run at the most"
            " probable point; large dots: end-systole."
        )
        files = files_of(pictures, f"transients_{person}")
        fits.transients_figure(mine, files)
        if number_ < _MOST_PATIENTS:
            figures.append(picture(files[0], words))
    said = () if len(people) <= _MOST_PATIENTS else (f"Shown are {_MOST_PATIENTS} patients of {len(people)}.",)
    misfits = table(
        study / MISFITS,
        "Most probable run less image, root mean square by patient and time (no time: the phase; not used: held out)",
    )
    return _section("transients", "Transients", (misfits,), tuple(figures), said)


def emulators_section(study: Path, pictures: Path) -> Section | None:
    """Emulators by output and patient, waves."""
    found = (
        table(study / OUTPUTS, "Last emulators at runs left out, by output over the patients"),
        table(study / WAVES, "Waves of history matching, by patient"),
    )
    figures = []
    if (study / SCORES).is_file():
        frame = read_frame(study / SCORES)
        worst = frame.groupby("output", sort=False)["r2"].agg("min").nsmallest(_MOST_SCORES).index
        shown = frame[frame["output"].isin(worst)]
        less = f"; the {_MOST_SCORES} outputs of least R2" if frame["output"].nunique() > _MOST_SCORES else ""
        words = f"Emulators by output and patient, at runs left out{less}. Framed: the worst."
        figures.append(_drawn(pictures, "emulators", words, lambda files: fits.scores_figure(shown, files)))
    if (study / WAVES).is_file() and (waves := read_frame(study / WAVES))["nroy_share"].notna().any():
        words = "What history matching has not ruled out, by patient and wave."
        figures.append(_drawn(pictures, "waves", words, lambda files: fits.shares_figure(waves, files)))
    return _section("emulators", "Emulators", found, tuple(figures))


def numerics_section(study: Path, pictures: Path) -> Section | None:
    """The discretisation's part of the errors, and how they fall with the cells."""
    found = [table(study / DISCRETISATION, "The discretisation's part of the errors, by feature over the patients")]
    figures: tuple[Figure, ...] = ()
    if (study / CONVERGENCE).is_file():
        frame = read_frame(study / CONVERGENCE)
        own = frame[frame["own"]].drop(columns="own")
        found.append(table_of(own, "Errors at end-systole on the patients' own meshes, one standard deviation"))
        words = (
            "Error of the displacements at end-systole (one standard deviation) against the size of the cells, a line a patient,"
            " by the model of errors; dots: the patient's own mesh; crosses: measured on it (`lacli tradeoff`)."
        )
        figures = (_drawn(pictures, "convergence", words, lambda files: fits.convergence_figure(frame, files)),)
    return _section("numerics", "Numerics", tuple(found), figures)


def influences_section(study: Path, pictures: Path) -> Section | None:
    """Which inputs make the features vary, mean over the patients, and by patient."""
    if not (study / INFLUENCES).is_file():
        return None
    rows = [{str(k): v for k, v in row.items()} for row in read_frame(study / INFLUENCES).to_dict("records")]
    inputs, features, shares = over_patients(rows)
    if not features:
        return None
    # features in frames would make the map unreadable; all are in the table beside the study
    shown = [i for i, name in enumerate(features) if "@" not in name] or list(range(len(features)))
    names, part = [features[i] for i in shown], shares[:, shown]
    mean = part.mean(axis=1)
    ranking = sorted(zip(inputs, mean.tolist(), part.max(axis=1).tolist(), strict=True), key=lambda row: -row[1])
    ranked = tuple((name, number(of_all, 2), number(most, 2)) for name, of_all, most in ranking)
    _, people, of_each = by_patient(rows)
    whose = f"mean over {len(people)} patients" if len(people) > 1 else "of one patient"
    ways = {str(row.get("by", "")) for row in rows}
    how = "To first order about each patient's most probable point, under the prior"
    if TOTAL in ways:
        how = "Total effects over the box by the first wave's emulators" + (
            f"; for some patients: {how}" if len(ways) > 1 else ""
        )
    said = (f"{how}; {whose}. In colour: the inputs that together make 90 % of a feature's variance.",)
    words = "Share of each feature's variance by input (%, where 5 or more)."
    figures = [_drawn(pictures, "influences", words, lambda files: influence_figure(inputs, names, part, files))]
    if len(people) > 1:
        words = "The same by patient: mean over the patient's features."
        figures.append(
            _drawn(pictures, "influences_by_patient", words, lambda files: influence_figure(inputs, people, of_each, files))
        )
        for number_, person in enumerate(people):
            mine = [row for row in rows if row["participant_id"] == person]
            named = [str(row["feature"]) for row in mine if str(row["feature"]) in names]
            of_one = np.array([[float(row[name]) for row in mine if str(row["feature"]) in names] for name in inputs])
            files = files_of(pictures, f"influences_{person}")
            influence_figure(inputs, named, of_one, files)
            if number_ < _MOST_PATIENTS:
                figures.append(picture(files[0], f"Of {person}."))
    ranking_table = Table("Ranking", ("input", "mean share", "largest share"), ranked)
    return _section("sensitivity", "Sensitivity", (ranking_table,), tuple(figures), said)


def anatomies_section(study: Path, pictures: Path) -> Section | None:
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
        stars = "; a star: atrial fibrillation" if marked else ""
        words = f"The atria from the back at end-diastole, at one scale{stars}."
        figures = (_drawn(pictures, "gallery", words, lambda files: gallery_figure(shown, marked, files)),)
    over, drawn = _walls(study, pictures)
    found = (table_of(frame.drop(columns="bundle"), "Anatomies"), over)
    section = _section("anatomies", "Anatomies", found, (*figures, *drawn))
    return section and Section(**{**section.__dict__, "warnings": tuple(lacking)})


def _walls(study: Path, pictures: Path) -> tuple[Table | None, list[Figure]]:
    if not (study / WALLS).is_file():
        return None, []
    frame = read_frame(study / WALLS)
    rows = [{str(k): v for k, v in row.items()} for row in frame.to_dict("records")]
    figures = []
    if {LAPLACE, EIKONAL} <= set(frame.columns):
        words = "Wall thickness by region measured two ways, a marker a patient."
        draw = lambda files: fits.thicknesses_figure(frame, (LAPLACE, EIKONAL), files)  # noqa: E731
        figures.append(_drawn(pictures, "thicknesses", words, draw))
    if columns := {window: f"fat_{window}_ml" for window in windows_of(frame)}:
        words = "Epicardial fat by region and window of Hounsfield units, a marker a patient."
        figures.append(_drawn(pictures, "fat", words, lambda files: fits.fat_figure(frame, columns, files)))
    return table_of(pd.DataFrame(over_walls(rows)), "Walls over the patients"), figures


def _section(
    anchor: str, title: str, tables: tuple[Table | None, ...], figures: tuple[Figure, ...], text: tuple[str, ...] = ()
) -> Section | None:
    """None where there is nothing to show."""
    kept = tuple(one for one in tables if one is not None)
    return Section(anchor, title, text=text, tables=kept, figures=figures) if kept or figures else None
