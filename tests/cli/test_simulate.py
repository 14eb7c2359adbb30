"""``lacli simulate`` at the terminal, with a stand-in for the simulator."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from shapes import hollow_cube
from typer.testing import CliRunner

from lacli.base.files import write_json
from lacli.cli.main import build
from lacli.cli.terminal.live import describe
from lacli.contracts.bundle import load, save
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene, dump_scene, load_scene
from lacli.freefem.run import Progress
from lacli.mechanics.numerics import cost
from lacli.mechanics.store import open_run


@dataclass(frozen=True)
class Result:
    key: str
    folder: Path
    status: str
    kind: str | None
    message: str
    features: dict[str, Any]
    manifest: dict[str, Any]


def run_scene(scene: Scene, root: Path, on_progress: Callable[[Any], None] | None = None) -> Result:
    """Fails above 30 mmHg."""
    with open_run(root, run_key(scene)) as run:
        if run.stored is None:
            assert on_progress is not None
            on_progress(Progress(phase="unload", load=0.5))
            if scene.loads.esp_mmhg > 30:
                run.finish("failed", kind="load_step_underflow", message="no step at load 0.7")
            else:
                features = {
                    "edv_ml": 80.25,
                    "d_global_mm": 3.5,
                    "unknowns": 192,
                    "cpu_s": 2.0,
                    "peak_memory_mb": 100.0,
                    "newton_iterations": 14,
                }
                write_json(
                    run.folder / "features.json",
                    features | {"discretisation_error": {"edv_ml": 0.1}, "discretisation_error_source": {"edv_ml": "model"}},
                )
                (run.folder / "scene.toml").write_text(dump_scene(scene))
                run.finish()
    stored = run.stored
    assert stored is not None
    return Result(stored.key, stored.folder, stored.status, stored.kind, stored.message, stored.features(), stored.manifest)


@pytest.fixture
def scene_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    simulation, plan = ModuleType("lacli.mechanics.simulation"), ModuleType("lacli.mechanics.plan")
    simulation.run_scene = run_scene  # type: ignore[attr-defined]
    plan.describe = lambda scene, bundle: [  # type: ignore[attr-defined]
        ("unloading", True, "loads.edp_mmhg is 8"),
        ("pericardium", False, "k_peri is 0"),
    ]
    monkeypatch.setitem(sys.modules, "lacli.mechanics.simulation", simulation)
    monkeypatch.setitem(sys.modules, "lacli.mechanics.plan", plan)
    save(hollow_cube(), tmp_path / "la")
    file = tmp_path / "scene.toml"
    file.write_text('[anatomy]\nbundle = "la"\n')
    return file


def lacli(*arguments: object) -> Any:
    return CliRunner().invoke(build({"simulate"}), ["simulate", *map(str, arguments)])


def test_features_errors_and_folder_are_shown(scene_file: Path, tmp_path: Path) -> None:
    shown = lacli(scene_file, "--out", tmp_path / "runs", "--no-figures")
    assert shown.exit_code == 0
    line = next(line for line in shown.stdout.splitlines() if "edv" in line)
    assert [cell.strip() for cell in line.strip("│┃ ").split("│")] == ["edv", "80.25", "mL", "0.1 (model)"]
    assert f"Everything is in {tmp_path / 'runs'}" in shown.stdout
    assert "unload" in shown.stderr
    again = lacli(scene_file, "--out", tmp_path / "runs", "--no-figures")
    assert "Run before, results kept" in again.stdout


def test_json_is_one_document(scene_file: Path, tmp_path: Path) -> None:
    shown = lacli(scene_file, "--out", tmp_path / "runs", "--json", "--set", "loads.esp_mmhg=18")
    document = json.loads(shown.stdout)
    assert document["status"] == "done"
    assert document["features"]["edv_ml"] == 80.25
    assert document["features"]["discretisation_error"] == {"edv_ml": 0.1}
    assert not document["repeated"]
    assert Path(document["folder"]).parent == tmp_path / "runs"


def test_failure_is_exit_code_1_with_kind_and_folder(scene_file: Path, tmp_path: Path) -> None:
    shown = lacli(scene_file, "--out", tmp_path / "runs", "--set", "loads.esp_mmhg=37")
    assert shown.exit_code == 1
    assert "(load_step_underflow): no step at load 0.7" in shown.stderr
    assert str(tmp_path / "runs") in shown.stderr.replace("\n", "")
    assert shown.stdout == ""


def test_dry_run_says_what_and_why_and_runs_nothing(scene_file: Path, tmp_path: Path) -> None:
    shown = lacli(scene_file, "--out", tmp_path / "runs", "--dry-run")
    assert shown.exit_code == 0
    assert "loads.edp_mmhg is 8" in shown.stdout
    assert "k_peri is 0" in shown.stdout
    assert not (tmp_path / "runs").exists()
    lacli(scene_file, "--out", tmp_path / "runs", "--no-figures")
    document = json.loads(lacli(scene_file, "--out", tmp_path / "runs", "--dry-run", "--json").stdout)
    assert document["already"] == "done"
    assert document["terms"][1] == {"term": "pericardium", "included": False, "why": "k_peri is 0"}
    # that run took 2 s with 192 unknowns; this mesh has 64 corners and, see below, its edges
    expected = document["expected"]
    scene = load_scene(scene_file)
    # 14 systems there; one run at the very place counts .37^2 / (.37^2 + .18^2) = .8086 against what is foretold without
    solved = cost.systems(scene, cost.slenderness(load(scene.anatomy.bundle))) ** 0.1914 * 14**0.8086
    larger = cost.price(scene, expected["unknowns"], solved) / cost.price(scene, 192, 14)
    assert expected["runs"] == 1 and expected["cpu_s"] == pytest.approx(2.0 * larger, rel=1e-4)
    assert expected["low_s"] < expected["cpu_s"] < expected["high_s"]


def test_wrong_key_is_one_message(scene_file: Path) -> None:
    shown = lacli(scene_file, "--set", "loads.edp=3")
    assert "loads.edp: unknown key" in str(shown.exception)


def test_unknowns_are_counted() -> None:
    bundle = hollow_cube()
    edges = {tuple(sorted((a, b))) for tet in bundle.tets.tolist() for a in tet for b in tet if a != b}
    # three displacements a node, a pressure a corner
    assert cost.unknowns(bundle, 1) == 4 * 64
    assert cost.unknowns(bundle, 2) == 3 * (64 + len(edges)) + 64


def test_live_line() -> None:
    event = Progress(phase="unload", load=0.25, newton=3, residual=1.2e-4, minj=0.8)
    # a quarter in 10 s leaves 30 s
    assert describe(event, 12, 10) == (
        "unload  load 25 %  Newton 3  residual 1.2e-04  min J 0.80  12 s  about 30 s left in this phase"
    )
    assert describe(Progress(phase="mesh"), 1, 1) == "mesh  1 s"


def test_pictures_are_those_of_the_results_they_stand_beside(
    scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drawn once for a run; again where results or pictures are no longer those of the drawing."""
    drawn: list[Path] = []

    def draw_apart(folder: Path) -> tuple[list[Path], str]:
        drawn.append(folder)
        for name in ("transients.png", "shapes.png"):
            (folder / name).write_bytes(b"picture")
        return [folder / "transients.png", folder / "shapes.png"], ""

    monkeypatch.setattr("lacli.report.simulation_figures.draw_apart", draw_apart)
    for times in (1, 1):
        assert len(json.loads(lacli(scene_file, "--out", tmp_path / "runs", "--json").stdout)["pictures"]) == 2
        assert len(drawn) == times
    (drawn[0] / "shapes.png").write_bytes(b"another run's")
    lacli(scene_file, "--out", tmp_path / "runs")
    assert len(drawn) == 2 and (drawn[0] / "shapes.png").read_bytes() == b"picture"
    features = drawn[0] / "features.json"
    features.write_text(features.read_text().replace("80.25", "99.25"))
    again = json.loads(lacli(scene_file, "--out", tmp_path / "runs", "--json").stdout)
    assert again["features"]["edv_ml"] == 80.25 and not again["repeated"], "made again"
    assert len(drawn) == 3
