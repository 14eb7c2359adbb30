"""Warm starts: the cold run's features in fewer steps; what is refused goes the long way; who is near whom."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import cut_ball

from lacli.anatomy.wall.shell import mesh_shell
from lacli.calibration.simulator import simulator
from lacli.contracts import bundle as bundles
from lacli.contracts.scene import Scene, build_scene, with_parameters
from lacli.freefem.program import FreeFem
from lacli.mechanics import plan, warm
from lacli.mechanics.results import Results
from lacli.mechanics.sensitivities import INPUTS
from lacli.mechanics.simulation import RunResult, run_scene

POINT = {
    **{f"alpha_{name}": value for name, value in zip(("anterior", "roof"), (1.5, 1.4), strict=True)},
    **{"edp_mmhg": 3.0, "esp_mmhg": 14.0},
}
NAMES = list(INPUTS)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A ball of 20 mm radius cut at z = 14 mm, wall 2 mm, one region, held ring, with a frame on the way."""
    target = tmp_path_factory.mktemp("ball")
    bundle = mesh_shell(cut_ball(), 2.0, 9.0, order=2)
    fibre = np.cross([0.3, 0.2, 1.0], bundle.points[bundle.tets[:, :4]].mean(axis=1))
    bundles.save(replace(bundle, fibre=fibre / np.linalg.norm(fibre, axis=1, keepdims=True)), target / "bundle")
    settings = [
        *("motion.annulus=axial", "motion.amplitude_mm=3", "numerics.order=1", "numerics.tolerance_mm=1e-7"),
        *("outputs.fields=none", "outputs.unloaded=false", "outputs.sensitivities=true", "outputs.frames=2"),
        *("pericardium.k_peri_kpa_per_um=0", "loads.vein_spring_kpa_per_um=0"),
    ]
    given = build_scene({"anatomy": {"bundle": "bundle"}}, settings, folder=target, where="test")
    return with_parameters(given, POINT)


@pytest.fixture(scope="module")
def root(freefem: FreeFem, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds the run at POINT, and what others may start from."""
    place = tmp_path_factory.mktemp("warm")
    first = run_scene(scene, place, warm=True)
    assert first.manifest["start"] == {"way": "cold"}
    return place


def features(run: RunResult) -> np.ndarray:
    assert run.status == "done", run.message
    return np.array([value for name, value in run.features.items() if name.endswith(("_ml", "global_mm")) and value is not None])


def states(place: Path) -> list[Path]:
    return sorted((place / warm.FOLDER).glob("*/*.npz"))


@pytest.fixture
def alone(scene: Scene, root: Path, tmp_path: Path) -> Path:
    """Holds what may be started from of the run at POINT, and nothing else; its file."""
    kept = root / warm.FOLDER / warm.family(scene) / f"{run_scene(scene, root).key}.npz"
    place = tmp_path / "alone" / warm.FOLDER / kept.parent.name / kept.name
    place.parent.mkdir(parents=True)
    place.write_bytes(kept.read_bytes())
    return place


def test_a_warm_run_is_the_cold_one_in_fewer_steps(scene: Scene, root: Path, tmp_path: Path) -> None:
    # .1 of the studied range of EDP (1 - 12) is 1.1 mmHg, of alpha's logarithm (ln 32 = 3.47) a factor of 1.41
    there = with_parameters(scene, {"alpha_roof": 1.4 * 1.25, "edp_mmhg": 3.6, "esp_mmhg": 15.5})
    cold, found = run_scene(there, tmp_path), run_scene(there, root, warm=True)
    start = found.manifest["start"]
    assert found.key == cold.key and "start" not in cold.manifest
    assert start["way"] == "warm" and start["from"] == run_scene(scene, root).key
    assert set(start["states"]) == {"prestrain", "frame001", "es"}
    assert all(said["accepted"] and said["newton"] <= 4 for said in start["states"].values())
    # of its range, ESP (13 - 37) goes .0625, EDP .6 / 11 = .0545, alpha's logarithm .223 / 3.466 = .0644
    assert start["share"] == pytest.approx(0.0644, abs=1e-4)
    np.testing.assert_allclose(features(found), features(cold), atol=1e-5)
    assert found.features["factorisations"] < cold.features["factorisations"]
    ours, theirs = ((run.folder / "sensitivities.csv").read_text().splitlines()[0] for run in (found, cold))
    assert ours == theirs


def test_a_start_on_another_way_is_refused_and_the_long_one_taken(scene: Scene, alone: Path, tmp_path: Path) -> None:
    there = with_parameters(scene, {"esp_mmhg": 14.5})
    with np.load(alone) as kept:
        content = dict(kept)
    # what it starts from is not where the other run ended: the solution is found, but too far away
    content["es_unknowns"] = content["frame001_unknowns"]
    content["es_rates"] = np.zeros_like(content["es_rates"])
    np.savez(alone, **content)
    found, cold = run_scene(there, tmp_path / "alone", warm=True), run_scene(there, tmp_path / "cold")
    said = found.manifest["start"]["states"]
    assert said["prestrain"]["accepted"] and not said["es"]["accepted"] and said["es"]["newton"] <= 15
    np.testing.assert_allclose(features(found), features(cold), atol=1e-5)


def test_a_damaged_state_is_passed_over(scene: Scene, root: Path, tmp_path: Path) -> None:
    place = tmp_path / warm.FOLDER / warm.family(scene)
    place.mkdir(parents=True)
    (place / "0123456789abcdef.npz").write_bytes(b"PK\x03\x04 half of a file")
    assert warm.nearest(plan.prepare(scene), tmp_path) == warm.Start()


def test_steps_are_along_logarithms_of_what_is_varied_by_factors() -> None:
    start = np.full(len(NAMES), 1.0)
    end = start.copy()
    alpha, edp = NAMES.index("alpha_roof"), NAMES.index("edp_mmhg")
    end[alpha], end[edp] = 2.0, 3.2
    along, shares = warm.steps(start, end)
    # a step of ln 2 along the logarithm at alpha 1 is one of .693; the range .125 - 4 is ln 32 = 5 ln 2 long
    assert along[alpha] == pytest.approx(math.log(2)) and shares[alpha] == pytest.approx(0.2)
    assert along[edp] == pytest.approx(2.2) and shares[edp] == pytest.approx(0.2)
    assert np.count_nonzero(along) == 2


@pytest.mark.parametrize("name", ["vein_spring_kpa_per_um", "edp_mmhg"])
def test_what_is_switched_on_or_is_no_input_of_the_study_is_not_near(name: str) -> None:
    start, end = np.full(len(NAMES), 1.0), np.full(len(NAMES), 1.0)
    start[NAMES.index(name)] = 0.0
    assert warm.steps(start, end)[1].max() == math.inf


def test_far_away_nothing_is_near(scene: Scene, alone: Path, tmp_path: Path) -> None:
    root = tmp_path / "alone"
    near = plan.prepare(with_parameters(scene, {"esp_mmhg": 20.0}))  # 6 / 24 = .25 of the range: as it is
    assert warm.nearest(near, root).share == pytest.approx(0.25)
    assert not warm.nearest(plan.prepare(with_parameters(scene, {"esp_mmhg": 22.0})), root).states


def test_another_mesh_law_or_tolerance_is_another_family(scene: Scene) -> None:
    other = scene.model_copy(update={"numerics": scene.numerics.model_copy(update={"tolerance_mm": 1e-4})})
    assert warm.family(other) != warm.family(scene)
    assert warm.family(with_parameters(scene, {"esp_mmhg": 20.0})) == warm.family(scene)


def test_states_of_runs_with_unstable_modes_are_not_kept(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "prestrain.state").write_bytes(bytes(8 * 16))
    numbers = {"ed_modes": {"unstable": 1.0}, "es_modes": {"unstable": 0.0}}
    assert not warm.keep(plan.prepare(scene), Results({}, numbers), tmp_path, tmp_path)
    assert not states(tmp_path)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("numerics.unloading=backward", 'numerics.unloading = "prestrain"'),
        ("outputs.sensitivities=false", "leave --no-sensitivities out"),
        ("numerics.rest_sweeps=3", "numerics.rest_sweeps = 0"),
        ("numerics.settle_ed=true", "numerics.settle_ed to false"),
        ("numerics.engine=script", 'compiled engine, and numerics.engine is "script"'),
        ("numerics.engine=auto", "compiled engine, and there is no C++ compiler"),
    ],
)
def test_where_no_run_can_start_warm_is_said_once(
    override: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr("lacli.calibration.simulator.note", told.append)
    monkeypatch.setattr("lacli.mechanics.engine.find", lambda: None)
    monkeypatch.setattr("lacli.mechanics.engine.plugin_obstacle", lambda _: "there is no C++ compiler: install one")
    settings = ["outputs.sensitivities=true", "numerics.engine=plugin", override]
    chosen = build_scene({"anatomy": {"bundle": "la"}}, settings, folder=tmp_path, where="test")
    derivatives = chosen.outputs.sensitivities
    simulator(chosen, tmp_path / "runs", sensitivities=derivatives)
    assert told == []
    simulator(chosen, tmp_path / "runs", sensitivities=derivatives, warm=True)
    assert len(told) == 1 and told[0].startswith("all runs start cold: ") and words in told[0]
    able = build_scene({"anatomy": {"bundle": "la"}}, settings[:2], folder=tmp_path, where="test")
    simulator(able, tmp_path / "runs", warm=True)
    assert len(told) == 1
