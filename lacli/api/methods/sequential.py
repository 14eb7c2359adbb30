"""The sequential method: a calibration that seeks the posterior, and its forecast."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.api.methods.calibrated import Calibrated
from lacli.api.progress import Cancel, OnProgress, Stage
from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.calibration.sequential.draw.information import Forecast
    from lacli.calibration.sequential.search import Settings, Status
    from lacli.calibration.simulator import SceneSimulator
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box
    from lacli.inference.runs import RunLog

RUNS = "runs"  # the folder of the simulations in a calibration's own
FIGURES = ("corner.png", "trace.png")


def seek(
    scene: Scene,
    targets: Targets,
    folder: Path,
    *,
    box: Box | None = None,
    settings: Settings | None = None,
    store: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    fresh: bool = False,
    retry: bool = False,
    discretisation: bool = True,
    figures: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Calibrated:
    """The posterior of a patient's parameters from few runs that tell their derivatives, with a check of the whole box.

    Arguments and errors as of ``lacli.calibrate``. Raises LacliError too where runs tell no derivatives or too few finish.
    """
    from lacli.base.files import superseded
    from lacli.calibration.sequential.calibration import calibrate_sequentially
    from lacli.inference.sampling.posterior import LEAST_CONTRACTION
    from lacli.report.inference_figures_posterior import corner_figure, trace_figure

    job = _prepared(scene, targets, folder, box, settings, store, workers, scheduler, fresh, retry, discretisation)
    stage = Stage("calibration", 1.0, progress, cancel)
    result = calibrate_sequentially(*job.parts, _hearing(stage), job.notes)
    folder, box = job.folder, job.box
    superseded(folder, *FIGURES)
    pictures: tuple[Path, ...] = ()
    if figures:
        stage.of("drawing", 0.0, 1.0)
        corner, trace = (folder / name for name in FIGURES)
        unlearnt = [str(row["input"]) for row in result.table if float(row["contraction"]) < LEAST_CONTRACTION]
        pictures = (corner_figure(result.chain, result.map_x, box, corner, as_prior=unlearnt), trace_figure(result.chain, trace))
    return Calibrated(folder, result, result.notes, (), result.refused, pictures)


def foresee(
    scene: Scene,
    targets: Targets,
    folder: Path,
    *,
    box: Box | None = None,
    settings: Settings | None = None,
    store: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    fresh: bool = False,
    retry: bool = False,
    discretisation: bool = True,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Forecast:
    """What the targets can teach of each input, before the calibration: its prior's sd, and the posterior's that is expected.

    In the inputs' units, from the derivatives of the few runs that ``seek`` begins with, and finds done. Arguments and errors as
    of ``seek``.
    """
    from lacli.calibration.sequential.calibration import forecast_sequentially

    job = _prepared(scene, targets, folder, box, settings, store, workers, scheduler, fresh, retry, discretisation)
    return forecast_sequentially(*job.parts, _hearing(Stage("forecast", 1.0, progress, cancel)))


@dataclass(frozen=True)
class _Job:
    simulator: SceneSimulator
    box: Box
    targets: Targets
    settings: Settings
    folder: Path
    log: RunLog
    notes: list[str]

    @property
    def parts(self) -> tuple[SceneSimulator, Box, Targets, Settings, Path, RunLog]:
        return self.simulator, self.box, self.targets, self.settings, self.folder, self.log


def _prepared(
    scene: Scene,
    targets: Targets,
    folder: Path,
    box: Box | None,
    settings: Settings | None,
    store: Path | None,
    workers: int | None,
    scheduler: str | None,
    fresh: bool,
    retry: bool,
    discretisation: bool,
) -> _Job:
    """What is run, held against what, where."""
    from lacli.base.files import check_folder
    from lacli.calibration.calibration import obstacle
    from lacli.calibration.sequential.calibration import sequential_identity
    from lacli.calibration.sequential.search import Settings
    from lacli.calibration.simulator import simulator
    from lacli.contracts.identity import settle
    from lacli.inference.box import published_box
    from lacli.inference.runs import RunLog, runs_identity
    from lacli.inference.runs import obstacle as in_the_way
    from lacli.mechanics.numerics.stated import said_of, with_discretisation

    if words := lacking(scene):
        raise UsageError(f"calibrate: {words} Change the scene, or use --method published.")
    check_folder(folder)
    settings, box = settings or Settings(), box or published_box()
    run = simulator(scene, store or folder / RUNS, workers, scheduler, targets=targets.names)
    of_runs = runs_identity(run, box.names, targets.names)
    notes: list[str] = []
    if discretisation:
        targets, stated = with_discretisation(targets, scene)
        notes = said_of(targets.names, stated)
    identity = sequential_identity(box, targets, settings, of_runs)
    folder = settle(folder, lambda place: obstacle(place, identity) or in_the_way(place / "runs.csv", of_runs), fresh)
    log = RunLog(folder / "runs.csv", box.names, targets.names, of_runs, retry)
    return _Job(run, box, targets, settings, folder, log, notes)


def _hearing(stage: Stage) -> Callable[[Status], None]:
    def hear(status: Status) -> None:
        stage.of(f"{status.stage}, {status.runs} runs" if not status.total else status.stage, status.done, status.total)

    return hear


def lacking(scene: Scene) -> str:
    """Why runs of the scene tell no derivatives, which the search needs, in words; '' where they do."""
    if scene.numerics.unloading != "prestrain" or scene.numerics.engine == "script":
        return (
            'the sequential method needs derivatives, which only the compiled engine with numerics.unloading = "prestrain" has.'
        )
    return ""
