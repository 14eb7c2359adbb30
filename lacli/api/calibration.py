"""The calibration of a patient in one call, its forecast, and its proof against known parameters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.api.methods.calibrated import Calibrated, Recovered
    from lacli.api.progress import Cancel, OnProgress
    from lacli.calibration.calibration import Settings as PublishedSettings
    from lacli.calibration.sequential.draw.information import Forecast
    from lacli.calibration.sequential.search import Settings as SequentialSettings
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box


@overload
def calibrate(
    scene: Scene | None,
    targets: Targets,
    folder: Path,
    *,
    forecast: Literal[False] = ...,
    method: Literal["sequential", "published"] | None = ...,
    truth: Mapping[str, float] | None = ...,
    table: Path | None = ...,
    box: Box | None = ...,
    settings: SequentialSettings | PublishedSettings | None = ...,
    store: Path | None = ...,
    workers: int | None = ...,
    scheduler: str | None = ...,
    sensitivities: bool = ...,
    fresh: bool = ...,
    retry: bool = ...,
    discretisation: bool = ...,
    figures: bool = ...,
    progress: OnProgress | None = ...,
    cancel: Cancel | None = ...,
) -> Calibrated: ...


@overload
def calibrate(
    scene: Scene | None,
    targets: Targets,
    folder: Path,
    *,
    forecast: Literal[True],
    method: Literal["sequential", "published"] | None = ...,
    truth: Mapping[str, float] | None = ...,
    table: Path | None = ...,
    box: Box | None = ...,
    settings: SequentialSettings | PublishedSettings | None = ...,
    store: Path | None = ...,
    workers: int | None = ...,
    scheduler: str | None = ...,
    sensitivities: bool = ...,
    fresh: bool = ...,
    retry: bool = ...,
    discretisation: bool = ...,
    figures: bool = ...,
    progress: OnProgress | None = ...,
    cancel: Cancel | None = ...,
) -> Forecast: ...


@overload
def calibrate(
    scene: Scene | None,
    targets: None,
    folder: Path,
    *,
    forecast: Literal[False] = ...,
    method: Literal["sequential", "published"] | None = ...,
    truth: Mapping[str, float] | None = ...,
    table: Path | None = ...,
    box: Box | None = ...,
    settings: SequentialSettings | PublishedSettings | None = ...,
    store: Path | None = ...,
    workers: int | None = ...,
    scheduler: str | None = ...,
    sensitivities: bool = ...,
    fresh: bool = ...,
    retry: bool = ...,
    discretisation: bool = ...,
    figures: bool = ...,
    progress: OnProgress | None = ...,
    cancel: Cancel | None = ...,
) -> Recovered: ...


def calibrate(
    scene: Scene | None,
    targets: Targets | None,
    folder: Path,
    *,
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
    fresh: bool = False,
    retry: bool = False,
    discretisation: bool = True,
    figures: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Calibrated | Forecast | Recovered:
    """The posterior of a patient's parameters, from simulations that are made where they tell most.

    Targets and inputs are in the units of their names; targets at times of the cycle (``n_septum_mm@0.2``) make the frames of
    the simulations. scene: what is run; or None, with a ``table`` of inputs and outputs of runs done elsewhere. method:
    ``sequential``, to the posterior with the runs' derivatives (tens of runs), or ``published``, waves over the box (hundreds);
    None: sequential where scene and settings let it. forecast: only what the targets can teach of each input, from the few
    runs that the sequential method begins with. targets: or None, and the scene is simulated at known parameters, ``truth``
    (those not named: away from centre and edges of the box), and calibrated at two noise levels by the published method.

    The prior is uniform on the box (default: the published ranges of the 9 inputs, or the table's). settings: runs, budgets,
    sampling, seed, of the method; store: folder of the simulations (default: in ``folder``); workers: simulations side by side
    here, scheduler: address of a Dask scheduler instead; sensitivities: whether runs tell their derivatives; fresh: start in a
    sub-folder where ``folder`` holds something else; retry: run again what the machine has ended three times; discretisation:
    whether the targets' errors are widened by the scene's discretisation errors, measured or by the model (no, where the
    targets come from the very same numerics; a table says its own). Called again it goes on, and ends as if it had not been
    interrupted. Raises LacliError where no point of the box reaches the targets or too few runs finish, UsageError, TableError,
    AnatomyError, SolverMissingError, StorageError, Cancelled.
    """
    from lacli.api.methods import published, sequential
    from lacli.calibration.calibration import Settings as PublishedSettings
    from lacli.calibration.sequential.search import Settings as SequentialSettings

    common: dict[str, Any] = {
        "box": box, "store": store, "workers": workers, "scheduler": scheduler, "fresh": fresh, "progress": progress,
        "cancel": cancel,
    }  # fmt: skip
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
        common |= {"settings": settings, "retry": retry, "discretisation": discretisation}
        if forecast:
            return sequential.foresee(scene, targets, folder, **common)
        return sequential.seek(scene, targets, folder, figures=figures, **common)
    if isinstance(settings, SequentialSettings):
        raise UsageError("calibrate: these settings are of the sequential method.")
    if forecast:
        raise UsageError("calibrate: a forecast is of the sequential method, which needs a scene whose runs tell derivatives.")
    if targets is None:
        if scene is None:
            raise UsageError("calibrate: known parameters are simulated; give a scene.")
        return published.recover(scene, folder, truth=truth, settings=settings, figures=figures, **common)
    return published.calibrate_by_waves(
        scene, targets, folder, table=table, settings=settings, sensitivities=sensitivities, retry=retry,
        discretisation=discretisation, figures=figures, **common,
    )  # fmt: skip
