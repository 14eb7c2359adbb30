"""The cheap companion of a scene, and what a calibration by both is said to cost."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from shapes import hollow_cube
from typer.testing import CliRunner

from lacli.base.errors import AnatomyError, SceneError, UsageError
from lacli.calibration.sequential.fidelity.companion import companion, usual
from lacli.cli.inference.sought import carriers
from lacli.cli.main import build
from lacli.contracts.bundle import save
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene, load_scene
from lacli.mechanics.numerics.cost import unknowns
from lacli.mechanics.sensitivities import FILE
from lacli.mechanics.simulation import RunResult


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


def test_linear_cells_carry_a_scene_of_quadratic_ones_unless_it_is_said_otherwise(scene: Scene) -> None:
    linear = companion(scene, ["order=1"])
    assert (scene.numerics.order, linear.numerics.order) == (2, 1)
    assert usual(scene) == carriers(scene, None) == ("order=1",)
    assert usual(linear) == carriers(linear, None) == ()
    assert carriers(scene, ["none"]) == ()
    assert carriers(scene, ["order=1", "kappa_kpa=100"]) == ("order=1", "kappa_kpa=100")
    with pytest.raises(UsageError, match="none goes alone"):
        carriers(scene, ["order=1", "none"])


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
    plain = json.loads(lacli(place, "--dry-run", "--json", "--cheap", "none").stdout)["simulations"]
    both = json.loads(lacli(place, "--dry-run", "--json", "--cheap", "order=1", "--reference-runs", 8).stdout)["simulations"]
    assert [s["runs"] for s in plain] == [60]
    assert [s["runs"] for s in both] == [8, 60]
    assert both[0]["each"] == plain[0]["each"]
    assert [s["each"]["unknowns"] for s in both] == [unknowns(hollow_cube(), order) for order in (2, 1)]
    assert both[0]["cpu_s"] == pytest.approx(8 * both[0]["each"]["cpu_s"])
    assert not (place / "out").exists()
    shown = lacli(place, "--dry-run").stdout  # the scene's cells are quadratic
    assert "cheap: order=1" in shown
    assert "CPU minutes" in shown


def test_a_prior_that_the_runs_would_refuse_is_refused_without_one(place: Path) -> None:
    (place / "targets.toml").write_text("[targets.esv_ml]\nmean = 90.0\nsd = 4.0\n[priors.edp_mmhgg]\nmean = 7.0\nsd = 1.0\n")
    assert "prior of edp_mmhgg: no input of the box" in str(lacli(place, "--dry-run").exception)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--reference-runs", 8, "--cheap", "none"], "--reference-runs: how many runs correct cheap ones, and none"),
        (["--reference-runs", 8, "--set", "numerics.order=1"], "and none are made here"),
        (["--method", "published", "--cheap", "order=1"], "--cheap: of the sequential method"),
        (["--method", "published", "--dry-run"], "--dry-run: of the sequential method"),
        (["--cheap", "esp=1"], "numerics.esp"),
    ],
)
def test_options_that_do_not_go_together_are_refused(place: Path, arguments: list[object], words: str) -> None:
    assert words in str(lacli(place, *arguments).exception)


class Mechanics:
    """In place of FreeFEM: displacements that follow from stiffness and load, and linear cells that are too stiff."""

    def __init__(self) -> None:
        self.orders: list[int] = []

    def __call__(self, scenes: Sequence[Scene], root: Path, **_: object) -> Iterator[tuple[int, RunResult]]:
        for index, scene in enumerate(scenes):
            order, key = scene.numerics.order, run_key(scene)
            self.orders.append(order)
            a, p, off = scene.materials.alpha.roof, scene.loads.edp_mmhg, 0.9 if order == 1 else 0.0
            features = {
                "d_roof_mm": 2.0 + 3.0 / a**0.5 - off, "d_global_mm": 1.0 + 0.2 * p + 2.0 / (1.0 + a) - 0.5 * off,
                "esv_ml": 80.0 + 4.0 * p - 3.0 * a**0.5 - 0.1 * p * off, "cpu_s": 12.0 if order == 2 else 1.0,
            }  # fmt: skip
            slopes = pd.DataFrame(
                {
                    "alpha_roof": [-1.5 / a**1.5, -2.0 / (1.0 + a) ** 2, -1.5 / a**0.5],
                    "edp_mmhg": [0.0, 0.2, 4.0 - 0.1 * off],
                },
                index=pd.Index(["d_roof_mm", "d_global_mm", "esv_ml"], name="feature"),
            )
            folder = root / key
            folder.mkdir(parents=True, exist_ok=True)
            slopes.to_csv(folder / FILE)
            yield index, RunResult(key, folder, "done", None, "", features, {})


def test_a_patient_is_calibrated_by_cheap_runs_and_few_of_its_own(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in = Mechanics()
    monkeypatch.setattr("lacli.mechanics.execute.run_scenes", stand_in)
    a, p = 1.3, 6.0
    own = {"d_roof_mm": (2.0 + 3.0 / a**0.5, 0.1), "d_global_mm": (1.0 + 0.2 * p + 2.0 / (1.0 + a), 0.1),
           "esv_ml": (80.0 + 4.0 * p - 3.0 * a**0.5, 1.0)}  # fmt: skip
    text = "\n".join(f"[targets.{name}]\nmean = {mean}\nsd = {sd}" for name, (mean, sd) in own.items())
    (place / "targets.toml").write_text(text)
    (place / "box.toml").write_text("[box]\nalpha_roof = [0.125, 4.0]\nedp_mmhg = [1.0, 12.0]\n")
    options = ["--box", place / "box.toml", "--ess", 100, "--no-figures", "--no-discretisation-error", "--json"]
    shown = lacli(place, *options, "--cheap", "order=1")
    found = json.loads(shown.stdout)
    low, high = (np.array([row[end] for row in found["posterior"]]) for end in ("low95", "high95"))
    assert ((low < [a, p]) & ([a, p] < high)).all()
    assert found["chi2"] < 0.5
    assert found["fidelity"]["runs"] == stand_in.orders.count(2) < 8
    assert found["runs"] == len(stand_in.orders)
    assert found["fidelity"]["added_sd"]["d_roof_mm"] == pytest.approx(9.0)
    # each fidelity has its log and its identity
    logs = {name: pd.read_csv(place / "out" / name) for name in ("runs.csv", "runs_cheap.csv")}
    assert {name: set(log["cpu_s"]) for name, log in logs.items()} == {"runs.csv": {12.0}, "runs_cheap.csv": {1.0}}
    made = [json.loads((place / "out" / f"{name}.identity.json").read_text()) for name in logs]
    assert [one["content"]["numerics.order"] for one in made] == [2, 1]
    # called again it finds all; another companion is another calibration
    stand_in.orders.clear()
    assert lacli(place, *options, "--cheap", "order=1").exit_code == 0
    assert stand_in.orders == []
    assert "Choose another --out" in str(lacli(place, *options, "--cheap", "anatomy.bundle=coarser").exception)
