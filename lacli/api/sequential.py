"""Calibration that seeks the posterior, in one call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.api.progress import Cancel, OnProgress, Stage
from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.calibration.price import Price
    from lacli.calibration.sequential.draw.information import Forecast
    from lacli.calibration.sequential.result import Sequential
    from lacli.calibration.sequential.search import Reference, Settings, Status
    from lacli.calibration.simulator import SceneSimulator
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box
    from lacli.inference.runs import RunLog

RUNS = "runs"  # the folder of the simulations in a calibration's own
FIGURES = ("corner.png", "trace.png")


@dataclass(frozen=True)
class Sought:
    """A calibration that sought the posterior, the folder of its files, and the pictures drawn.

    result: most probable point (d,), posterior by input, runs by stage, chain, what was met on the way (``notes``), and why it
    is no answer (``refused``, empty where it is one).
    """

    folder: Path
    result: Sequential
    pictures: tuple[Path, ...]


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
    cheap: Sequence[str] = (),
    figures: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Sought:
    """The posterior of a patient's parameters from few runs that tell their derivatives, with a check of the whole box.

    Targets and inputs are in the units of their names; targets at times of the cycle (``n_septum_mm@0.2``) make the frames of
    the simulations. The prior is uniform on the box (default: the published ranges of the 9 inputs). store: folder of the
    simulations (default: in ``folder``); workers: simulations side by side here, scheduler: address of a Dask scheduler
    instead; fresh: start in a sub-folder where ``folder`` holds something else; retry: run again what the machine has ended
    three times; discretisation: whether the targets' errors are widened by the scene's discretisation errors, measured or by the
    model (no, where the targets come from the very same numerics). cheap: ``key=value`` of numerics (``order=1``), or of
    ``anatomy.bundle`` (coarser cells): with them most runs are made, in the log ``runs_cheap.csv``, and about ten of the scene's
    own (``settings.reference_runs`` at most) correct them. Called again it goes on, and ends as if it had not been interrupted.
    Raises LacliError where runs tell no derivatives or too few finish, UsageError, TableError, AnatomyError,
    SolverMissingError, StorageError, Cancelled.
    """
    from lacli.base.files import superseded
    from lacli.calibration.sequential.calibration import calibrate_sequentially
    from lacli.inference.sampling.posterior import LEAST_CONTRACTION
    from lacli.report.inference_figures_posterior import corner_figure, trace_figure

    job = _prepared(scene, targets, folder, box, settings, store, workers, scheduler, fresh, retry, discretisation, cheap)
    stage = Stage("calibration", 1.0, progress, cancel)
    result = calibrate_sequentially(*job.parts, _hearing(stage), job.notes, reference=job.reference)
    folder, box = job.folder, job.box
    superseded(folder, *FIGURES)
    pictures: tuple[Path, ...] = ()
    if figures:
        stage.of("drawing", 0.0, 1.0)
        corner, trace = (folder / name for name in FIGURES)
        unlearnt = [str(row["input"]) for row in result.table if float(row["contraction"]) < LEAST_CONTRACTION]
        pictures = (corner_figure(result.chain, result.map_x, box, corner, as_prior=unlearnt), trace_figure(result.chain, trace))
    return Sought(folder, result, pictures)


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
    cheap: Sequence[str] = (),
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Forecast:
    """What the targets can teach of each input, before the calibration: its prior's sd, and the posterior's that is expected.

    In the inputs' units, from the derivatives of the few runs that ``seek`` begins with, and finds done. Arguments and errors as
    of ``seek``.
    """
    from lacli.calibration.sequential.calibration import forecast_sequentially

    job = _prepared(scene, targets, folder, box, settings, store, workers, scheduler, fresh, retry, discretisation, cheap)
    return forecast_sequentially(*job.parts, _hearing(Stage("forecast", 1.0, progress, cancel)))


def prices(
    scene: Scene,
    targets: Targets,
    folder: Path,
    *,
    settings: Settings | None = None,
    store: Path | None = None,
    cheap: Sequence[str] = (),
) -> tuple[Price, ...]:
    """What the calibration costs at most, by kind of run, without a run: the scene's own, and the cheap ones where there are any.

    Corrected by the finished runs in the store (default: in ``folder``), if there are any. Raises UsageError, SceneError,
    AnatomyError.
    """
    from lacli.calibration.price import price
    from lacli.calibration.sequential.fidelity.companion import companion
    from lacli.calibration.sequential.search import Settings
    from lacli.calibration.simulator import asked
    from lacli.mechanics.numerics.earlier import earlier

    if words := lacking(scene):
        raise UsageError(f"calibrate: {words} Change the scene, or use --method published.")
    settings, done = settings or Settings(), earlier(store or folder / RUNS)
    own = price("the scene's own", asked(scene, targets.names), settings.reference_runs if cheap else settings.max_runs, done)
    if not cheap:
        return (own,)
    beside = asked(companion(scene, cheap), targets.names)
    return own, price(f"cheap: {' '.join(cheap)}", beside, settings.max_runs, done)


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
    cheap: Sequence[str],
) -> _Job:
    """What is run, held against what, where."""
    from lacli.base.files import check_folder
    from lacli.calibration.calibration import obstacle
    from lacli.calibration.sequential.calibration import sequential_identity
    from lacli.calibration.sequential.fidelity.companion import companion
    from lacli.calibration.sequential.outputs import CHEAP, LOG
    from lacli.calibration.sequential.search import Reference, Settings
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
    kinds = [(scene, LOG), *([(companion(scene, cheap), CHEAP)] if cheap else [])]
    # its own numerics first; the cheap ones, if any, carry the search
    runs = [simulator(one, store or folder / RUNS, workers, scheduler, targets=targets.names) for one, _ in kinds]
    made = [runs_identity(run, box.names, targets.names) for run in runs]
    notes: list[str] = []
    if discretisation:
        targets, stated = with_discretisation(targets, scene)
        notes = said_of(targets.names, stated)
    identity = sequential_identity(box, targets, settings, made[-1], made[0] if cheap else None)
    beside = [(name, of_runs) for (_, name), of_runs in zip(kinds, made, strict=True)]

    def hindered(place: Path) -> str:
        return obstacle(place, identity) or next(filter(None, (in_the_way(place / name, of) for name, of in beside)), "")

    folder = settle(folder, hindered, fresh)
    logs = [RunLog(folder / name, box.names, targets.names, of_runs, retry) for name, of_runs in beside]
    reference = Reference(runs[0], logs[0]) if cheap else None
    return _Job(runs[-1], box, targets, settings, folder, logs[-1], notes, reference)


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
