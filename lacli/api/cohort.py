"""A whole study in one call: what is planned, what it costs, and the doing, here or as a SLURM array."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.errors import InputError, LacliError, StorageError, UsageError

if TYPE_CHECKING:
    from lacli.api.progress import Cancel, OnProgress
    from lacli.cohort.participants import Participant
    from lacli.cohort.steps import Settings, Step
    from lacli.cohort.study import Outcome, Planned
    from lacli.contracts.scene import Scene

    Patients = list[tuple[Participant, list[Step]]]

PLAIN_PATH = re.compile(r"[A-Za-z0-9_./+-]+")  # in a batch script's header nothing can be quoted
OF_WAVES = ("first-runs", "wave-runs", "max-waves", "hours", "prior")  # options of a calibration by the published method


@dataclass(frozen=True)
class Cohort:
    """A study: its steps as they stood before the call, and where they were done, each patient's outcome and a summary.

    cost of what was to do: ``calibrations``, ``runs_each`` at most, ``cpu_s_per_run`` (CPU seconds; the median of the study's
    runs so far, or None); where cheap runs carry calibrations, ``reference_runs_each`` and ``cpu_s_per_reference_run`` are
    those of the scene's own; ``compared``: calibrations whose models are to be compared, each with ``compared_runs_each`` more at
    most. summary: counts, misfit of the models over patients, notes. Of a dry run and of a script for SLURM,
    outcomes and summary are empty.
    """

    steps: tuple[Planned, ...]
    cost: dict[str, Any]
    outcomes: tuple[Outcome, ...] = ()
    summary: dict[str, Any] = field(default_factory=dict)


def run_cohort(
    participants: Path,
    folder: Path,
    *,
    scene: Path | None = None,
    settings: Path | None = None,
    only: Sequence[str] = (),
    scheduler: str | None = None,
    slurm: bool = False,
    dry_run: bool = False,
    script: Path | None = None,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Cohort:
    """Every patient of a table: mesh, fat, track, calibrate, compare, as far as it has the files, and the tables.

    Each step is a call of ``lacli`` in a process of its own; what is done is found again by content. only: these patients (the
    tables hold all that are done, from what they would be done from now, in the units of their columns' names; who is not any
    more is told in the notes). A patient who fails is an outcome, and so is one whose kept results are of other inputs, where
    others' are not. scheduler: address of a Dask scheduler, whose workers take a
    patient each and see the same files; slurm: such workers as SLURM jobs of the settings' ``[slurm]``. dry_run: steps, their
    state and cost are told, nothing is run; script: neither, and a SLURM array script, a task a patient, is written there.
    Raises TableError, UsageError, InputError before anything is run, StorageError, Cancelled, LacliError where the scheduler is
    lost (what is done is kept).
    """
    from lacli.base.files import check_folder

    if slurm + (scheduler is not None) + (script is not None) > 1:
        raise UsageError(
            "cohort: a scheduler (--scheduler), SLURM's own jobs (--slurm), or a script for SLURM (--write-slurm): one of them."
        )
    if script is not None and only:
        raise UsageError("--write-slurm writes a task for every participant; leave --only out.")
    if not dry_run and script is None:
        check_folder(folder)
    home = folder.absolute()
    chosen = _patients(participants, folder, scene, settings, only)
    rows, refused = _planned(chosen, home)
    steps = tuple(row for of_patient in rows.values() for row in of_patient)
    cost = _cost(chosen, steps, folder, settings)
    if script is not None:
        _write_slurm(participants, folder, script, scene, settings, list(rows))
    if dry_run or script is not None:
        return Cohort(steps, cost)
    chosen = [(patient, of) for patient, of in chosen if patient.identifier not in {o.participant_id for o in refused}]
    if slurm:
        found = _on_slurm(chosen, home, settings, progress, cancel)
    elif scheduler is not None:
        found = _on_cluster(chosen, home, scheduler, progress, cancel)
    else:
        found = _here(chosen, home, progress, cancel)
    by_name = {outcome.participant_id: outcome for outcome in (*refused, *found)}
    outcomes, summary = _gathered(participants, folder, scene, settings, by_name)
    return Cohort(steps, cost, outcomes, summary)


def _planned(chosen: Patients, home: Path) -> tuple[dict[str, list[Planned]], list[Outcome]]:
    """The steps' state by patient, and as outcomes those whose results were made of something else: they are not run, and others
    are. What they left on disk stays as it is, for the inputs may come back.

    Raises UsageError, InputError, StorageError where that is so of all of them: the call is wrong, not a patient.
    """
    from lacli.cohort.study import REFUSED, Outcome, Planned, planned

    rows, refused, first = dict[str, list[Planned]](), list[Outcome](), None
    for patient, steps in chosen:
        name = patient.identifier
        try:
            rows[name] = planned(patient, steps, home / name)
        except (UsageError, InputError, StorageError) as error:
            rows[name] = [Planned(name, "", f"{REFUSED}: {error}", "")]
            refused.append(Outcome(name, "failed", "kept results", str(error), {}))
            first = first or error
    if first is not None and len(refused) == len(chosen):
        raise first
    return rows, refused


def _here(chosen: Patients, home: Path, progress: OnProgress | None, cancel: Cancel | None) -> Iterator[Outcome]:
    """One patient after the other."""
    from lacli.api.progress import Stage
    from lacli.cohort.study import run

    for patient, steps in chosen:
        stage = Stage(patient.identifier, len(steps), progress, cancel).begin()
        begun: list[str] = []

        def tick(name: str, stage: Stage = stage, begun: list[str] = begun) -> None:
            begun.append(name)
            stage.reach(len(begun) - 1)

        wanted = (lambda: not cancel()) if cancel is not None else (lambda: True)
        yield run(patient, steps, home / patient.identifier, tick, wanted)
        stage.reach(len(steps))


def _on_cluster(
    chosen: Patients,
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
    chosen: Patients,
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
    from lacli.cohort.files import SLURM

    logs = home / SLURM
    if not PLAIN_PATH.fullmatch(str(logs)):
        raise UsageError(f"{logs}: SLURM takes no path with such letters; choose another --out.")
    check_folder(logs)
    logs.mkdir(parents=True, exist_ok=True)
    return logs


def _gathered(
    participants: Path, folder: Path, scene: Path | None, settings: Path | None, outcomes: dict[str, Outcome]
) -> tuple[tuple[Outcome, ...], dict[str, Any]]:
    """With those of earlier calls, in the table's order, and the study's tables and summary.

    Of tasks that end at one time, one gathers and writes after the other: the last has seen them all.
    """
    from lacli.base.processes.locks import working_on
    from lacli.cohort.analysis.summary import write_summary
    from lacli.cohort.files import SUMMARY
    from lacli.cohort.participants import read_participants
    from lacli.cohort.steps import read_settings

    every, shared, notes = read_participants(participants), read_settings(settings), list[str]()
    with working_on(folder / SUMMARY):
        for patient in every:
            if patient.identifier in outcomes:
                continue
            known, words = _earlier(patient, shared, folder.absolute() / patient.identifier, _absolute(scene))
            if known is not None:
                outcomes[patient.identifier] = known
            notes += [words] if words else []
        ordered = tuple(outcomes[p.identifier] for p in every if p.identifier in outcomes)
        return write_summary(folder, every, ordered, notes)


def _earlier(patient: Participant, shared: Settings, folder: Path, scene: Path | None) -> tuple[Outcome | None, str]:
    """What an earlier call left of a patient, and, where its results are no longer those of its inputs, a word on that alone."""
    from lacli.cohort.steps import steps_of
    from lacli.cohort.study import DONE, known_outcome, planned

    again, name = "run the study again. The tables are without it", patient.identifier
    try:
        known = known_outcome(folder)
        if known is None or known.status != "done":
            return known, ""
        rows = planned(patient, steps_of(patient, shared, folder, scene), folder)
    except LacliError as error:
        what = "was done from other inputs" if isinstance(error, UsageError) else "has files that cannot be read"
        return None, f"{name} {what}: {again} ({str(error).rstrip('.')})."
    lost = [row.step for row in rows if row.state != DONE]
    return (None, f"{name} is not done any more ({', '.join(lost)}): {again}.") if lost else (known, "")


def _absolute(scene: Path | None) -> Path | None:
    return None if scene is None else scene.absolute()


def _cost(chosen: Patients, rows: Sequence[Planned], folder: Path, settings: Path | None) -> dict[str, Any]:
    from lacli.cohort.analysis.summary import median_cpu_s
    from lacli.cohort.models.further import MOST_RUNS
    from lacli.cohort.steps import read_settings
    from lacli.cohort.study import TO_DO

    options = read_settings(settings).options
    given, most = options.get("calibrate", {}), int(options.get("compare", {}).get("max-runs", MOST_RUNS))
    todo = {(row.participant_id, row.step) for row in rows if row.state.startswith(TO_DO)}
    simulated = [
        (patient.identifier, step) for patient, steps in chosen for step in steps
        if step.arguments[0] == "calibrate" and "--from-table" not in step.arguments
    ]  # fmt: skip
    runs = [runs_at_most(step, given) for patient, step in simulated if (patient, step.name) in todo]
    each, of_reference = (max(counts, default=0) for counts in zip(*runs, strict=True)) if runs else (0, 0)
    of_runs, of_own = median_cpu_s(folder)
    compared = [
        patient for patient, step in simulated
        if (patient, "compare") in todo and method_of(_scene(step), given) == "sequential"
    ]  # fmt: skip
    return {
        "calibrations": len(runs), "runs_each": each, "cpu_s_per_run": of_runs,
        "reference_runs_each": of_reference, "cpu_s_per_reference_run": of_own,
        "compared": len(compared), "compared_runs_each": most if compared else 0,
    }  # fmt: skip


def runs_at_most(step: Step, given: Mapping[str, Any]) -> tuple[int, int]:
    """Runs of a calibration's step at most, with these options, and those of the scene's own that correct them, where they are
    cheap: of the sequential method, or where they or the scene ask for it, of the published one."""
    from lacli.calibration.calibration import Settings as Published
    from lacli.calibration.sequential.fidelity.companion import usual
    from lacli.calibration.sequential.search import Settings as Sequential

    scene = _scene(step)
    if method_of(scene, given) == "sequential":
        carried = given.get("cheap", usual(scene) if scene is not None else ())
        cheap = bool(carried) and "none" not in carried
        reference = int(given.get("reference-runs", Sequential.reference_runs)) if cheap else 0
        return int(given.get("max-runs", Sequential.max_runs)), reference
    default, names = Published(), ("first_runs", "wave_runs", "max_waves", "max_runs")
    first, following, waves, at_most = (int(given.get(name.replace("_", "-"), getattr(default, name))) for name in names)
    return min(at_most, first + following * (waves - 1)), 0


def method_of(scene: Scene | None, given: Mapping[str, Any]) -> str:
    """The method of a calibration with these options, of a scene as far as it can be read."""
    from lacli.api.methods.sequential import lacking

    if (method := given.get("method")) is not None:
        return str(method)
    told_none = scene is not None and bool(lacking(scene))
    published = given.get("sensitivities") is False or any(name in given for name in OF_WAVES) or told_none
    return "published" if published else "sequential"


def _scene(step: Step) -> Scene | None:
    """The step's scene; None of one that cannot be read: it fails later, with its reason."""
    from lacli.contracts.scene import load_scene

    words = step.arguments
    try:
        return load_scene(Path(words[1]), [words[i + 1] for i, word in enumerate(words) if word == "--set"])
    except LacliError:
        return None


def _write_slurm(
    participants: Path, folder: Path, script: Path, scene: Path | None, settings: Path | None, identifiers: list[str]
) -> None:
    import sys

    from lacli.base.files import write_text
    from lacli.cohort.slurm import array_script
    from lacli.cohort.steps import read_settings

    logs = _slurm_folder(folder.absolute())
    call = ["cohort", str(participants.absolute()), "--out", str(folder.absolute())]
    for option, file in (("--scene", scene), ("--settings", settings)):
        call += [option, str(file.absolute())] if file is not None else []
    write_text(script, array_script(sys.executable, call, identifiers, read_settings(settings), logs))


def _patients(participants: Path, folder: Path, scene: Path | None, settings: Path | None, only: Sequence[str]) -> Patients:
    from lacli.cohort.participants import check_targets, read_participants
    from lacli.cohort.steps import read_settings, steps_of

    if scene is not None and not scene.is_file():
        raise InputError(f"{scene}: no such scene.")
    every, shared = read_participants(participants), read_settings(settings)
    missing = [name for name in only if name not in [p.identifier for p in every]]
    if missing:
        raise UsageError(f"{participants}: no participant {', '.join(missing)}.")
    check_targets(every, participants)
    own = _absolute(scene)
    chosen = [p for p in every if not only or p.identifier in only]
    return [(p, steps_of(p, shared, folder.absolute() / p.identifier, own)) for p in chosen]
