"""Mechanics in one call each: simulate, decks run by hand, run again, verify, weigh speed against accuracy, look for FreeFEM."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from lacli.api.progress import Cancel, OnProgress, Stage, check
from lacli.base.errors import AnatomyError

if TYPE_CHECKING:
    from collections.abc import Callable

    from lacli.api.methods.numerics import CalibrationTradeoff
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets
    from lacli.freefem.run import Progress as SolverProgress
    from lacli.inference.box import Box
    from lacli.mechanics.installation import Check as InstallationCheck
    from lacli.mechanics.numerics.tradeoff import Variant
    from lacli.mechanics.simulation import RunResult
    from lacli.verification.problems import Check as VerificationCheck


def simulate(
    scene: Scene, *, store: Path = Path("runs"), progress: OnProgress | None = None, cancel: Cancel | None = None
) -> RunResult:
    """The result of a scene's simulation, run now or found in ``store``, where each run has a folder named by its content.

    Features have their units in their names (mm, mL, s, kPa). A simulation that fails is a result whose ``status`` is
    ``failed``, with its kind and message. cancel is asked at each word of the solver; a cancelled run leaves nothing.
    Raises AnatomyError, SceneError, SolverMissingError, StorageError, Cancelled.
    """
    from lacli.base.files import check_folder
    from lacli.mechanics.simulation import run_scene

    check_folder(store)
    check(cancel, "simulation")
    return run_scene(scene, store, on_progress=_listener(progress, cancel))


def write_deck(scene: Scene, folder: Path) -> Path:
    """The shell script that runs FreeFEM on the scene's deck, which is written to ``folder`` with all that it reads.

    The folder must be absent or empty. Raises StorageError, AnatomyError, SolverMissingError.
    """
    from lacli.mechanics.simulation import write_by_hand

    return write_by_hand(scene, folder)


def read_deck(folder: Path) -> dict[str, Any]:
    """Features (by name, with units) of a deck of ``write_deck`` that has run; tables and fields are written beside it.

    Raises InputError where the folder holds no such deck, UsageError where bundle or solver are others by now,
    SimulationError where FreeFEM's results are missing or incomplete.
    """
    from lacli.mechanics.simulation import read_by_hand

    return read_by_hand(folder)


def rerun(
    folder: Path, *, progress: OnProgress | None = None, cancel: Cancel | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Features of a stored run as stored, and as a second run of the same scene gives them; the stored run stays as it is.

    Units are in the features' names. Raises as ``read_deck`` does, SimulationError where the second run fails, Cancelled.
    """
    from lacli.mechanics.simulation import rerun as run_again

    check(cancel, "simulation")
    return run_again(folder, on_progress=_listener(progress, cancel))


def verify(
    names: Sequence[str] = (), *, progress: OnProgress | None = None, cancel: Cancel | None = None
) -> tuple[VerificationCheck, ...]:
    """What the simulator computes beside what is known, of the named verification problems (default: all).

    Errors are in mm for positions, relative without unit otherwise; a problem that does not end is a failed check.
    Raises UsageError for an unknown name, SolverMissingError, Cancelled.
    """
    from lacli.verification.problems import choose
    from lacli.verification.problems import verify as solve

    chosen = choose(names)
    stage = Stage("verify", len(chosen), progress, cancel)
    checks: list[VerificationCheck] = []
    for number, name in enumerate(chosen):
        stage.name = f"verify {name}"
        stage.reach(number)
        checks += solve(name)
    stage.reach(len(chosen))
    return tuple(checks)


@dataclass(frozen=True)
class Tradeoff:
    """Simulations of one scene with several numerics, the most careful of them, and what is recommended.

    errors: by variant (its place in ``variants``), absolute differences from the reference in the features' units;
    recommended: the cheapest numerics within the tolerance, None where there is none.
    """

    variants: tuple[Variant, ...]
    reference: Variant
    errors: tuple[dict[str, float], ...]
    recommended: str | None


@overload
def tradeoff(
    scene: Scene,
    targets: None = ...,
    *,
    finer: Path | None = ...,
    tolerance_mm: float = ...,
    store: Path = ...,
    record: bool = ...,
    progress: OnProgress | None = ...,
    cancel: Cancel | None = ...,
) -> Tradeoff: ...


@overload
def tradeoff(
    scene: Scene,
    targets: Targets,
    *,
    finer: Path | None = ...,
    box: Box | None = ...,
    tolerance_sd: float = ...,
    store: Path = ...,
    figures: bool = ...,
    progress: OnProgress | None = ...,
    cancel: Cancel | None = ...,
) -> CalibrationTradeoff: ...


def tradeoff(
    scene: Scene,
    targets: Targets | None = None,
    *,
    finer: Path | None = None,
    box: Box | None = None,
    tolerance_mm: float = 0.22,
    tolerance_sd: float = 0.25,
    store: Path = Path("runs"),
    record: bool = True,
    figures: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Tradeoff | CalibrationTradeoff:
    """Speed against accuracy of linear and quadratic cells and two quadratures, against the most careful of them.

    Errors are in the features' units, costs in CPU seconds and MB. finer: a bundle of the same atrium with smaller cells,
    the reference then; tolerance_mm: the largest error of a displacement; record: keep the errors in the scene's bundle, so
    that later results carry them (without a finer bundle those of linear cells alone: in the others the cells' size is not).

    targets: of a calibration, and what the numerics do to its posterior is told instead. The patient is the reference's
    simulation at the scene's parameters; names and errors of the targets count (in the units of the names), their means do
    not. box: of the inputs (default: the published one); tolerance_sd: shift of an alpha that is acceptable, in standard
    deviations of the posterior; figures: whether it is drawn, into ``store``. Each choice takes a run with derivatives and up
    to four more.

    Raises AnatomyError, InputError where no choice ends, UsageError where the scene is outside the box or tells no
    derivatives, LacliError where the reference fails, SolverMissingError, StorageError, Cancelled (simulations that ended are
    kept).
    """
    if targets is not None:
        from lacli.api.methods.numerics import calibration_tradeoff

        return calibration_tradeoff(
            scene, targets, meshes=() if finer is None else (finer,), box=box, tolerance_sd=tolerance_sd, store=store,
            figures=figures, progress=progress, cancel=cancel,
        )  # fmt: skip
    from lacli.mechanics.numerics import tradeoff as measure

    if finer is not None and not (finer / "wall.vtu").is_file():
        raise AnatomyError(f"{finer}: not an anatomy bundle. Mesh the same atrium with a smaller --cell-size-mm.")
    heard = _listener(progress, cancel)
    variants = tuple(measure.run_variants(scene, finer.resolve() if finer else None, store, on_progress=heard))
    best = measure.reference(variants)
    errors = tuple(measure.errors(v, best) if v.status == "done" else {} for v in variants)
    own = [(v, error) for v, error in zip(variants, errors, strict=True) if v.mesh == "own"]
    choice = measure.recommend(
        {v.numerics: error for v, error in own if v.status == "done"}, {v.numerics: v.cpu_s for v, _ in own}, tolerance_mm
    )
    if record:
        measure.keep(variants, best)
    return Tradeoff(variants, best, errors, choice)


def doctor(*, progress: OnProgress | None = None, cancel: Cancel | None = None) -> tuple[InstallationCheck, ...]:
    """What simulations need of this machine (FreeFEM, plugins, BLAS, a compiler, gmsh): found or missing, and what installs it.

    A check that is ``needed`` and not ``ok`` keeps simulations from running. It has no units. Raises Cancelled.
    """
    from lacli.mechanics.installation import inspect

    Stage("looking around", 1, progress, cancel).begin()
    return tuple(inspect())


def _listener(progress: OnProgress | None, cancel: Cancel | None) -> Callable[[SolverProgress], None]:
    """The solver's words as progress of the phases they name; each phase is a stage of total 1."""
    stages: dict[str, Stage] = {}

    def hear(event: SolverProgress) -> None:
        if event.phase not in stages:
            stages[event.phase] = Stage(event.phase, 1.0, progress, cancel)
        stages[event.phase].reach(event.load if math.isfinite(event.load) else 0.0, event)

    return hear
