"""How far a scene is handed on in one simulation: few places have it whole, and none hands it to a room above its own.

Counted while a simulation runs: the functions of the package that get a ``Scene`` as an argument (its own methods apart), their
modules, and calls among them from a room to one above it, by the order of rooms in pyproject.toml.
"""

import sys
import tomllib
from pathlib import Path
from types import FrameType
from typing import Any

from shapes import cut_ball

import lacli
from lacli.anatomy.wall.shell import mesh_shell
from lacli.contracts import bundle as bundles
from lacli.contracts.scene import Scene, build_scene

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = Path(lacli.__file__).parent
MOST_MODULES, MOST_PLACES = 8, 16


def module_of(frame: FrameType) -> str | None:
    file = Path(frame.f_code.co_filename)
    return ".".join(file.relative_to(PACKAGE).with_suffix("").parts) if file.is_relative_to(PACKAGE) else None


def levels() -> dict[str, int]:
    """Room -> its level, the lowest 0."""
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (contract,) = [c for c in document["tool"]["importlinter"]["contracts"] if c["type"] == "layers"]
    return {
        room.strip().removeprefix("lacli."): level
        for level, layer in enumerate(reversed(contract["layers"]))
        for room in layer.split("|")
    }


def test_a_scene_passes_few_places_and_goes_down_only(tmp_path: Path) -> None:
    bundles.save(mesh_shell(cut_ball(), 2.0, 9.0, order=1), tmp_path / "bundle")
    settings = ["motion.annulus=none", "loads.vein_spring_kpa_per_um=0", "pericardium.k_peri_kpa_per_um=0", "numerics.order=1"]
    settings += ["materials.law=neo_hookean", "materials.c_kpa=20", "loads.edp_mmhg=1", "loads.esp_mmhg=3", "outputs.fields=none"]
    scene = build_scene({"anatomy": {"bundle": "bundle"}}, settings, folder=tmp_path, where="test")
    places: set[tuple[str, str]] = set()
    up: set[tuple[str, str]] = set()
    level = levels()

    def watch(frame: FrameType, event: str, _: Any) -> None:
        module = module_of(frame) if event == "call" else None
        code = frame.f_code
        if module is None or code.co_name.startswith("<"):
            return
        given = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        if given[:1] == ("self",) or not any(isinstance(frame.f_locals.get(name), Scene) for name in given):
            return
        places.add((module, code.co_name))
        caller = frame.f_back
        while caller is not None and module_of(caller) is None:
            caller = caller.f_back
        above = module_of(caller) if caller is not None else None
        if above is not None and level[above.split(".")[0]] < level[module.split(".")[0]]:
            up.add((above, module))

    before = sys.getprofile()
    sys.setprofile(watch)
    try:
        result = lacli.simulate(scene, store=tmp_path / "runs")
    finally:
        sys.setprofile(before)
    assert result.status == "done", result.message
    modules = {module for module, _ in places}
    assert {"api.mechanics", "mechanics.simulation", "mechanics.plan", "mechanics.deck"} <= modules, "the watch sees its way"
    assert len(modules) <= MOST_MODULES, sorted(modules)
    assert len(places) <= MOST_PLACES, sorted(places)
    assert not up
