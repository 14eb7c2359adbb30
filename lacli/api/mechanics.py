"""Mechanics in one call each: simulate a scene, write a deck to be run by hand and read it, run a stored run again."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.api.progress import Cancel, OnProgress, Stage, check

if TYPE_CHECKING:
    from collections.abc import Callable

    from lacli.contracts.scene import Scene
    from lacli.freefem.run import Progress as SolverProgress
    from lacli.mechanics.simulation import RunResult


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


def _listener(progress: OnProgress | None, cancel: Cancel | None) -> Callable[[SolverProgress], None]:
    """The solver's words as progress of the phases they name; each phase is a stage of total 1."""
    stages: dict[str, Stage] = {}

    def hear(event: SolverProgress) -> None:
        if event.phase not in stages:
            stages[event.phase] = Stage(event.phase, 1.0, progress, cancel)
        stages[event.phase].reach(event.load if math.isfinite(event.load) else 0.0, event)

    return hear
