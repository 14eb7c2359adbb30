"""What a calibration costs before any run: by kind of run, corrected by the finished runs of a folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from shapes import hollow_cube

import lacli
import lacli.types
from lacli.base.errors import UsageError
from lacli.calibration import annulus
from lacli.calibration.price import price
from lacli.calibration.simulator import simulator
from lacli.cli.inference.sought import time_of
from lacli.contracts.bundle import save
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene, build_scene, dump_scene
from lacli.mechanics.numerics.accuracy import record
from lacli.mechanics.numerics.cost import expected
from lacli.mechanics.numerics.earlier import earlier
from lacli.mechanics.store import open_run


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    save(hollow_cube(), tmp_path / "la")
    return build_scene({"anatomy": {"bundle": "la"}}, [], folder=tmp_path, where="test")


def keep(scene: Scene, store: Path, cpu_s: float, way: str = "cold") -> None:
    """A finished run of the scene, which took so long."""
    with open_run(store, run_key(scene)) as run:
        (run.folder / "scene.toml").write_text(dump_scene(scene), encoding="utf-8")
        features = {"unknowns": 256, "cpu_s": cpu_s, "peak_memory_mb": 50.0, "newton_iterations": 12}
        (run.folder / "features.json").write_text(json.dumps(features), encoding="utf-8")
        run.finish(products=["scene.toml", "features.json"], start={"way": way})


def test_runs_times_what_one_takes_and_finished_runs_correct_it(scene: Scene, tmp_path: Path) -> None:
    bundle = hollow_cube()
    plain = price("own", scene, 60, earlier(tmp_path / "runs"))
    assert plain.cpu_s == 60 * expected(scene, bundle, []).cpu_s and plain.each.runs == 0
    keep(scene, tmp_path / "runs", 3.0 * plain.each.cpu_s)
    assert [found.scene for found in earlier(tmp_path / "runs")] == [scene]
    corrected = price("own", scene, 10, earlier(tmp_path / "runs"))
    assert corrected.each.runs == 1 and corrected.cpu_s > 1.5 * 10 * plain.each.cpu_s


@pytest.mark.parametrize("way", ["cold", "warm"])
def test_runs_that_began_warm_are_known(scene: Scene, tmp_path: Path, way: str) -> None:
    keep(scene, tmp_path / "runs", 3.0, way)
    assert [found.warm for found in earlier(tmp_path / "runs")] == [way == "warm"]


def test_a_calibration_s_price_is_told_by_kind_of_run_and_nothing_is_run(scene: Scene, tmp_path: Path) -> None:
    targets = lacli.Targets(("esv_ml",), [90.0], [4.0])  # type: ignore[arg-type]
    settings = lacli.types.SequentialSettings(max_runs=40, reference_runs=9)
    (own,) = lacli.calibrate(scene, targets, tmp_path / "c", settings=settings, cheap=(), dry_run=True)
    assert (own.name, own.runs) == ("the scene's own", 40)
    own, cheap = lacli.calibrate(scene, targets, tmp_path / "c", settings=settings, dry_run=True)
    assert (own.runs, cheap.runs, cheap.name) == (9, 40, "cheap: order=1")
    assert cheap.each.cpu_s < own.each.cpu_s
    assert not (tmp_path / "c").exists()


def test_runs_that_tell_the_error_of_a_tracked_annulus_have_a_price(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(annulus, "known_share", lambda scene: 0.1)
    targets = lacli.Targets(("esv_ml",), [90.0], [4.0])  # type: ignore[arg-type]
    own, cheap, tracked = lacli.calibrate(scene, targets, tmp_path / "c", dry_run=True)
    assert (tracked.name, tracked.runs) == ("the annulus's error", 7), "as tracked, and six ways of being wrong"
    assert 0.0 < tracked.each.cpu_s < cheap.each.cpu_s < own.each.cpu_s, "cheap ones, which tell no derivatives"


@pytest.mark.parametrize(("seconds", "words"), [(0.4, "0 min 00 s"), (75.0, "1 min 15 s"), (7384.0, "2 h 03 min")])
def test_a_time_is_in_words(seconds: float, words: str) -> None:
    assert time_of(seconds) == words


def test_errors_that_are_not_asked_for_are_in_no_run(scene: Scene, tmp_path: Path) -> None:
    """Where the truth has the same numerics, or the user says no, what `tradeoff` measured is no error of a run."""
    record(scene, {"esv_ml": 0.5}, scene)
    asked, not_asked = (simulator(scene, tmp_path / "runs", discretisation=told) for told in (True, False))
    assert asked.determined_by(())["discretisation_error"] == {"esv_ml": 0.5}
    assert not_asked.determined_by(())["discretisation_error"] == {}


def test_a_scene_with_its_own_transient_has_no_pressure_as_input(scene: Scene, tmp_path: Path) -> None:
    """It would count nothing, and its posterior would be its prior."""
    document = scene.model_dump(mode="json", exclude_none=True)
    transient = ["loads.transient_mmhg=[[0, 8], [0.4, 30], [1, 8]]"]
    own = simulator(build_scene(document, transient, folder=tmp_path, where="test"), tmp_path / "runs")
    assert "loads.esp_mmhg" in own.determined_by(("alpha_roof",))
    with pytest.raises(UsageError, match=r"esp_mmhg can be no input: loads\.transient_mmhg is the pressure at all times"):
        own.determined_by(("alpha_roof", "esp_mmhg"))
