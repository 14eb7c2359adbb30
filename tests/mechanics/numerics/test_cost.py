"""What a simulation will cost: the price of an ordinary scene, corrected by runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import hollow_cube

from lacli.contracts.labels import REGIONS
from lacli.contracts.parameters import STUDY
from lacli.contracts.scene import Scene, build_scene, with_parameters
from lacli.mechanics import engine
from lacli.mechanics.numerics.cost import Earlier, early_states, expected, laplace, ordinary, price, slenderness, systems
from lacli.synthetic.atrium import synthesize

PLAIN = ("outputs.unloaded=false", "outputs.sensitivities=false", "outputs.frames=0")


def scene(*settings: str) -> Scene:
    return build_scene({"anatomy": {"bundle": "la"}}, [*PLAIN, "numerics.order=1", *settings], folder=Path("/"), where="test")


def ran(a_scene: Scene, cpu_s: float, memory: float = 50.0, solved: float | None = None) -> Earlier:
    """A run on the hollow cube; in as many systems as are foretold where ``solved`` does not say."""
    cube = slenderness(hollow_cube())
    solved = systems(a_scene, cube) if solved is None else solved
    features = {"unknowns": 256, "cpu_s": cpu_s, "peak_memory_mb": memory, "newton_iterations": solved}
    return Earlier(a_scene, features, cube)


# walls whose regions' radius is so many times their thickness
WALL = dict.fromkeys(REGIONS, 14.0)
AT = ("loads.edp_mmhg=8", "loads.esp_mmhg=20", "materials.c_kpa=2", "materials.alpha=1")


def test_a_wall_s_slenderness_by_hand() -> None:
    # a cavity of 1 mL: 6.2035 mm; 26 mL of wall on 6 cm2 of endocardium: 43.33 mm
    assert slenderness(hollow_cube()) == pytest.approx({"anterior": 0.14316}, rel=1e-4)
    # of a real wall, by its own numbers: volume 2 mm thick, curved, so a little more than area times 2
    bundle, _ = synthesize(1, 60.0, thickness_mm=2.0, cell_size_mm=8.0, order=1)
    found = slenderness(bundle)
    radius = (3.0 * bundle.cavity_volume_ml() * 1000.0 / (4.0 * np.pi)) ** (1 / 3)
    assert set(found) == set(REGIONS)
    assert all(radius / 2.4 < ratio < radius / 1.9 for ratio in found.values())


def test_laplace_s_measure_is_that_of_the_weakest_region() -> None:
    # 20 mmHg = 2.6664 kPa: 2.6664 x 14 / (2 x 1) = 18.665
    assert laplace(scene(*AT), WALL) == pytest.approx(18.665, rel=1e-4)
    # a roof of a quarter of the stiffness, or of a quarter of the thickness
    assert laplace(scene(*AT, "materials.alpha.roof=0.25"), WALL) == pytest.approx(4.0 * 18.665, rel=1e-4)
    assert laplace(scene(*AT), WALL | {"roof": 56.0}) == pytest.approx(4.0 * 18.665, rel=1e-4)


def test_an_ordinary_scene_s_systems_and_price_by_hand() -> None:
    # exp(1.65) 18.665^.33 = 5.2070 x 2.6267 = 13.677
    a_scene = scene(*AT)
    assert systems(a_scene, WALL) == pytest.approx(13.677, rel=1e-3)
    # .7 of them where no pericardium resists
    assert systems(with_parameters(a_scene, {"k_peri_kpa_per_um": 0.0}), WALL) == pytest.approx(0.7 * 13.677, rel=1e-3)
    # quadratic cells take 1.3 times as many
    assert systems(scene(*AT, "numerics.order=2"), WALL) == pytest.approx(1.3 * 13.677, rel=1e-3)
    # 10,000 unknowns: .78 s to begin, .087 s a system; 28 + 64 MB
    assert price(a_scene, 10_000, 20.0) == pytest.approx(2.52)
    assert ordinary(a_scene, 10_000, WALL) == pytest.approx((0.78 + 0.087 * systems(a_scene, WALL), 92.0))
    # each time after end-systole 1.5 more
    assert systems(scene(*AT, "outputs.times=[0.4, 0.7]"), WALL) == pytest.approx(13.677 + 1.5, rel=1e-3)


@pytest.mark.parametrize(
    "loads",
    [
        ("loads.edp_mmhg=0", "loads.esp_mmhg=0"),
        # 0 at end-systole
        ("loads.edp_mmhg=5", "motion.es_time=0.4", "loads.transient_mmhg=[[0.0, 5.0], [0.4, 0.0], [1.0, 0.0]]"),
    ],
)
def test_without_a_load_there_is_a_system_to_solve(loads: tuple[str, ...]) -> None:
    """Laplace's measure is 0: a system, or .7 of one without pericardium; what such a run took tells of others."""
    still = scene(*loads)
    assert laplace(still, WALL) == 0.0
    assert systems(still, WALL) == pytest.approx(1.0)
    bundle = hollow_cube()
    assert expected(still, bundle, []).low_s > 0.0
    told = expected(scene(*AT), bundle, [ran(still, 0.2, solved=2.0)])
    assert 0.0 < told.cpu_s < np.inf and told.runs == 1


def test_a_thin_wall_takes_more() -> None:
    """Four times as thin: 4^.33 = 1.580 times the systems."""
    thin = dict.fromkeys(REGIONS, 56.0)
    assert systems(scene(*AT), thin) / systems(scene(*AT), WALL) == pytest.approx(1.580, rel=1e-3)


def test_states_before_end_systole_cost() -> None:
    """Three of them 4^.29 = 1.495 times the systems of end-systole alone, for they are found from it backward."""
    for states in ("outputs.times=[0.1, 0.2, 0.3]", "outputs.frames=4"):
        asked = scene(*AT, states)
        assert early_states(asked) == 3
        assert systems(asked, WALL) == pytest.approx(1.495 * 13.677, rel=1e-3)
    assert early_states(scene("outputs.times=[0.2, 0.4, 0.7]")) == 1
    # four states of the conduit
    conduit = scene(*AT, "outputs.frames=4", "outputs.conduit=true")
    assert systems(conduit, WALL) == pytest.approx(1.495 * 13.677 + 6.0, rel=1e-3)


@pytest.mark.parametrize(
    "term",
    [
        "outputs.unloaded=true",
        "outputs.sensitivities=true",
        "numerics.rest_sweeps=1",
        "numerics.quadrature=14",
        "numerics.engine=script",
    ],
)
def test_every_term_costs(term: str) -> None:
    assert ordinary(scene(term), 5000, WALL)[0] > ordinary(scene(), 5000, WALL)[0]


def test_runs_tell_the_machine_s_speed_by_their_systems() -> None:
    bundle = hollow_cube()
    blind = expected(scene(), bundle, [])
    assert (blind.unknowns, blind.runs) == (256, 0)
    # three times as long as here for as many systems as foretold: three times the price, and nothing else
    slow = expected(scene(), bundle, [ran(scene(), 3.0 * blind.cpu_s), Earlier(scene(), {"edv_ml": 3.0}, None)])
    assert slow.runs == 1
    assert slow.cpu_s == pytest.approx(3.0 * blind.cpu_s) and slow.peak_memory_mb == pytest.approx(50.0)
    # a scene with one more term costs more by that term's factor
    points = expected(scene("numerics.quadrature=14"), bundle, [ran(scene(), 3.0 * blind.cpu_s)])
    assert points.cpu_s == pytest.approx(3.0 * 1.8 * blind.cpu_s)


@pytest.mark.parametrize(("here", "by"), [("", "plugin"), ("there is no C++ compiler", "script")])
def test_the_price_is_that_of_the_engine_that_will_run(monkeypatch: pytest.MonkeyPatch, here: str, by: str) -> None:
    """ "auto" takes the script where nothing can be compiled. What that took in another run tells the machine's speed as well."""
    monkeypatch.setattr(engine, "plugin_obstacle", lambda found: here)
    monkeypatch.setattr(engine, "find", lambda: None)
    bundle = hollow_cube()
    auto = scene("numerics.engine=auto")
    plugin, script = (scene(f"numerics.engine={name}") for name in ("plugin", "script"))
    foretold = {"plugin": expected(plugin, bundle, []).cpu_s, "script": expected(script, bundle, []).cpu_s}
    assert foretold["script"] == pytest.approx(engine.SLOWER[1] * foretold["plugin"])
    assert expected(auto, bundle, []).cpu_s == pytest.approx(foretold[by])
    # each engine's runs took twice what they take on the constants' machine
    for name in ("plugin", "script"):
        done = replace(ran(auto, 2.0 * foretold[name]), engine=name)
        assert expected(auto, bundle, [done]).cpu_s == pytest.approx(2.0 * foretold[by])


def test_runs_near_by_tell_how_many_systems() -> None:
    bundle = hollow_cube()
    hard = with_parameters(scene(), {"edp_mmhg": 9.0, "esp_mmhg": 35.0, "alpha_roof": 0.4})
    middle = systems(hard, slenderness(bundle))
    often = ran(hard, price(hard, 256, 4.0 * middle), solved=4.0 * middle)
    base, one, many = (expected(hard, bundle, [often] * count) for count in (0, 1, 20))
    # one run there: .37^2 / (.37^2 + .18^2) = .8086 of ln 4, 3.068 times the systems; twenty: .9883
    assert one.cpu_s == pytest.approx(price(hard, 256, 3.068 * middle), rel=1e-3)
    assert many.cpu_s == pytest.approx(price(hard, 256, 4.0**0.9883 * middle), rel=1e-3)
    assert base.cpu_s < one.cpu_s < many.cpu_s
    # far away it tells nothing: 14 inputs at the other end of their ranges
    far = with_parameters(scene(), dict.fromkeys((n for n in STUDY if n.startswith(("c_", "alpha_"))), 3.9))
    assert expected(far, bundle, [often]).cpu_s == pytest.approx(expected(far, bundle, []).cpu_s, rel=1e-3)


def test_runs_of_another_anatomy_or_order_tell_less() -> None:
    bundle = hollow_cube()
    middle = systems(scene(), slenderness(bundle))
    often = ran(scene(), price(scene(), 256, 4.0 * middle), solved=4.0 * middle)
    moved = scene().anatomy.model_copy(update={"bundle": Path("/another")})
    elsewhere = replace(often, scene=scene().model_copy(update={"anatomy": moved}))
    # .84 x .8086 of ln 4
    found = expected(scene(), bundle, [elsewhere])
    assert found.cpu_s == pytest.approx(price(scene(), 256, 4.0 ** (0.84 * 0.8086) * middle), rel=1e-3)
    # a run whose anatomy is gone tells the speed alone
    gone = expected(scene(), bundle, [replace(often, slender=None)])
    assert gone.cpu_s == pytest.approx(expected(scene(), bundle, []).cpu_s) and gone.runs == 1


def test_warm_runs_tell_the_speed_alone() -> None:
    """From where another had ended a run takes a few systems; one that finds none near by takes what it ordinarily does."""
    bundle = hollow_cube()
    few = 0.25 * systems(scene(), slenderness(bundle))
    warm = replace(ran(scene(), 2.0 * price(scene(), 256, few), solved=few), warm=True)
    blind, told = (expected(scene(), bundle, runs) for runs in ([], [warm] * 9))
    assert told.cpu_s == pytest.approx(2.0 * blind.cpu_s)
    assert told.high_s / told.cpu_s == pytest.approx(blind.high_s / blind.cpu_s)


def test_the_range_narrows_with_runs() -> None:
    bundle = hollow_cube()
    blind, near = (expected(scene(), bundle, [ran(scene(), 2.0)] * count) for count in (0, 9))
    middle = systems(scene(), slenderness(bundle))

    def of_systems(factor: float) -> float:
        """Beginning and end cost the same however many systems there are."""
        return price(scene(), 256, factor * middle) / price(scene(), 256, middle)

    # no run: sqrt(.37^2 + .18^2) = .4115; exp(-1.3 x .4115) and exp(1.9 x .4115) of the middle's systems
    expected_range = (of_systems(0.5857), of_systems(2.185))
    assert (blind.low_s / blind.cpu_s, blind.high_s / blind.cpu_s) == pytest.approx(expected_range, rel=1e-3)
    # nine near by: sqrt(.37^2 + .18^2 - .37^4 / (.37^2 + .18^2 / 9)) = .1895
    expected_range = (of_systems(0.7817), of_systems(1.4333))
    assert (near.low_s / near.cpu_s, near.high_s / near.cpu_s) == pytest.approx(expected_range, rel=1e-3)
