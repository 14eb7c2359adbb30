"""A scene as every command reads it: what is possible in it but unusual is said on standard error."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lacli.cli.terminal.console import err
from lacli.contracts.scene import Scene, load_scene, notes

if TYPE_CHECKING:
    from lacli.inference.box import Box


def read_scene(file: Path, overrides: list[str] | None = None, box: Box | None = None) -> Scene:
    """The scene, after notes on its values, and on the ranges of ``box`` if there is one. Raises SceneError."""
    scene = load_scene(file, overrides)
    found = notes(scene)
    if box is not None:
        from lacli.inference import box as boxes

        found += boxes.notes(box)
    for note in found:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    return scene
