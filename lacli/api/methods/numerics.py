"""What the numerics do to the posterior of a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.api.progress import Cancel, OnProgress, Stage
from lacli.base.errors import AnatomyError, UsageError

if TYPE_CHECKING:
    from lacli.calibration.numerics import Effect
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box

FIGURE = "frontier.png"


@dataclass(frozen=True)
class CalibrationTradeoff:
    """What choices of numerics do to the posterior: inputs by name, an effect for each choice (the last is the reference), the
    cheapest whose alphas shift by no more than the tolerance (None: none does), and the pictures drawn.

    Shifts are in standard deviations of the reference's posterior, costs in CPU seconds a run.
    """

    inputs: tuple[str, ...]
    effects: tuple[Effect, ...]
    recommended: Effect | None
    pictures: tuple[Path, ...]


def calibration_tradeoff(
    scene: Scene,
    targets: Targets,
    *,
    meshes: Sequence[Path] = (),
    box: Box | None = None,
    tolerance_sd: float = 0.25,
    store: Path = Path("runs"),
    figures: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> CalibrationTradeoff:
    """What linear and quadratic cells, on the scene's mesh and others, do to the calibration of a patient with its parameters.

    The patient is the reference's simulation: quadratic cells on the last of ``meshes`` (bundles of the same atrium, coarse to
    fine), or on the scene's own. Of ``targets`` names and errors count (in the units of the names), their means do not. box: of
    the inputs (default: the published one). tolerance_sd: shift of an alpha that is acceptable, in posterior standard deviations.
    Each choice takes a run with derivatives and up to four more; one whose most probable point is not found by then has
    ``trouble``. Raises UsageError where the scene is outside the box or tells no derivatives, LacliError where the reference
    fails, AnatomyError, SolverMissingError, StorageError, Cancelled.
    """
    import numpy as np

    from lacli.base.files import check_folder
    from lacli.calibration.numerics import Choice, effects, recommend
    from lacli.calibration.simulator import check_end_systole, simulator
    from lacli.contracts.scene import parameters_of
    from lacli.inference.box import published_box
    from lacli.mechanics.numerics.stated import with_discretisation

    if scene.numerics.unloading != "prestrain" or scene.numerics.engine == "script":
        raise UsageError('tradeoff: derivatives need the compiled engine with numerics.unloading = "prestrain".')
    if scene.numerics.rest_sweeps:
        raise UsageError("tradeoff: springs at rest where the wall relaxes have no derivatives; set numerics.rest_sweeps to 0.")
    check_end_systole(scene, targets)
    check_folder(store)
    box = box or published_box()
    places = [scene.anatomy.bundle, *(Path(mesh).resolve() for mesh in meshes)]
    if missing := [place for place in places if not (place / "wall.vtu").is_file()]:
        raise AnatomyError(f"{missing[0]}: not an anatomy bundle. Mesh the same atrium with another --cell-size-mm.")
    choices = []
    for number, place in enumerate(places):
        for order in (1, 2):
            numerics = scene.numerics.model_copy(update={"order": order})
            chosen = scene.model_copy(
                update={"numerics": numerics, "anatomy": scene.anatomy.model_copy(update={"bundle": place})}
            )
            name = f"{'linear' if order == 1 else 'quadratic'}, {'own mesh' if number == 0 else place.name}"
            run = simulator(chosen, store, 1, targets=targets.names)
            choices.append(Choice(name, run, with_discretisation(targets, chosen)[1].errors, chosen.numerics.order))
    stage = Stage("runs", float(len(choices)), progress, cancel)
    done = iter(range(len(choices)))
    x = np.array(parameters_of(scene, box.names))
    found = effects(choices, targets, box, x, lambda name: stage.of(name, float(next(done)), float(len(choices))))
    pictures: tuple[Path, ...] = ()
    if figures:
        from lacli.report.numerics_figures import frontier_figure

        pictures = (frontier_figure(found, box.names, tolerance_sd, store / FIGURE),)
    return CalibrationTradeoff(box.names, tuple(found), recommend(found[:-1], box.names, tolerance_sd), pictures)
