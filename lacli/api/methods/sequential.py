"""The sequential method: a calibration that seeks the posterior, its forecast, and its price."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.api.methods.calibrated import Calibrated, Work
from lacli.api.progress import Stage
from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.calibration.price import Price
    from lacli.calibration.sequential.draw.information import Forecast
    from lacli.calibration.sequential.search import Reference, Settings, Status
    from lacli.calibration.simulator import SceneSimulator
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box
    from lacli.inference.runs import RunLog

ANNULUS = "the annulus's error"  # the stage, and the kind of runs
RUNS = "runs"  # the folder of the simulations in a calibration's own
FIGURES = ("corner.png", "trace.png", "fit.png")


def seek(
    scene: Scene,
    targets: Targets,
    folder: Path,
    settings: Settings | None,
    work: Work,
) -> Calibrated:
    """The posterior of a patient's parameters from few runs that tell their derivatives, with a check of the whole box.

    Arguments and errors as of ``lacli.calibrate``. Raises LacliError too where runs tell no derivatives or too few finish.
    """
    import numpy as np

    from lacli.base.files import superseded
    from lacli.calibration.sequential.calibration import calibrate_sequentially
    from lacli.inference.sampling.posterior import LEAST_CONTRACTION
    from lacli.report.inference_figures_posterior import corner_figure, fit_figure, trace_figure

    job = _prepared(scene, targets, folder, settings, work)
    stage = Stage("calibration", 1.0, work.progress, work.cancel)
    result = calibrate_sequentially(*job.parts, _hearing(stage), job.notes, reference=job.reference)
    folder, box = job.folder, job.box
    superseded(folder, *FIGURES)
    pictures: tuple[Path, ...] = ()
    if work.figures:
        stage.of("drawing", 0.0, 1.0)
        corner, trace, fit = (folder / name for name in FIGURES)
        unlearnt = [str(row["input"]) for row in result.table if float(row["contraction"]) < LEAST_CONTRACTION]
        pictures = (
            corner_figure(result.chain, result.map_x, box, corner, as_prior=unlearnt), trace_figure(result.chain, trace),
            fit_figure(result.fit, np.empty((0, len(result.fit))), fit),
        )  # fmt: skip
    return Calibrated(folder, result, result.notes, (), result.refused, pictures)


def foresee(
    scene: Scene,
    targets: Targets,
    folder: Path,
    settings: Settings | None,
    work: Work,
) -> Forecast:
    """What the targets can teach of each input, before the calibration: its prior's sd, and the posterior's that is expected.

    In the inputs' units, from the derivatives of the few runs that ``seek`` begins with, and finds done. Arguments and errors as
    of ``seek``.
    """
    from lacli.calibration.sequential.calibration import forecast_sequentially

    job = _prepared(scene, targets, folder, settings, work)
    hear = _hearing(Stage("forecast", 1.0, work.progress, work.cancel))
    return forecast_sequentially(*job.parts, hear, job.reference)


def prices(scene: Scene, targets: Targets, folder: Path, settings: Settings | None, work: Work) -> tuple[Price, ...]:
    """What the calibration costs at most, by kind of run, without a run: the scene's own, the cheap ones where there are any, and
    those that tell what the error of a tracked annulus does.

    Corrected by the finished runs in the store (default: in ``folder``), if there are any. Raises UsageError, SceneError,
    AnatomyError.
    """
    from lacli.calibration.annulus import known_share
    from lacli.calibration.price import price
    from lacli.calibration.sequential.fidelity.companion import companion
    from lacli.calibration.sequential.search import Settings
    from lacli.calibration.simulator import asked, check_end_systole, of_known_loads
    from lacli.contracts.priors import check_priors
    from lacli.contracts.sections import ANNULUS_MODES
    from lacli.inference.box import published_box
    from lacli.mechanics.numerics.earlier import earlier

    if words := lacking(scene):
        raise UsageError(f"calibrate: {words} Change the scene, or use --method published.")
    check_end_systole(scene, targets)
    of_known_loads(scene, targets)  # refused where nothing is left; frames that are only foretold cost as much
    box = work.box or published_box()
    check_priors(targets.priors, box.names, box.lower, box.upper)
    settings, done = settings or Settings(), earlier(work.store or folder / RUNS)
    run = companion(scene, work.cheap) if work.cheap else scene  # what carries the search
    own = price(
        "the scene's own", asked(scene, targets.names), settings.reference_runs if work.cheap else settings.max_runs, done
    )
    found = [own]
    if work.cheap:
        found.append(price(f"cheap: {' '.join(work.cheap)}", asked(run, targets.names), settings.max_runs, done))
    if known_share(scene):
        found.append(price(ANNULUS, asked(run, targets.names, sensitivities=False), 1 + ANNULUS_MODES, done))
    return tuple(found)


@dataclass(frozen=True)
class _Job:
    simulator: SceneSimulator
    box: Box
    targets: Targets
    settings: Settings
    folder: Path
    log: RunLog
    notes: list[str]
    reference: Reference | None

    @property
    def parts(self) -> tuple[SceneSimulator, Box, Targets, Settings, Path, RunLog]:
        return self.simulator, self.box, self.targets, self.settings, self.folder, self.log


def _prepared(scene: Scene, targets: Targets, folder: Path, settings: Settings | None, work: Work) -> _Job:
    """What is run, held against what, where."""
    from lacli.base.files import check_folder, write_text
    from lacli.calibration.annulus import annulus_effects, with_annulus, write_effects
    from lacli.calibration.calibration import obstacle
    from lacli.calibration.sequential.calibration import sequential_identity
    from lacli.calibration.sequential.fidelity.companion import companion
    from lacli.calibration.sequential.outputs import CHEAP, LOG, SIMULATED, SIMULATED_CHEAP
    from lacli.calibration.sequential.search import Reference, Settings
    from lacli.calibration.simulator import asked, check_end_systole, of_known_loads, simulator
    from lacli.contracts.identity import settle
    from lacli.contracts.scene import dump_scene
    from lacli.inference.box import published_box
    from lacli.inference.runs import RunLog, runs_identity
    from lacli.inference.runs import obstacle as in_the_way
    from lacli.mechanics.numerics.stated import said_of, with_discretisation

    if words := lacking(scene):
        raise UsageError(f"calibrate: {words} Change the scene, or use --method published.")
    check_end_systole(scene, targets)
    framed = targets.names  # frames that are not calibrated to are simulated all the same: they are foretold
    targets, notes = of_known_loads(scene, targets)
    check_folder(folder)
    settings, box = settings or Settings(), work.box or published_box()
    kinds = [(scene, LOG), *([(companion(scene, work.cheap), CHEAP)] if work.cheap else [])]
    # its own numerics first; the cheap ones, if any, carry the search
    runs = [
        simulator(one, work.store or folder / RUNS, work.workers, work.scheduler, targets=framed, warm=work.warm)
        for one, _ in kinds
    ]
    made = [runs_identity(run, box.names, targets.names) for run in runs]
    stage = Stage(ANNULUS, 1.0, work.progress, work.cancel)
    effects, words = annulus_effects(
        scene, kinds[-1][0], box, targets, lambda one: simulator(
            one, work.store or folder / RUNS, 1, work.scheduler, targets=framed, sensitivities=False, discretisation=False
        ), lambda done, total: stage.of(ANNULUS, done, total)
    )  # fmt: skip
    targets = with_annulus(targets, effects)
    notes += [f"{words}."] if words else []
    if work.discretisation:
        targets, stated = with_discretisation(targets, scene)
        notes += said_of(targets.names, stated)
    identity = sequential_identity(box, targets, settings, made[-1], made[0] if work.cheap else None)
    beside = [(name, of_runs) for (_, name), of_runs in zip(kinds, made, strict=True)]

    def hindered(place: Path) -> str:
        return obstacle(place, identity) or next(filter(None, (in_the_way(place / name, of) for name, of in beside)), "")

    folder = settle(folder, hindered, work.fresh)
    write_effects(folder, effects)
    for (one, _), name in zip(kinds, (SIMULATED, SIMULATED_CHEAP), strict=False):
        write_text(folder / name, dump_scene(asked(one, framed)))
    logs = [RunLog(folder / name, box.names, targets.names, of_runs, work.retry) for name, of_runs in beside]
    reference = Reference(runs[0], logs[0]) if work.cheap else None
    return _Job(runs[-1], box, targets, settings, folder, logs[-1], notes, reference)


def _hearing(stage: Stage) -> Callable[[Status], None]:
    def hear(status: Status) -> None:
        stage.of(f"{status.stage}, {status.runs} runs" if not status.total else status.stage, status.done, status.total)

    return hear


def lacking(scene: Scene) -> str:
    """Why runs of the scene tell no derivatives, which the search needs, in words; '' where they do."""
    from lacli.mechanics.engine import obstacle as of_engine

    if scene.numerics.unloading != "prestrain" or scene.numerics.engine == "script":
        return (
            'the sequential method needs derivatives, which only the compiled engine with numerics.unloading = "prestrain" has.'
        )
    if obstacle := of_engine(scene.numerics.engine):
        return f"the sequential method needs derivatives, which only the compiled engine has: {obstacle}."
    if scene.numerics.rest_sweeps:
        return "the sequential method needs derivatives, which runs have only with numerics.rest_sweeps = 0."
    return ""
