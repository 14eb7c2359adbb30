"""Renders FreeFEM scripts: that of a scene, and others from their templates."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from lacli.base import resources
from lacli.contracts.scene import Scene
from lacli.mechanics.plan import Plan, describe

__all__ = ["describe", "render", "render_template"]


def _number(value: object) -> object:
    """Numbers reach a deck in full precision and finite, names only from our own tables."""
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError("a number of the deck is not finite")
        return repr(float(value))
    return value


def render_template(template: str, plugin: Path | None, **choices: Any) -> str:
    """A script as text; ``plugin`` is the compiled engine, without or with its ending .so (None: the engine in FreeFEM's own
    language), ``choices`` what the template names."""
    name = str(plugin.with_suffix("")) if plugin else ""
    if not re.fullmatch(r"[A-Za-z0-9_./+ -]*", name):
        raise ValueError(f"the plugin's path has characters that a FreeFEM string cannot hold: {name}")
    environment = Environment(
        loader=FileSystemLoader(resources.folder("templates")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=_number,
        autoescape=False,
    )
    return environment.get_template(template).render(plugin=name, **choices)


def render(scene: Scene, plan: Plan, plugin: Path | None) -> str:
    """The script of one scene as text."""
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
        volume_tolerance=numerics.unloading_volume_tolerance,
        max_sweeps=numerics.unloading_max_sweeps,
        vein_spring=scene.loads.vein_spring_kpa_per_mm,
        pericardium=scene.pericardium.k_peri_kpa_per_mm,
    )
