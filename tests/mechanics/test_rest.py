"""Springs at rest where the wall relaxes to without pressure, on a cut ball: a fixed point, the same by both engines."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from shapes import fibrous_ball

from lacli.api.methods.sequential import lacking
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle
from lacli.contracts.scene import Scene, build_scene
from lacli.mechanics import deck, plan, simulation

SPRINGS = ("pericardium.k_peri_kpa_per_um=0.001", "loads.edp_mmhg=3")


@pytest.fixture(scope="module")
def ball() -> Bundle:
    return fibrous_ball(order=1)


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
        "loads.esp_mmhg=8",
        "outputs.fields=none",
    ]
    return build_scene({"anatomy": {"bundle": "bundle"}}, [*base, *overrides], folder=folder, where="test")


@pytest.mark.parametrize(
    ("overrides", "swept"),
    [
        ((*SPRINGS, "numerics.rest_sweeps=2"), True),
        (SPRINGS, False),
        # no springs, no strain in the image, an unloaded shape at which springs rest already
        (("loads.edp_mmhg=3", "numerics.rest_sweeps=2"), False),
        (("pericardium.k_peri_kpa_per_um=0.001", "numerics.rest_sweeps=2"), False),
        ((*SPRINGS, "numerics.rest_sweeps=2", "numerics.unloading=backward"), False),
    ],
)
def test_the_deck_sweeps_only_where_springs_can_move(folder: Path, ball: Bundle, overrides: tuple[str, ...], swept: bool) -> None:
    chosen = scene(folder, *overrides)
    made = plan.make_plan(chosen, ball, None)
    text = deck.render(chosen, made, Path("/tmp/lacli.so"))
    assert ("restWhereRelaxed(0, 2, tightTolerance)" in text) == swept
    assert {term: included for term, included, _ in plan.describe(chosen, ball)}["springs where the wall relaxes"] == swept


def test_the_wall_without_pressure_comes_to_where_its_springs_rest(folder: Path, tmp_path: Path) -> None:
    found = [simulation.run_scene(scene(folder, *SPRINGS, f"numerics.rest_sweeps={n}"), tmp_path) for n in range(4)]
    assert [result.status for result in found] == ["done"] * 4
    assert "rest_move_max_mm" not in found[0].features
    # the move of a sweep is how far the springs of the sweep before pull at the relaxed wall: a linear wall's second is none
    moves = [result.features["rest_move_max_mm"] for result in found[1:]]
    assert moves[1] < 0.25 * moves[0] and moves[2] < moves[1]
    means = [result.features["rest_move_mean_mm"] for result in found[1:]]
    assert all(0 < mean < most for mean, most in zip(means, moves, strict=True))
    # end-diastole is the image's and in balance all the same, and it is another wall that fills
    assert all(result.features["ed_shape_error_mean_mm"] == 0 for result in found)
    assert abs(found[1].features["esv_ml"] - found[0].features["esv_ml"]) > 1e-3
    changes = [abs(b.features["esv_ml"] - a.features["esv_ml"]) for a, b in itertools.pairwise(found)]
    assert changes[1] < 0.5 * changes[0]


def test_both_engines_put_springs_in_one_place(folder: Path, tmp_path: Path) -> None:
    settings = (*SPRINGS, "loads.vein_spring_kpa_per_um=0", "numerics.rest_sweeps=1", "outputs.unloaded=false")
    compiled, script = (
        simulation.run_scene(scene(folder, *settings, f"numerics.engine={name}"), tmp_path / name)
        for name in ("plugin", "script")
    )
    assert (compiled.manifest["engine"], script.manifest["engine"]) == ("plugin", "script")
    for name in ("rest_move_max_mm", "esv_ml", "d_anterior_mm"):
        assert script.features[name] == pytest.approx(compiled.features[name], rel=1e-7)


def test_it_has_no_sensitivities_and_says_so(folder: Path, ball: Bundle, tmp_path: Path) -> None:
    chosen = scene(folder, *SPRINGS, "numerics.rest_sweeps=1", "outputs.sensitivities=true", "outputs.unloaded=false")
    (why,) = [why for term, included, why in plan.describe(chosen, ball) if term == "sensitivities" and not included]
    assert "set numerics.rest_sweeps to 0" in why
    result = simulation.run_scene(chosen, tmp_path)
    assert result.features["sensitivities"]["given"] is False
    assert "numerics.rest_sweeps" in result.features["sensitivities"]["why"]
    assert "numerics.rest_sweeps = 0" in lacking(chosen) and lacking(scene(folder, *SPRINGS)) == ""
