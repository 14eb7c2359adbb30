"""The cheap companion of a scene, and what a calibration by both is said to cost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from shapes import hollow_cube
from typer.testing import CliRunner

from lacli.base.errors import AnatomyError, SceneError, UsageError
from lacli.calibration.sequential.fidelity.companion import companion
from lacli.cli.main import build
from lacli.contracts.bundle import save
from lacli.contracts.scene import Scene, load_scene
from lacli.mechanics.numerics.cost import unknowns


@pytest.fixture
def place(tmp_path: Path) -> Path:
    save(hollow_cube(), tmp_path / "la")
    save(hollow_cube(), tmp_path / "coarser")
    (tmp_path / "scene.toml").write_text('[anatomy]\nbundle = "la"\n[loads]\nedp_mmhg = 7.0\n')
    (tmp_path / "targets.toml").write_text("[targets.esv_ml]\nmean = 90.0\nsd = 4.0\n")
    return tmp_path


@pytest.fixture
def scene(place: Path) -> Scene:
    return load_scene(place / "scene.toml")


def test_it_differs_in_its_numerics_and_its_cells_alone(place: Path, scene: Scene) -> None:
    made = companion(scene, ["order=1", "numerics.tolerance_mm=1e-4", "anatomy.bundle=coarser"])
    assert (made.numerics.order, made.numerics.tolerance_mm) == (1, 1e-4)
    assert made.anatomy.bundle == place / "coarser"
    same = made.model_copy(update={"numerics": scene.numerics, "anatomy": scene.anatomy})
    assert same == scene


@pytest.mark.parametrize(
    ("overrides", "error", "words"),
    [
        (["loads.edp_mmhg=8"], UsageError, "loads.edp_mmhg changes what is simulated"),
        (["order=2"], UsageError, "the scene is so itself"),
        (["order=3"], SceneError, "numerics.order"),
        (["order"], SceneError, "key.key=value"),
        (["anatomy.bundle=nowhere"], AnatomyError, "not an anatomy bundle"),
        (["unloading=backward"], UsageError, "unloading and the time of end-systole must be the scene's own"),
    ],
)
def test_what_is_no_companion_is_one_message(scene: Scene, overrides: list[str], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        companion(scene, overrides)


def lacli(place: Path, *arguments: object) -> Any:
    given = ["calibrate", place / "scene.toml", "--targets", place / "targets.toml", "--out", place / "out", *arguments]
    return CliRunner().invoke(build({"calibrate"}), list(map(str, given)))


def test_the_price_is_told_without_a_run(place: Path, scene: Scene) -> None:
    plain = json.loads(lacli(place, "--dry-run", "--json").stdout)["simulations"]
    both = json.loads(lacli(place, "--dry-run", "--json", "--cheap", "order=1", "--reference-runs", 8).stdout)["simulations"]
    assert [s["runs"] for s in plain] == [60]
    assert [s["runs"] for s in both] == [8, 60]
    assert both[0]["each"] == plain[0]["each"]
    assert [s["each"]["unknowns"] for s in both] == [unknowns(hollow_cube(), order) for order in (2, 1)]
    assert both[0]["cpu_s"] == pytest.approx(8 * both[0]["each"]["cpu_s"])
    assert not (place / "out").exists()
    shown = lacli(place, "--dry-run", "--cheap", "order=1").stdout
    assert "cheap: order=1" in shown
    assert "CPU minutes" in shown


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--reference-runs", 8], "--reference-runs goes with --cheap"),
        (["--method", "published", "--cheap", "order=1"], "--cheap: of the sequential method"),
        (["--method", "published", "--dry-run"], "--dry-run: of the sequential method"),
        (["--cheap", "esp=1"], "numerics.esp"),
    ],
)
def test_options_that_do_not_go_together_are_refused(place: Path, arguments: list[object], words: str) -> None:
    assert words in str(lacli(place, *arguments).exception)
