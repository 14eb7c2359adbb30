"""A study in one call each: statistics over many patients, models compared, a page on a run or a patient."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.errors import LacliError, UsageError

if TYPE_CHECKING:
    from lacli.api.progress import Cancel, OnProgress
    from lacli.base.arrays import FloatArray
    from lacli.cohort.analysis.statistics import Statistics
    from lacli.cohort.comparison import Comparison
    from lacli.cohort.participants import Participant
    from lacli.cohort.steps import Step
    from lacli.cohort.study import Outcome, Planned

PLAIN_PATH = re.compile(r"[A-Za-z0-9_./+-]+")  # in a batch script's header nothing can be quoted


@dataclass(frozen=True)
class Cohort:
    """What a study holds: the state of each patient, and its summary (counts, misfit of the models over patients, notes)."""

    outcomes: tuple[Outcome, ...]
    summary: dict[str, Any]


@dataclass(frozen=True)
class Report:
    """Where a page is, its size in bytes, and where its figures are as PDF and SVG; ``kind``: run, patient or study."""

    kind: str
    page: Path
    size: int
    figures: Path


def compare(
    patient: Path,
    targets: Path,
    *,
    tied: Sequence[Sequence[str]] = (),
    others: Mapping[str, Path] | None = None,
    particles: int = 600,
    seed: int = 0,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Comparison:
    """Models of one calibrated patient: each region its own stiffness, one for all, and ``tied``: groups of inputs that are one.

    patient: the folder of a calibration, targets: what it was made to. others: name -> the calibration to the same targets on
    another anatomy, such as one of uniform thickness. Emulators stand for runs: nothing is simulated. particles: of the
    sampler, at least 100. Evidences have no units, misfits are in mm. Raises InputError, UsageError, Cancelled.
    """
    from lacli.api.progress import Stage
    from lacli.base.threads import one_thread
    from lacli.cohort import comparison
    from lacli.cohort.patient import held_against, read_model
    from lacli.contracts.targets import read_targets

    if particles < 100:
        raise UsageError(f"compare: {particles} particles; at least 100.")
    wanted = read_targets(targets)
    regional = read_model(patient, wanted)
    held = held_against(patient, wanted)
    models = [
        regional,
        comparison.Model(comparison.GLOBAL, regional.emulators, regional.box, comparison.tied_regions(regional.box.names)),
    ]
    if tied:
        models.append(comparison.Model("tied", regional.emulators, regional.box, tuple(map(tuple, tied))))
    for name, folder in (others or {}).items():
        if name in [m.name for m in models]:
            raise UsageError(f"compare: two models are named {name}.")
        models.append(read_model(folder, wanted, name))
    for model in models:
        comparison.reduced(model)
        if set(model.emulators.outputs) != set(regional.emulators.outputs):
            raise UsageError(f"compare: {model.name} was calibrated to other features than {patient}.")
    with one_thread():
        stage = Stage("comparison", 4 * len(models), progress, cancel).begin()
        return comparison.compare(models, held, particles, seed, stage.step)


def stats(
    table: Path,
    response: str,
    predictors: Sequence[str] = (),
    *,
    draws: Path | None = None,
    targets: Path | None = None,
    patient: str = "participant_id",
    region: str = "region",
    seed: int = 0,
) -> Statistics:
    """Paired tests of the response between regions, and its mixed model with each predictor, plain and carried.

    Results are in the columns' own units. table: a row for each patient and region; ``<column>_sd`` beside a column is its
    posterior's standard deviation, or ``draws`` holds joint draws of it. targets: a file of targets that the stiffness was
    calibrated to. Raises TableError, InputError, UsageError before anything is computed.
    """
    from lacli.base.threads import one_thread
    from lacli.cohort.analysis.observations import read_observations
    from lacli.cohort.analysis.statistics import statistics
    from lacli.contracts.targets import read_targets

    observed = read_observations(table, [response, *predictors], patient, region, draws)
    names = read_targets(targets).names if targets is not None else None
    with one_thread():
        return statistics(observed, response, predictors, names, seed)


def write_report(folder: Path, page: Path, *, figures: Path | None = None, run: Path | None = None) -> Report:
    """One self-contained HTML page on the folder of a run (of ``simulate``), a patient's calibration, or a study (of ``cohort``).

    figures: folder of the figures as PDF and SVG (default: ``<page>_figures`` beside it). run: of a calibration, the folder of a
    simulation that kept its fields, for anatomy and transients. Raises InputError, UsageError, StorageError.
    """
    from lacli.base.files import check_file, check_folder
    from lacli.cohort.analysis.summary import SUMMARY
    from lacli.cohort.page import study_page
    from lacli.report.page.document import write
    from lacli.report.page.patient import RESULT, patient_page
    from lacli.report.page.run import run_page

    kept = figures or page.with_name(f"{page.stem}_figures")
    if page.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{page}: a page is an .html file.")
    if (folder / SUMMARY).is_file():
        if run is not None:
            raise UsageError("--run goes with a patient's calibration; this is a study.")
        check_file(page)
        check_folder(kept)
        return Report("study", page, write(study_page(folder, kept), page), kept)
    patient = (folder / RESULT).is_file()
    if not patient and not (folder / "manifest.json").is_file():
        raise UsageError(
            f"{folder}: neither a run (manifest.json), nor a finished calibration ({RESULT}), nor a study ({SUMMARY})."
        )
    if run is not None and not patient:
        raise UsageError("--run goes with a patient's calibration; this is a run itself.")
    check_file(page)
    check_folder(kept)
    simulated = run if patient else folder
    thickness, note = _thickness(simulated) if simulated is not None else (None, "")
    made = patient_page(folder, kept, run, thickness, note) if patient else run_page(folder, kept, thickness, note)
    return Report("patient" if patient else "run", page, write(made, page), kept)


def _thickness(run: Path) -> tuple[tuple[FloatArray, FloatArray] | None, str]:
    """Points of the endocardium and their wall thickness, mm, from the run's bundle; None and why where it is not there."""
    from lacli.anatomy.wall.thickness import of_bundle
    from lacli.contracts.bundle import load
    from lacli.contracts.scene import load_scene

    try:
        bundle = load(Path(load_scene(run / "scene.toml").anatomy.bundle))
        found = of_bundle(bundle)
    except LacliError as error:
        return None, f"Wall thickness is not shown: {error}"
    return (bundle.points[found.ids], found.laplace), ""


def plan_cohort(
    participants: Path, folder: Path, *, scene: Path | None = None, settings: Path | None = None, only: Sequence[str] = ()
) -> list[Planned]:
    """The steps of each patient and their state; nothing is run. Raises TableError, UsageError, InputError."""
    from lacli.cohort.study import planned

    return [row for patient, steps in _patients(participants, folder, scene, settings, only)
            for row in planned(patient, steps, folder.absolute() / patient.identifier)]  # fmt: skip


def run_cohort(
    participants: Path,
    folder: Path,
    *,
    scene: Path | None = None,
    settings: Path | None = None,
    only: Sequence[str] = (),
    scheduler: str | None = None,
    slurm: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Cohort:
    """Every patient of a table: mesh, fat, track, calibrate, compare, as far as it has the files, and the tables.

    Each step is a call of ``lacli`` in a process of its own; what is done is found again by content. only: these patients (the
    tables hold all that are done, in the units of their columns' names). A patient who fails is an outcome. scheduler: address
    of a Dask scheduler, whose workers take a patient each and see the same files; slurm: such workers as SLURM jobs of the
    settings' ``[slurm]``. Raises TableError, UsageError, InputError before anything is run, Cancelled, LacliError where the
    scheduler is lost (what is done is kept).
    """
    from lacli.api.progress import Stage
    from lacli.base.files import check_folder
    from lacli.cohort.analysis.summary import write_summary
    from lacli.cohort.participants import read_participants
    from lacli.cohort.study import known_outcome, planned, run

    check_folder(folder)
    every = read_participants(participants)
    chosen = _patients(participants, folder, scene, settings, only)
    home = folder.absolute()
    for patient, steps in chosen:
        planned(patient, steps, home / patient.identifier)
    if scheduler is not None and slurm:
        raise UsageError("a scheduler that is there, or SLURM's own jobs: one of the two.")
    outcomes: dict[str, Outcome] = {}
    if slurm:
        for found in _on_slurm(chosen, home, settings, progress, cancel):
            outcomes[found.participant_id] = found
    elif scheduler is not None:
        for found in _on_cluster(chosen, home, scheduler, progress, cancel):
            outcomes[found.participant_id] = found
    for patient, steps in chosen if not slurm and scheduler is None else ():
        stage = Stage(patient.identifier, len(steps), progress, cancel).begin()
        begun: list[str] = []

        def tick(name: str, stage: Stage = stage, begun: list[str] = begun) -> None:
            begun.append(name)
            stage.reach(len(begun) - 1)

        wanted = (lambda: not cancel()) if cancel is not None else (lambda: True)
        outcomes[patient.identifier] = run(patient, steps, home / patient.identifier, tick, wanted)
        stage.reach(len(steps))
    for patient in every:
        if patient.identifier not in outcomes and (known := known_outcome(home / patient.identifier)) is not None:
            outcomes[patient.identifier] = known
    ordered = tuple(outcomes[p.identifier] for p in every if p.identifier in outcomes)
    return Cohort(ordered, write_summary(folder, every, ordered))


def _on_cluster(
    chosen: Sequence[tuple[Participant, list[Step]]],
    home: Path,
    scheduler: str,
    progress: OnProgress | None,
    cancel: Cancel | None,
    left: Callable[[int], None] = lambda count: None,
) -> Iterator[Outcome]:
    """Outcomes as they come; ``left`` is told about each second how many are to come."""
    from lacli.api.progress import Stage, check
    from lacli.cohort.cluster import patients_on_cluster

    stages = [Stage(patient.identifier, len(steps), progress, cancel) for patient, steps in chosen]
    names = [[step.name for step in steps] for _, steps in chosen]
    count = len(chosen)

    def look() -> None:
        check(cancel, "the study")
        left(count)

    def begun(index: int, name: str) -> None:
        stages[index].reach(names[index].index(name))

    for index, outcome in patients_on_cluster(chosen, home, scheduler, begun, look):
        count -= 1
        stages[index].reach(len(names[index]))
        yield outcome


def _on_slurm(
    chosen: Sequence[tuple[Participant, list[Step]]],
    home: Path,
    settings: Path | None,
    progress: OnProgress | None,
    cancel: Cancel | None,
) -> Iterator[Outcome]:
    from lacli.cohort.slurm import workers
    from lacli.cohort.steps import read_settings

    logs = _slurm_folder(home)
    with workers(read_settings(settings), logs) as (address, keep):
        keep(len(chosen))
        yield from _on_cluster(chosen, home, address, progress, cancel, keep)


def _slurm_folder(home: Path) -> Path:
    """Where SLURM's jobs say what they have to say. Raises UsageError, StorageError."""
    from lacli.base.files import check_folder

    logs = home / "slurm"
    if not PLAIN_PATH.fullmatch(str(logs)):
        raise UsageError(f"{logs}: SLURM takes no path with such letters; choose another --out.")
    check_folder(logs)
    logs.mkdir(parents=True, exist_ok=True)
    return logs


def cohort_cost(rows: Sequence[Planned], folder: Path, settings: Path | None = None) -> dict[str, Any]:
    """Cost of a plan: ``calibrations`` to do, ``runs_each`` at most, ``cpu_s_per_run``, the median of the study's runs so far or
    None."""
    from lacli.calibration.calibration import Settings
    from lacli.cohort.analysis.summary import median_cpu_s
    from lacli.cohort.steps import read_settings

    todo = [row for row in rows if row.step == "calibrate" and row.state != "done" and "--from-table" not in row.command.split()]
    default, given = Settings(), read_settings(settings).options.get("calibrate", {})
    names = ("first_runs", "wave_runs", "max_waves", "max_runs")
    first, following, waves, most = (int(given.get(name.replace("_", "-"), getattr(default, name))) for name in names)
    runs = min(most, first + following * (waves - 1))
    return {"calibrations": len(todo), "runs_each": runs, "cpu_s_per_run": median_cpu_s(folder)}


def write_slurm(
    participants: Path, folder: Path, script: Path, *, scene: Path | None = None, settings: Path | None = None
) -> None:
    """A plain SLURM array script, a task a patient, that does what ``run_cohort`` does.

    Raises TableError, UsageError, InputError, StorageError.
    """
    import sys

    from lacli.base.files import write_text
    from lacli.cohort.slurm import array_script
    from lacli.cohort.steps import read_settings

    patients = _patients(participants, folder, scene, settings, ())
    logs = _slurm_folder(folder.absolute())
    call = ["cohort", str(participants.absolute()), "--out", str(folder.absolute())]
    for option, file in (("--scene", scene), ("--settings", settings)):
        call += [option, str(file.absolute())] if file is not None else []
    identifiers = [patient.identifier for patient, _ in patients]
    write_text(script, array_script(sys.executable, call, identifiers, read_settings(settings), logs))


def _patients(
    participants: Path, folder: Path, scene: Path | None, settings: Path | None, only: Sequence[str]
) -> list[tuple[Participant, list[Step]]]:
    from lacli.base.errors import InputError
    from lacli.cohort.participants import check_targets, read_participants
    from lacli.cohort.steps import read_settings, steps_of

    if scene is not None and not scene.is_file():
        raise InputError(f"{scene}: no such scene.")
    every, shared = read_participants(participants), read_settings(settings)
    missing = [name for name in only if name not in [p.identifier for p in every]]
    if missing:
        raise UsageError(f"{participants}: no participant {', '.join(missing)}.")
    check_targets(every, participants)
    own = None if scene is None else scene.absolute()
    chosen = [p for p in every if not only or p.identifier in only]
    return [(p, steps_of(p, shared, folder.absolute() / p.identifier, own)) for p in chosen]
