"""The deck of a case: FreeFEM's script for exactly what the plan holds, the files it reads, and its run.

Written, run and read are three verbs (``write`` and ``run`` here, ``read`` in ``results``): what was written can be run by hand.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lacli.base import resources
from lacli.base.files import write_text
from lacli.contracts.case import Case, Plan
from lacli.contracts.laws import LAWS
from lacli.contracts.scene import Scene, dump_scene
from lacli.freefem import blas, memory
from lacli.freefem import run as freefem
from lacli.freefem.program import find
from lacli.freefem.template import render_template
from lacli.mechanics import engine, warm
from lacli.mechanics.inputs import write_inputs

SCRIPT = "deck.edp"
SCENE = "scene.toml"
OnProgress = Callable[[freefem.Progress], None]


@dataclass(frozen=True)
class Deck:
    """A written deck: its folder, the engine that its script names (``plugin`` or ``script``), and how long it may run."""

    folder: Path
    engine: str
    timeout_s: float

    @property
    def script(self) -> Path:
        """FreeFEM's script."""
        return self.folder / SCRIPT


def write(case: Case, folder: Path, start: warm.Start | None = None) -> Deck:
    """Write the scene, the script and all that this reads into ``folder``, which must be there.

    start: where the run may start from; with one, however empty, it leaves where others may (``lacli.mechanics.warm``).
    Raises SolverMissingError, StorageError.
    """
    write_text(folder / SCENE, dump_scene(case.scene))
    plugin = engine.choose(case.scene.numerics.engine, LAWS[case.scene.materials.law])
    write_inputs(case, folder)
    starts = None
    if start is not None and plugin is not None and case.plan.sensitivities:
        warm.write(start, folder)
        starts = tuple(start.states)
    write_text(folder / SCRIPT, render(case.scene, case.plan, plugin, starts))
    return Deck(folder, engine.name(plugin), case.scene.numerics.timeout_s)


def run(deck: Deck, on_progress: OnProgress | None = None) -> freefem.Outcome:
    """Run a written deck; its results stay in its folder. Raises SolverMissingError."""

    def listen(line: str) -> None:
        progress = freefem.parse_progress(line)
        if progress is not None and on_progress is not None:
            on_progress(progress)

    return freefem.run(find(), deck.script, deck.folder, deck.timeout_s, listen, includes=(libraries(),))


def shell_script() -> str:
    """A script that runs FreeFEM on the deck beside it, as ``run`` does, for a terminal or a batch system."""
    found = find()
    wanted = {
        name: value
        for name, value in found.environment(includes=(libraries(),)).items()
        if name.startswith("FF_") or name.endswith("_NUM_THREADS") or name in ("LC_ALL", *memory.KEPT)
    }
    exports = "".join(f"export {name}={shlex.quote(value)}\n" for name, value in sorted(wanted.items()))
    program = shlex.quote(str(found.binary))
    return f'#!/bin/sh\nset -e\ncd "$(dirname "$0")"\n{exports}{blas.shell_lines()}exec {program} -nw -ne -v 0 {SCRIPT}\n'


def libraries() -> Path:
    """The folder of the .idp files that scripts include."""
    return resources.folder("solvers") / "freefem"


def render(scene: Scene, plan: Plan, plugin: Path | None, starts: tuple[str, ...] | None = None) -> str:
    """The script of one scene as text; ``plugin`` as ``render_template`` takes it; starts: states that have a start from another
    run (None: none, nor is what others could start from kept)."""
    numerics = scene.numerics
    return render_template(
        "simulation.edp.j2",
        plugin,
        plan=plan,
        phases=plan.phases,
        order=numerics.order,
        points=numerics.quadrature,
        tolerance=numerics.tolerance_mm,
        max_newton=numerics.max_newton,
        settle_ed=numerics.settle_ed,
        sensitivities=plan.sensitivities and plugin is not None,
        starts=starts,
        volume_tolerance=numerics.unloading_volume_tolerance,
        max_sweeps=numerics.unloading_max_sweeps,
        vein_spring=scene.loads.vein_spring_kpa_per_mm,
        pericardium=scene.pericardium.k_peri_kpa_per_mm,
    )
