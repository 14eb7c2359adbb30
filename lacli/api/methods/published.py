"""The published method: waves over the box, history matching; of a patient, and against known parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.api.methods.calibrated import Calibrated, Recovered, Work
from lacli.api.posterior import ELSEWHERE, check_prior
from lacli.api.progress import Cancel, OnProgress, Stage
from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.base.arrays import FloatArray
    from lacli.calibration.calibration import Settings, Status
    from lacli.calibration.simulator import SceneSimulator
    from lacli.contracts.identity import Identity
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box

WAVES = "runs"  # the folder of the simulations in a calibration's own
REFUSED = "the most probable point misses a target by more than the threshold: this is no answer. Check the targets."


def calibrate_by_waves(
    scene: Scene | None, table: Path | None, targets: Targets, folder: Path, settings: Settings | None, work: Work
) -> Calibrated:
    """The calibration of a patient: waves of runs, history matching, the posterior, and the run at its most probable point.

    Arguments and errors as of ``lacli.calibrate``. Raises LacliError too where no point of the box reaches the targets.
    """
    from lacli.base.files import superseded
    from lacli.calibration.calibration import Settings
    from lacli.calibration.calibration import calibrate as run_waves
    from lacli.calibration.from_table import calibrate_table
    from lacli.report import calibration_figures as drawing

    settings = settings or Settings()
    _check(settings, folder)
    hear = _Listener(work.progress, work.cancel)
    said: list[str] = []
    if table is not None:
        folder, result = calibrate_table(table, targets, work.box, settings, folder, work.fresh, hear)
    else:
        from lacli.base.processes.locks import working_on
        from lacli.calibration.annulus import known_share, left_out
        from lacli.calibration.calibration import calibration_identity, obstacle
        from lacli.calibration.simulator import check_end_systole, of_known_loads
        from lacli.inference.box import published_box
        from lacli.inference.runs import RunLog, runs_identity
        from lacli.mechanics.numerics.stated import MEASURED, said_of, with_discretisation

        assert scene is not None
        check_end_systole(scene, targets)
        framed = targets.names  # frames that are not calibrated to are simulated all the same: they are foretold
        targets, said = of_known_loads(scene, targets)
        box = work.box or published_box()
        if work.discretisation:
            # what was measured is in the table of runs already, and reaches the likelihood from there
            targets, stated = with_discretisation(targets, scene, but=MEASURED)
            said += said_of(targets.names, stated)
        if share := known_share(scene):
            said.append(f"{left_out(share)}; the sequential method has it.")
        run = _simulator(scene, folder, work, framed, work.sensitivities, work.discretisation)
        of_runs = runs_identity(run, box.names, targets.names)
        identity = calibration_identity(box, targets, settings, of_runs)
        folder = _settle(folder, lambda place: obstacle(place, identity), of_runs, work.fresh)
        with working_on(folder):
            log = RunLog(folder / "runs.csv", box.names, targets.names, of_runs, work.retry)
            result = run_waves(run, box, targets, settings, folder, log, monitor=hear)
    superseded(folder, *drawing.FIGURES)
    pictures: list[Path] = []
    if work.figures:
        hear.drawing()
        pictures = drawing.draw_calibration(result, folder)
    notes = tuple(dict.fromkeys([*said, *(note for wave in result.waves for note in wave.notes)]))
    beyond = result.beyond
    refused = REFUSED if not result.verdict.plausible else ELSEWHERE if beyond is not None and beyond.refused else ""
    warnings = (*(beyond.warnings if beyond is not None else ()), *result.verdict.warnings())
    return Calibrated(folder, result, notes, warnings, refused, tuple(pictures))


def recover(scene: Scene, truth: Mapping[str, float], folder: Path, settings: Settings | None, work: Work) -> Recovered:
    """What calibrations find of parameters that are known: the scene is simulated there, and calibrated at two noise levels.

    truth: values of some inputs, in the units of their names (others: away from the centre and the edges of the box); the
    noise is 0.2 mm and 5 % of the volume, then 1 mm and 20 %. Everything else as ``lacli.calibrate``. Raises LacliError where
    the simulation at the truth fails.
    """
    from lacli.base.files import superseded
    from lacli.base.processes.locks import working_on
    from lacli.calibration.calibration import Settings, obstacle
    from lacli.calibration.synthetic_truth import logged, truth_identity, verify
    from lacli.inference.box import OUTPUTS, published_box
    from lacli.inference.runs import runs_identity
    from lacli.report import calibration_figures as drawing

    settings = settings or Settings()
    _check(settings, folder)
    box = work.box or published_box()
    run = _simulator(scene, folder, work, (), False, discretisation=False)  # the truth has the same numerics
    x = _point(truth, box)
    of_runs = runs_identity(run, box.names, logged(OUTPUTS))
    identity = truth_identity(run, box, OUTPUTS, x, settings)
    folder = _settle(folder, lambda place: obstacle(place, identity), of_runs, work.fresh)
    hear = _Listener(work.progress, work.cancel)
    with working_on(folder):
        levels = verify(run, box, OUTPUTS, x, settings, folder, hear, work.retry)
    superseded(folder, drawing.RECOVERY, *(f"{r.level}/{name}" for r in levels for name in drawing.FIGURES))
    pictures: list[Path] = []
    if work.figures:
        hear.drawing()
        pictures = drawing.draw_recoveries(levels, box, folder)
    return Recovered(folder, tuple(levels), tuple(pictures))


def _check(settings: Settings, folder: Path) -> None:
    from lacli.base.files import check_folder

    check_prior(settings.prior)
    check_folder(folder)


def _simulator(
    scene: Scene, folder: Path, work: Work, targets: Sequence[str], sensitivities: bool, discretisation: bool
) -> SceneSimulator:
    from lacli.calibration.simulator import simulator

    store = work.store or folder / WAVES
    return simulator(
        scene, store, work.workers, work.scheduler, targets=targets, sensitivities=sensitivities, warm=work.warm,
        discretisation=discretisation,
    )  # fmt: skip


def _settle(folder: Path, in_the_way: Callable[[Path], str], of_runs: Identity, fresh: bool) -> Path:
    """Where the calibration goes: neither another one nor a table of other runs may be there."""
    from lacli.contracts.identity import settle
    from lacli.inference.runs import obstacle

    return settle(folder, lambda place: in_the_way(place) or obstacle(place / "runs.csv", of_runs), fresh)


def _point(truth: Mapping[str, float], box: Box) -> FloatArray:
    """The known parameters (d,). Raises UsageError for a name that is no input, and outside the box."""
    from lacli.calibration.synthetic_truth import default_truth

    x = default_truth(box)
    for name, value in truth.items():
        if name not in box.names:
            raise UsageError(f"--truth {name}: no input of the box; its inputs are {', '.join(box.names)}.")
        x[box.names.index(name)] = value
    for name, value, low, high in zip(box.names, x, box.lower, box.upper, strict=True):
        if not low <= value <= high:
            raise UsageError(f"--truth: {name} is {value:g}, outside the box ({low:g} to {high:g}). Set --truth {name}=VALUE.")
    for i, j in box.ordered:
        if not x[i] < x[j]:
            a, b = box.names[i], box.names[j]
            raise UsageError(f"--truth: {a} is {x[i]:g}, not below {b}, {x[j]:g}. Set --truth {a}=VALUE or {b}=VALUE.")
    return x


class _Listener:
    """A calibration's words as progress, each step of a wave a stage of its own."""

    def __init__(self, progress: OnProgress | None, cancel: Cancel | None) -> None:
        self._stage = Stage("calibration", 1.0, progress, cancel)

    def __call__(self, status: Status) -> None:
        self._stage.of(f"wave {status.wave}: {status.stage}", status.done, status.total, status)

    def drawing(self) -> None:
        self._stage.of("drawing", 0.0, 1.0)
