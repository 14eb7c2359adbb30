"""The calibration of a patient in one call, its forecast, and its proof against known parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict, Unpack, overload

from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.api.methods.calibrated import Calibrated, Recovered
    from lacli.api.progress import Cancel, OnProgress
    from lacli.calibration.calibration import Settings as PublishedSettings
    from lacli.calibration.price import Price
    from lacli.calibration.sequential.draw.information import Forecast
    from lacli.calibration.sequential.search import Settings as SequentialSettings
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box

    class Options(TypedDict, total=False):
        """Arguments of ``calibrate`` that its answer's type does not hang on."""

        method: Literal["sequential", "published"] | None
        truth: Mapping[str, float] | None
        table: Path | None
        box: Box | None
        settings: SequentialSettings | PublishedSettings | None
        store: Path | None
        workers: int | None
        scheduler: str | None
        sensitivities: bool
        warm: bool
        fresh: bool
        retry: bool
        discretisation: bool
        cheap: Sequence[str] | None
        figures: bool
        progress: OnProgress | None
        cancel: Cancel | None


@overload
def calibrate(
    scene: Scene | None,
    targets: Targets,
    folder: Path,
    *,
    dry_run: Literal[False] = ...,
    forecast: Literal[False] = ...,
    **options: Unpack[Options],
) -> Calibrated: ...


@overload
def calibrate(
    scene: Scene | None,
    targets: Targets,
    folder: Path,
    *,
    dry_run: Literal[False] = ...,
    forecast: Literal[True],
    **options: Unpack[Options],
) -> Forecast: ...


@overload
def calibrate(
    scene: Scene | None,
    targets: Targets,
    folder: Path,
    *,
    dry_run: Literal[True],
    forecast: Literal[False] = ...,
    **options: Unpack[Options],
) -> tuple[Price, ...]: ...


@overload
def calibrate(
    scene: Scene | None,
    targets: None,
    folder: Path,
    *,
    dry_run: Literal[False] = ...,
    forecast: Literal[False] = ...,
    **options: Unpack[Options],
) -> Recovered: ...


def calibrate(
    scene: Scene | None,
    targets: Targets | None,
    folder: Path,
    *,
    dry_run: bool = False,
    forecast: bool = False,
    method: Literal["sequential", "published"] | None = None,
    truth: Mapping[str, float] | None = None,
    table: Path | None = None,
    box: Box | None = None,
    settings: SequentialSettings | PublishedSettings | None = None,
    store: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    sensitivities: bool = True,
    warm: bool = False,
    fresh: bool = False,
    retry: bool = False,
    discretisation: bool = True,
    cheap: Sequence[str] | None = None,
    figures: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Calibrated | Forecast | Recovered | tuple[Price, ...]:
    """The posterior of a patient's parameters, from simulations that are made where they tell most.

    Targets and inputs are in the units of their names; targets at times of the cycle (``n_septum_mm@0.2``) make the frames of
    the simulations; those after end-systole are calibrated to only where the scene knows their pressure (a note tells).
    scene: what is run; or None, with a ``table`` of inputs and outputs of runs done elsewhere. method:
    ``sequential``, to the posterior with the runs' derivatives (tens of runs), or ``published``, waves over the box (hundreds);
    None: sequential where scene and settings let it. forecast: only what the targets can teach of each input, from the few
    runs that the sequential method begins with; dry_run: only what it costs at most, by kind of run. targets: or None, and the
    scene is simulated at known parameters, ``truth`` (those not named: away from centre and edges of the box), and calibrated
    at two noise levels by the published method.

    The prior is uniform on the box (default: the published ranges of the 9 inputs, or the table's). settings: runs, budgets,
    sampling, seed, of the method; store: folder of the simulations (default: in ``folder``); workers: simulations side by side
    here, scheduler: address of a Dask scheduler instead; sensitivities: whether runs tell their derivatives; warm: runs
    start from the nearest that has ended, and end as the others do to the solver's tolerance; fresh: start in a sub-folder
    where ``folder`` holds something else; retry: run again what the machine has ended three times; discretisation:
    whether the targets' errors are widened by the scene's discretisation errors, measured or by the model (no, where the
    targets come from the very same numerics; a table says its own). cheap: of the sequential method, ``key=value`` of numerics
    (``order=1``), or of ``anatomy.bundle`` (coarser cells): with them most runs are made, and about ten of the scene's own
    (``settings.reference_runs`` at most) correct them; None: linear cells where the scene's are quadratic, empty: none. Called
    again it goes on, and ends as if it had not been interrupted. Raises LacliError where no point of the box reaches the targets
    or too few runs finish, UsageError, TableError, AnatomyError, SolverMissingError, StorageError, Cancelled.
    """
    from lacli.api.methods import published, sequential
    from lacli.api.methods.calibrated import Work
    from lacli.calibration.calibration import Settings as PublishedSettings
    from lacli.calibration.sequential.fidelity.companion import usual
    from lacli.calibration.sequential.search import Settings as SequentialSettings

    work = Work(box, store, workers, scheduler, sensitivities, fresh, retry, discretisation, figures, progress, cancel, warm=warm)
    if (scene is None) == (table is None):
        raise UsageError("calibrate: give either a scene to simulate, or a table of runs done elsewhere.")
    if method is None:
        waves = isinstance(settings, PublishedSettings) or not sensitivities
        seeks = scene is not None and targets is not None and not waves and not sequential.lacking(scene)
        method = "sequential" if seeks else "published"
    if method == "sequential":
        if scene is None or targets is None or not sensitivities or isinstance(settings, PublishedSettings):
            raise UsageError(
                "calibrate: the sequential method needs a scene whose runs tell derivatives, targets, its own settings."
            )
        carried = tuple(usual(scene) if cheap is None else cheap)
        work = replace(work, cheap=carried)
        if dry_run:
            return sequential.prices(scene, targets, folder, settings, work)
        if forecast:
            return sequential.foresee(scene, targets, folder, settings, work)
        return sequential.seek(scene, targets, folder, settings, work)
    if isinstance(settings, SequentialSettings):
        raise UsageError("calibrate: these settings are of the sequential method.")
    if forecast or dry_run or cheap:
        raise UsageError(
            "calibrate: forecast, price and cheap runs are of the sequential method; the scene must tell derivatives."
        )
    if targets is not None:
        return published.calibrate_by_waves(scene, table, targets, folder, settings, work)
    if scene is None:
        raise UsageError("calibrate: known parameters are simulated; give a scene.")
    return published.recover(scene, truth or {}, folder, settings, work)
