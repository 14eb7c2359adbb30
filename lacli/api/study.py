"""What is made of results: models of a patient compared, statistics over patients, a page on a run, a patient or a study."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.base.errors import LacliError, UsageError

if TYPE_CHECKING:
    from lacli.api.progress import Cancel, OnProgress, Stage
    from lacli.base.arrays import FloatArray
    from lacli.cohort.analysis.statistics import Statistics
    from lacli.cohort.comparison import Comparison, Model
    from lacli.cohort.models.further import Doubt, Further, Informed
    from lacli.contracts.targets import Targets

_PARTICLES = 200  # of the sampler, to see whether the emulators' errors count


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
    max_runs: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Comparison:
    """Models of one calibrated patient: each region its own stiffness, one for all, regions that vary about a common level, and
    ``tied``: groups of inputs that are one.

    patient: the folder of a calibration, targets: what it was made to. others: name -> the calibration to the same targets on
    another anatomy, such as one of uniform thickness. Emulators stand for runs. Where a model is likely but the calibration (by
    the sequential method) made no runs, so that the emulators' error counts in its evidence, up to ``max_runs`` (default: 16) are
    made there with the calibration's own numerics, and kept in its folder: for each of the calibrations, ``workers`` side by side
    here, or on the Dask ``scheduler``. particles: of the sampler, at least 100. Targets that one of the calibrations left out are
    left out for all, with a word among the warnings; so are early frames where even these runs do not tell an evidence.
    Evidences have no units, misfits are in mm. Raises InputError, UsageError, LacliError, StorageError, Cancelled.
    """
    from lacli.api.methods.sequential import RUNS
    from lacli.api.progress import Stage
    from lacli.base.threads import one_thread
    from lacli.cohort import comparison
    from lacli.cohort.models.further import MOST_RUNS, further
    from lacli.cohort.patient import held_against, read_model, shared
    from lacli.contracts.targets import read_targets

    if particles < 100:
        raise UsageError(f"compare: {particles} particles; at least 100.")
    max_runs = MOST_RUNS if max_runs is None else max_runs
    if max_runs < 0:
        raise UsageError(f"compare: {max_runs} runs; 0 or more.")
    wanted = read_targets(targets)
    read = [(patient, read_model(patient, wanted))]
    read += [(folder, read_model(folder, wanted, name)) for name, folder in (others or {}).items()]
    features, words = shared(read)
    regional, *rest = (replace(model, emulators=model.emulators.select(features)) for _, model in read)
    held = held_against(patient, wanted)
    regions = comparison.tied_regions(regional.box.names)
    models = [
        regional,
        comparison.Model(comparison.GLOBAL, regional.emulators, regional.box, regions),
        comparison.Model(comparison.POOLED, regional.emulators, regional.box, regions, spread=True),
    ]
    if tied:
        models.append(comparison.Model("tied", regional.emulators, regional.box, tuple(map(tuple, tied))))
    of_folder = [(patient, models), *((folder, [model]) for (folder, _), model in zip(read[1:], rest, strict=True))]
    for model in rest:
        if model.name in [m.name for m in models]:
            raise UsageError(f"compare: two models are named {model.name}.")
        models = [*models, model]
    for model in models:
        comparison.reduced(model)
    with one_thread():
        stage = Stage("the emulators' errors", 1.0, progress, cancel).begin()
        learnt = []
        for folder, group in of_folder:
            make = functools.partial(
                further, folder, group[0].box, held_against(folder, wanted), max_runs, folder / RUNS, workers, scheduler
            )
            learnt.append(_informed(group, held, make, seed, stage))
        models = _alike([model for group, _ in learnt for model in group])
        stage.of("comparison", 0, 4 * len(models))
        found = comparison.compare(models, held, particles, seed, stage.step)
    more = [of for _, of in learnt if of is not None]
    said = (*filter(None, (words, *(of.words for of in more))), *found.warnings)
    return replace(found, warnings=said, runs=sum(of.runs for of in more), reference_runs=sum(of.reference_runs for of in more))


def _informed(
    models: Sequence[Model], held: Targets, make: Callable[[], Further | str], seed: int, stage: Stage
) -> tuple[list[Model], Informed | None]:
    """Models of one calibration with the runs that their evidence asks for; None where their emulators tell no joint errors."""
    from lacli.calibration.sequential.outputs import Features
    from lacli.cohort import comparison
    from lacli.cohort.models.further import informed

    emulators = {model.name: model.emulators for model in models if isinstance(model.emulators, Features)}
    if not emulators:
        return list(models), None

    def doubts(learnt: Mapping[str, Features]) -> Mapping[str, Doubt]:
        asked = [replace(model, emulators=learnt[model.name]) for model in models if model.name in learnt]
        stage.of("the emulators' errors", 0, 2 * len(asked))
        return comparison.doubts(asked, held, _PARTICLES, seed, stage.step)

    found = informed(make, emulators, doubts, seed, stage.of)
    return [replace(model, emulators=found.emulators[model.name]) for model in models], found


def _alike(models: Sequence[Model]) -> list[Model]:
    """Models of the same targets: those that all of them foretell."""
    told = [name for name in models[0].emulators.outputs if all(name in model.emulators.outputs for model in models)]
    made = {id(model.emulators): model.emulators.select(told) for model in models}
    return [replace(model, emulators=made[id(model.emulators)]) for model in models]


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
    from lacli.cohort.files import SUMMARY
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
    """Points of the endocardium and their wall thickness, mm, from the run's bundle; None and why where it is not there, or
    another one by now."""
    from lacli.anatomy.wall.thickness import of_bundle
    from lacli.base.documents import read_json
    from lacli.contracts.bundle import load
    from lacli.contracts.scene import load_scene
    from lacli.report.page.run import changed_since

    try:
        scene = load_scene(run / "scene.toml")
        if changed := changed_since(scene, read_json(run / "manifest.json")):
            return None, f"Wall thickness is not shown: {changed}"
        bundle = load(Path(scene.anatomy.bundle))
        found = of_bundle(bundle)
    except LacliError as error:
        return None, f"Wall thickness is not shown: {error}"
    return (bundle.points[found.ids], found.laplace), ""
