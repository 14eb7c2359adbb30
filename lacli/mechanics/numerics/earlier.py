"""The finished runs of a folder, for what they cost."""

from __future__ import annotations

from pathlib import Path

from lacli.base.errors import LacliError
from lacli.contracts import bundle as bundles
from lacli.contracts.scene import load_scene
from lacli.mechanics.numerics.cost import Earlier, slenderness
from lacli.mechanics.store import list_runs

_PRICED = 100  # finished runs that are looked at for what a run costs


def earlier(root: Path) -> list[Earlier]:
    """The latest finished runs of a folder."""
    done = [run for run in list_runs(root) if run.status == "done"]
    found, walls = [], {}
    for run in sorted(done, key=lambda run: str(run.manifest.get("finished")))[-_PRICED:]:
        try:
            begun = run.manifest.get("start")
            warm = isinstance(begun, dict) and begun.get("way") == "warm"
            scene = load_scene(run.folder / "scene.toml")
            if (place := scene.anatomy.bundle) not in walls:
                walls[place] = _slenderness(place)
            found.append(Earlier(scene, run.features(), walls[place], warm, str(run.manifest.get("engine") or "")))
        except LacliError:
            continue  # of an earlier version, or damaged: no price is worth a failure
    return found


def _slenderness(place: Path) -> dict[str, float] | None:
    try:
        return slenderness(bundles.load(place))
    except LacliError:
        return None  # the anatomy has gone since
