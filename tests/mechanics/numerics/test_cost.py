"""What a simulation will cost: the price of an ordinary scene, corrected by runs."""

from __future__ import annotations

from pathlib import Path

import pytest
from shapes import hollow_cube

from lacli.contracts.scene import Scene, build_scene, with_parameters
from lacli.mechanics.numerics.cost import Earlier, expected, ordinary

PLAIN = ("outputs.unloaded=false", "outputs.sensitivities=false", "outputs.frames=0")


def scene(*settings: str) -> Scene:
    return build_scene({"anatomy": {"bundle": "la"}}, [*PLAIN, "numerics.order=1", *settings], folder=Path("/"), where="test")


def ran(a_scene: Scene, cpu_s: float, unknowns: int = 256, memory: float = 50.0) -> Earlier:
    return Earlier(a_scene, {"unknowns": unknowns, "cpu_s": cpu_s, "peak_memory_mb": memory})


def test_an_ordinary_scene_s_price_by_hand() -> None:
    # 17 systems (5 reservoir, 4 prestrain, 8 pericardium) of 2e-7 x 10,000^1.5 = .2 s, and .2 + .15 s to begin
    cpu, memory = ordinary(scene(), 10_000)
    assert cpu == pytest.approx(3.75)
    assert memory == pytest.approx(93.0)
    assert ordinary(scene("pericardium.k_peri_kpa_per_um=0", "loads.edp_mmhg=0"), 10_000)[0] == pytest.approx(1.35)


@pytest.mark.parametrize(
    "term", ["outputs.unloaded=true", "outputs.sensitivities=true", "numerics.quadrature=14", "numerics.engine=script"]
)
def test_every_term_costs(term: str) -> None:
    assert ordinary(scene(term), 5000)[0] > ordinary(scene(), 5000)[0]


def test_runs_correct_the_price_by_their_median() -> None:
    bundle = hollow_cube()
    blind = expected(scene(), bundle, [])
    assert (blind.unknowns, blind.runs) == (256, 0)
    found = expected(scene(), bundle, [*(ran(scene(), s) for s in (1.0, 2.0, 9.0)), Earlier(scene(), {"edv_ml": 3.0})])
    assert found.runs == 3
    assert found.cpu_s == pytest.approx(2.0) and found.peak_memory_mb == pytest.approx(50.0)
    # a scene with one more term costs more by that term's factor
    assert expected(scene("numerics.quadrature=14"), bundle, [ran(scene(), 2.0)]).cpu_s == pytest.approx(2.0 * 1.6)


def test_runs_near_by_and_of_the_same_order_count_first() -> None:
    bundle = hollow_cube()
    hard = with_parameters(scene(), {"edp_mmhg": 9.0, "esp_mmhg": 35.0})
    near = with_parameters(scene(), {"edp_mmhg": 8.8, "esp_mmhg": 34.0})
    runs = [ran(near, 8.0), *(ran(scene(), 1.0) for _ in range(9)), ran(scene("numerics.order=2"), 500.0)]
    assert expected(hard, bundle, runs).cpu_s == pytest.approx(8.0)
    assert expected(scene(), bundle, runs).cpu_s == pytest.approx(1.0)
