"""From scene to features on a cut ball: what the deck contains, and what its results must obey."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import fibrous_ball, icosphere

from lacli.anatomy.surface_features import cavity_volume_ml, surface_features
from lacli.base.errors import AnatomyError, InputError, SceneError, SimulationError, StorageError, UsageError
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle, as_order
from lacli.contracts.case import Case
from lacli.contracts.features import KEYS
from lacli.contracts.labels import EPI
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import Scene, build_scene
from lacli.freefem import run as freefem
from lacli.freefem.files import read_state
from lacli.mechanics import deck, inputs, plan, simulation
from lacli.mechanics.features import regional_extras
from lacli.mechanics.results import Results, State, transients
from lacli.mechanics.store import list_runs
from lacli.motion.annulus import asked_motion
from lacli.synthetic.atrium import synthesize


@pytest.fixture(scope="module")
def ball() -> Bundle:
    return fibrous_ball(order=2)


@pytest.fixture(scope="module")
def folder(ball: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("ball")
    bundles.save(ball, target / "bundle")
    return target


def scene(folder: Path, *overrides: str) -> Scene:
    base = [
        "motion.annulus=none",
        "loads.vein_spring_kpa_per_um=0",
        "pericardium.k_peri_kpa_per_um=0",
        "numerics.order=1",
        "loads.edp_mmhg=0",
        "loads.esp_mmhg=6",
        "outputs.fields=none",
    ]
    return build_scene({"anatomy": {"bundle": "bundle"}}, [*base, *overrides], folder=folder, where="test")


def rendered(folder: Path, ball: Bundle, *overrides: str) -> str:
    chosen = scene(folder, *overrides)
    motion = asked_motion(chosen.motion, ball, chosen.anatomy.bundle)
    return deck.render(chosen, plan.make_plan(chosen, ball, motion), Path("/tmp/lacli.so"))


def test_the_deck_contains_only_what_the_scene_asks_for(folder: Path, ball: Bundle) -> None:
    bare = rendered(folder, ball)
    for word in ("pericardium", "vein", "annulus", "unload", "prestrain", "conduit"):
        assert word not in bare
    full = rendered(
        folder, ball, "pericardium.k_peri_kpa_per_um=0.001", "motion.annulus=axial", "loads.edp_mmhg=2", "outputs.conduit=true"
    )
    for word in ("pericardium.txt", "annulusAt", "prestrain.idp", "unloaded.txt", "conduit"):
        assert word in full
    assert "unloading.idp" not in full
    backward = rendered(folder, ball, "loads.edp_mmhg=2", "numerics.unloading='backward'")
    assert "unloading.idp" in backward and "prestrain.idp" not in backward
    assert "unloaded.txt" not in rendered(folder, ball, "loads.edp_mmhg=2", "outputs.unloaded=false")


def test_units_are_converted_once(folder: Path, ball: Bundle) -> None:
    text = rendered(folder, ball, "pericardium.k_peri_kpa_per_um=0.002")
    assert "pericardiumSpring = 2.0;" in text  # 0.002 kPa/um is 2 kPa/mm
    assert repr(6 * 0.133322) in text  # 6 mmHg in kPa


def test_a_term_left_out_equals_a_term_of_zero(folder: Path, ball: Bundle, tmp_path: Path) -> None:
    chosen = scene(folder)
    work = as_order(ball, 1)
    without = plan.make_plan(chosen, work, None)
    volumes = []
    for name, terms in (("without", without), ("zero", replace(without, pericardium=True))):
        place = tmp_path / name
        place.mkdir()
        outcome = deck.run(deck.write(Case(chosen, work, None, terms, key=""), place))
        assert outcome.done, outcome.message
        x, _ = read_state(place / "es.txt", len(work.points))
        volumes.append((cavity_volume_ml(work, x), x))
    assert volumes[0][0] == pytest.approx(volumes[1][0], rel=1e-8)
    assert np.abs(volumes[0][1] - volumes[1][1]).max() < 1e-8


def test_pressure_inflates_and_stiffness_resists(folder: Path, tmp_path: Path) -> None:
    soft = simulation.run_scene(scene(folder), tmp_path)
    stiff = simulation.run_scene(scene(folder, "materials.alpha=4"), tmp_path)
    held = simulation.run_scene(scene(folder, "pericardium.k_peri_kpa_per_um=0.005"), tmp_path)
    assert soft.status == stiff.status == held.status == "done"
    assert soft.features["edv_ml"] < stiff.features["esv_ml"] < soft.features["esv_ml"]
    assert held.features["esv_ml"] < soft.features["esv_ml"]
    assert held.features["d_anterior_mm"] < soft.features["d_anterior_mm"]
    assert 0.3 < soft.features["min_jacobian"] <= 1.05
    table = np.genfromtxt(soft.folder / "transients.csv", delimiter=",", names=True, dtype=None, encoding="ascii")
    assert table["volume_ml"][-1] == pytest.approx(soft.features["esv_ml"], rel=1e-12)
    # the same content again is not simulated again
    assert simulation.run_scene(scene(folder), tmp_path).manifest == soft.manifest


def test_prestrain_keeps_the_image_and_shrinks_without_pressure(folder: Path, tmp_path: Path) -> None:
    result = simulation.run_scene(scene(folder, "loads.edp_mmhg=3", "loads.esp_mmhg=8"), tmp_path)
    assert result.status == "done", result.message
    features = result.features
    assert features["ed_shape_error_mean_mm"] == 0 and features["ed_unstable_modes"] == 0 == features["es_unstable_modes"]
    assert features["unloaded_volume_ml"] < 0.95 * features["edv_ml"] < 0.95 * features["esv_ml"]
    # the more of the wall's stiffness is used up at end-diastole, the less is left for the way to end-systole
    loose = simulation.run_scene(scene(folder, "loads.edp_mmhg=1", "loads.esp_mmhg=8"), tmp_path)
    assert features["esv_ml"] < loose.features["esv_ml"]
    table = np.genfromtxt(result.folder / "transients.csv", delimiter=",", names=True, dtype=None, encoding="ascii")
    assert len(table) == 2  # end-diastole and end-systole; the unloaded state is no point of the cycle


@pytest.mark.slow
def test_backward_displacement_returns_to_the_image(folder: Path, tmp_path: Path) -> None:
    overrides = ("numerics.order=2", "loads.edp_mmhg=3", "loads.esp_mmhg=8", "numerics.unloading='backward'")
    result = simulation.run_scene(scene(folder, *overrides), tmp_path)
    assert result.status == "done", result.message
    assert abs(result.features["ed_volume_error"]) < 0.01
    assert result.features["ed_shape_error_mean_mm"] < 0.3
    assert result.features["unloaded_volume_ml"] < result.features["edv_ml"] < result.features["esv_ml"]


def test_a_wall_that_snaps_through_arrives_at_the_load_it_has(tmp_path: Path) -> None:
    """Soft and regionally uneven, from 1 to 13 mmHg: the way is long and has folds, which shorter loads would meet again."""
    made, motion = synthesize(1, None, cell_size_mm=8.0, order=1)
    bundles.save(made, tmp_path / "bundle")
    save_motion(motion, tmp_path / "bundle")
    soft = {"anterior": 0.2, "posterior": 0.2, "septum": 6.8, "lateral": 6.8, "roof": 6.8}
    bendy = {"anterior": 0.125, "posterior": 4, "septum": 4, "lateral": 0.125, "roof": 0.125}
    settings = [f"materials.c_kpa.{name}={value}" for name, value in soft.items()]
    settings += [f"materials.alpha.{name}={value}" for name, value in bendy.items()]
    settings += ["loads.edp_mmhg=1", "loads.esp_mmhg=13", "pericardium.k_peri_kpa_per_um=0.0001", "pericardium.pth=0.5"]
    settings += ["numerics.order=1", "outputs.fields=none", "outputs.unloaded=false"]
    chosen = build_scene({"anatomy": {"bundle": "bundle"}}, settings, folder=tmp_path, where="test")
    run = simulation.run_scene(chosen, tmp_path / "runs")
    features = run.features
    assert features["steps_back"] == 0 and features["load_steps"] == 2
    assert features["newton_iterations"] > 50  # else this is no such way
    assert features["es_unstable_modes"] == 0
    # the last tangent that was factorised gave a step beyond the tolerance (by how much hangs on the way, so on how a processor
    # rounds): its factors alone found the state
    steps = re.findall(r"phase=reservoir .* move=(\S+) viscosity=0$", (run.folder / "solver.log").read_text(), re.MULTILINE)
    assert float(steps[-1]) > chosen.numerics.tolerance_mm


def test_out_of_time_in_the_unloaded_state_loses_that_state_alone(folder: Path, tmp_path: Path, monkeypatch) -> None:
    run = freefem.run

    def cut(*arguments, **options):
        """The run as if stopped while the unloaded state was sought, in the middle of a line."""
        outcome = run(*arguments, **options)
        history = arguments[2] / "history.txt"
        before = history.read_text().split("state_unloaded")[0]
        assert before.endswith("end\n")
        history.write_text(before + "state_unlo")
        (arguments[2] / "unloaded.txt").unlink()
        return replace(outcome, kind="timeout", message="stopped")

    overrides = ("loads.edp_mmhg=2", "loads.esp_mmhg=5")
    whole = simulation.run_scene(scene(folder, *overrides), tmp_path / "whole")
    monkeypatch.setattr(freefem, "run", cut)
    result = simulation.run_scene(scene(folder, *overrides), tmp_path / "cut")
    assert result.status == "done"
    assert result.features["unloaded_volume_ml"] is None
    assert result.features["esv_ml"] == pytest.approx(whole.features["esv_ml"], rel=1e-12)


@pytest.mark.parametrize(("share", "kind"), [(0.9, "timeout"), (0.1, "starved")])
def test_a_run_out_of_time_is_kept_if_it_computed(folder: Path, tmp_path: Path, monkeypatch, share: float, kind: str) -> None:
    """Stopped after the same time by the clock; one that computed for a tenth of it has not shown how long its scene takes."""
    limit = 0.05
    supervise = freefem.supervise
    monkeypatch.setattr(freefem, "supervise", lambda *a, **k: replace(supervise(*a, **k), cpu_s=share * limit))
    slow = scene(folder, f"numerics.timeout_s={limit}", "numerics.order=2", "loads.edp_mmhg=5")
    result = simulation.run_scene(slow, tmp_path)
    assert (result.status, result.kind) == ("failed", kind)
    assert f"{limit} s" in result.message and ("busy" in result.message) == (kind == "starved")
    assert (result.folder / "solver.log").is_file() == (kind == "timeout")
    assert [stored.kind for stored in list_runs(tmp_path)] == (["timeout"] if kind == "timeout" else [])


def test_what_the_scene_needs_and_the_bundle_lacks_is_named(folder: Path, ball: Bundle) -> None:
    wanting = scene(folder, "loads.vein_spring_kpa_per_um=0.001")
    with pytest.raises(AnatomyError, match="vein_spring_kpa_per_um to 0"):
        plan.make_plan(wanting, ball, None)
    with pytest.raises(AnatomyError, match="tag 11"):
        plan.make_plan(scene(folder), replace(ball, tags=np.where(ball.tags == 11, 2, ball.tags)), None)
    with pytest.raises(SceneError, match="kappa_points_kpa"):
        scene(folder, "numerics.kappa_points_kpa=2000")
    naked = replace(ball, fibre=None)
    with pytest.raises(AnatomyError, match="fibre"):
        inputs.material_table(naked, scene(folder).materials, 100.0)


@pytest.mark.parametrize("settles", [True, False])
def test_the_plan_tells_whether_end_diastole_settles(folder: Path, ball: Bundle, settles: bool) -> None:
    chosen = scene(folder, "loads.edp_mmhg=2", f"numerics.settle_ed={str(settles).lower()}")
    assert ("settled end-diastole", settles, "numerics.settle_ed") in plan.describe(chosen, ball)


def test_displacements_are_from_the_image_where_end_diastole_is_another(folder: Path, ball: Bundle) -> None:
    """End-diastole 1 mm off the image, end-systole 3 mm: 3 mm of displacement, not 2, as the features' definition says."""
    chosen = scene(folder, "loads.edp_mmhg=2", "numerics.unloading='backward'")
    case = Case(chosen, ball, None, plan.make_plan(chosen, ball, None), "k")
    at = {name: State(ball.points + np.array([0.0, 0.0, up]), ball.points, 1.0, 1.0) for name, up in (("ed", 1.0), ("es", 3.0))}
    table = transients(case, Results(at, {}))
    assert table["d_global_mm"].tolist() == pytest.approx([1.0, 3.0])
    assert "as imaged" in KEYS["d_global_mm"].definition and "as imaged" in KEYS["d_roof_mm"].definition


def test_features_of_known_motions(ball: Bundle) -> None:
    shift = np.array([3.0, 0.0, 4.0])
    moved = surface_features(ball, ball.points, ball.points + shift)
    assert moved["d_global_mm"] == pytest.approx(5.0, rel=1e-12)  # |(3, 0, 4)|
    scaled = ball.points * 1.1
    assert cavity_volume_ml(ball, scaled) == pytest.approx(1.331 * cavity_volume_ml(ball, ball.points), rel=1e-12)  # 1.1^3
    # a ball of 20 mm less its cap of 6 mm height: pi (4/3 r^3 - h^2 (3 r - h) / 3), in mL
    exact = np.pi * (4 / 3 * 20**3 - 36 * (60 - 6) / 3) / 1000
    assert cavity_volume_ml(ball, ball.points) == pytest.approx(exact, rel=0.01)


def test_extras_of_an_affine_stretch(ball: Bundle) -> None:
    stretched = ball.points * np.array([1.2, 1.2, 1.2])
    extras = regional_extras(ball, ball.points, stretched)
    assert extras["fibre_stretch_anterior"] == pytest.approx(0.2, rel=1e-9)
    assert extras["thickness_change_anterior"] == pytest.approx(0.2, rel=1e-9)


def test_pericardium_weight_is_zero_at_the_valve_and_one_on_the_roof(folder: Path) -> None:
    settings = scene(folder, "pericardium.pth=0.75").pericardium
    weight = inputs.pericardium_weight(np.array([0.0, 0.55, 0.65, 0.75, 1.0]), settings)
    # smoothstep((xi - 0.55) / 0.2): s = 0.5 gives 0.25 * (3 - 1) = 0.5
    assert weight == pytest.approx([0, 0, 0.5, 1, 1])


@pytest.fixture(scope="module")
def dented() -> Bundle:
    """The surface of a ball of 30 mm as an outer surface, its cap above z = 25 mm pressed in: mirrored at that plane."""
    ball = icosphere(30.0, 5)
    points = ball.points.copy()
    points[:, 2] = np.where(points[:, 2] > 25.0, 50.0 - points[:, 2], points[:, 2])
    tags = np.full(len(ball.triangles), EPI)
    none = np.zeros((0, 4), dtype=np.int64)
    height = np.clip((points[:, 2] + 30.0) / 60.0, 0, 1)
    return Bundle(points, none, np.zeros(0, dtype=np.int64), ball.triangles, tags, None, pericardium_coordinate=height)


def test_springs_hold_dents_alone(ball: Bundle, dented: Bundle) -> None:
    weight = inputs.dent_weight(dented)
    middle = dented.points[dented.triangles].mean(axis=1)
    beside = np.hypot(middle[:, 0], middle[:, 1])  # the dent's rim is at sqrt(30^2 - 25^2) = 16.6 mm
    deep, far = (beside < 9.0) & (middle[:, 2] > 0), middle[:, 2] < 10.0
    # -2 / 30 in the dent, 2 / 30 elsewhere
    assert deep.sum() > 100 and (weight[deep] == 1).all()
    assert (weight[far] == 0).all()
    # a ball has none: with and without the term the springs are the same
    assert (inputs.dent_weight(ball)[ball.tags == EPI] == 0).all()


def test_where_springs_hold_a_dent_the_end_of_the_pericardium_moves_nothing(folder: Path, dented: Bundle) -> None:
    # the dent's bottom is at (20 + 30) / 60 = .83 of the way, where the springs set in
    ends = "pericardium.pth=0.95"
    weight, slope = inputs.support(dented, scene(folder, ends, "pericardium.dents=true").pericardium)
    without, moved = inputs.support(dented, scene(folder, ends).pericardium)
    assert (weight >= without).all() and (weight > without).any()
    held = weight > without
    assert (slope[held] == 0).all() and (slope[~held] == moved[~held]).all() and (moved != 0).any()


def test_a_linear_bundle_refuses_quadratic_numerics(ball: Bundle) -> None:
    linear = as_order(ball, 1)
    assert linear.tets.shape[1] == 4 and linear.tets.max() == len(linear.points) - 1
    with pytest.raises(AnatomyError, match=r"numerics\.order"):
        as_order(linear, 2)


def test_a_deck_written_to_be_run_by_hand_gives_the_same_features(folder: Path, tmp_path: Path) -> None:
    chosen = scene(folder)
    whole = simulation.run_scene(chosen, tmp_path / "runs")
    script = simulation.write_by_hand(chosen, tmp_path / "by hand")
    with pytest.raises(SimulationError, match="history"):
        simulation.read_by_hand(tmp_path / "by hand")  # it has not run
    subprocess.run([str(script)], check=True, capture_output=True, timeout=120)
    features = simulation.read_by_hand(tmp_path / "by hand")
    assert features == {name: value for name, value in whole.features.items() if name not in ("cpu_s", "peak_memory_mb")}
    assert (tmp_path / "by hand" / "transients.csv").is_file()
    with pytest.raises(StorageError, match="not empty"):
        simulation.write_by_hand(chosen, tmp_path / "by hand")


def test_a_stored_run_is_run_again_and_stays(folder: Path, tmp_path: Path) -> None:
    whole = simulation.run_scene(scene(folder), tmp_path)
    before, after = simulation.rerun(whole.folder)
    assert before == whole.features
    assert after["esv_ml"] == before["esv_ml"]
    assert [path.name for path in tmp_path.iterdir() if not path.name.startswith(".locks")] == [whole.key]
    text = (whole.folder / "scene.toml").read_text()
    (whole.folder / "scene.toml").write_text(text.replace("esp_mmhg = 6", "esp_mmhg = 7"))
    with pytest.raises(UsageError, match="no longer"):
        simulation.rerun(whole.folder)
    with pytest.raises(InputError, match="no run"):
        simulation.rerun(tmp_path)


def test_results_that_cannot_be_read_are_a_failure_that_is_kept(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same scene would end so again: whoever runs many goes on with the others."""
    run = freefem.run

    def cut(*arguments, **options):
        outcome = run(*arguments, **options)
        file = arguments[2] / "es.txt"
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        return outcome

    monkeypatch.setattr(freefem, "run", cut)
    result = simulation.run_scene(scene(folder, "loads.edp_mmhg=2", "loads.esp_mmhg=5"), tmp_path)
    assert (result.status, result.kind) == ("failed", "bad_output")
    assert result.message.startswith("FreeFEM's results cannot be read") and (result.folder / "solver.log").is_file()
    monkeypatch.setattr(freefem, "run", run)
    again = simulation.run_scene(scene(folder, "loads.edp_mmhg=2", "loads.esp_mmhg=5"), tmp_path)
    assert again.kind == "bad_output"
