"""The methods behind ``calibrate`` and ``tradeoff``: which one is used, what is refused, and what each gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from membranes import INPUTS, OUTPUTS, Membranes, box, respond
from shapes import hollow_cube

import lacli
import lacli.types
from lacli.api.methods import numerics, published, sequential
from lacli.api.methods.calibrated import Calibrated
from lacli.base.errors import SolverMissingError
from lacli.calibration.sequential.outputs import SIMULATED, SIMULATED_CHEAP
from lacli.calibration.sequential.result import Sequential
from lacli.calibration.simulator import asked
from lacli.contracts.bundle import save
from lacli.contracts.scene import build_scene, load_scene
from lacli.freefem.program import FreeFem
from lacli.inference.runs import Outcome

TRUTH = np.array([1.4, 1.5, 8.9])
TARGETS = lacli.Targets(OUTPUTS, respond(TRUTH)[0], np.full(len(OUTPUTS), 0.1))


@pytest.fixture
def scene(tmp_path: Path) -> lacli.Scene:
    save(hollow_cube(), tmp_path / "la")
    text: dict[str, Any] = {"anatomy": {"bundle": "la"}, "loads": {"edp_mmhg": 8.9}}
    return build_scene(text, ["materials.alpha.roof=1.4", "materials.alpha.septum=1.5"], folder=tmp_path, where="test")


def test_the_sequential_method_is_the_default_and_tells_before_what_can_be_learnt(
    scene: lacli.Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator = Membranes()
    monkeypatch.setattr("lacli.calibration.simulator.simulator", lambda *_, **__: simulator)
    mcmc = lacli.types.SamplingSettings(ess=300, rhat=1.1, max_steps=600)
    given: dict[str, Any] = {
        "box": box(),
        "settings": lacli.types.SequentialSettings(mcmc=mcmc),
        "discretisation": False,
        "cheap": (),
    }
    heard: list[str] = []
    told = lacli.calibrate(scene, TARGETS, tmp_path / "c", forecast=True, progress=lambda e: heard.append(e.stage), **given)
    assert told.inputs == INPUTS and (told.expected_sd < told.prior_sd).all()
    assert heard and simulator.calls == told.runs
    found = lacli.calibrate(scene, TARGETS, tmp_path / "c", **given)
    assert isinstance(found, Calibrated) and isinstance(found.result, Sequential) and found.refused == ""
    assert found.result.map_x == pytest.approx(TRUTH, rel=0.1)
    assert simulator.calls == found.result.runs <= 60, "the forecast's runs are among them"
    assert (found.folder / "result.json").is_file()
    # what was simulated stands beside the runs: a comparison makes more of them
    kept = load_scene(found.folder / SIMULATED)
    assert kept == asked(scene, OUTPUTS) and not (found.folder / SIMULATED_CHEAP).exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"unloading": "backward"}, 'needs derivatives, which only the compiled engine with numerics.unloading = "prestrain"'),
        ({"engine": "script"}, "needs derivatives"),
        ({}, ""),
    ],
)
def test_a_scene_without_derivatives_says_so(scene: lacli.Scene, change: dict[str, str], words: str) -> None:
    changed = scene.model_copy(update={"numerics": scene.numerics.model_copy(update=change)})
    said = sequential.lacking(changed)
    assert words in said and bool(said) == bool(change)


def test_without_a_compiler_there_are_no_derivatives(scene: lacli.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The default engine would be FreeFEM's own language, without a run having told it."""
    found = FreeFem(Path("/usr/bin/FreeFem++"), "4.9", Path("/usr/lib"), None, None, None)
    monkeypatch.setattr("lacli.mechanics.engine.find", lambda: found)
    assert "only the compiled engine has: there is no C++ compiler: sudo apt-get install -y g++" in sequential.lacking(scene)

    def missing() -> FreeFem:
        raise SolverMissingError("no FreeFEM")

    monkeypatch.setattr("lacli.mechanics.engine.find", missing)
    assert sequential.lacking(scene) == ""  # that is another message, of whoever runs something


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"method": "sequential", "sensitivities": False}, "needs a scene whose runs tell derivatives"),
        ({"method": "sequential", "settings": lacli.types.PublishedSettings()}, "its own settings"),
        ({"method": "published", "settings": lacli.types.SequentialSettings()}, "of the sequential method"),
        ({"method": "published", "forecast": True}, "forecast, price and cheap runs are of the sequential method"),
        ({"method": "published", "cheap": ["order=1"]}, "forecast, price and cheap runs"),
        ({"settings": lacli.types.PublishedSettings(prior="flat")}, "--prior flat"),
    ],
)
def test_what_does_not_go_together_is_refused_before_anything_is_written(
    scene: lacli.Scene, tmp_path: Path, given: dict[str, Any], words: str
) -> None:
    with pytest.raises(lacli.LacliError, match=words):
        lacli.calibrate(scene, TARGETS, tmp_path / "c", **given)
    assert not (tmp_path / "c").exists()


def test_a_known_parameter_is_an_input_inside_the_box() -> None:
    known = published._point({"alpha_roof": 2.0}, box())
    assert known[0] == 2.0 and box().contains(known[None]).all()
    for truth, words in (({"alpha": 1.0}, "no input of the box"), ({"edp_mmhg": 40.0}, "edp_mmhg is 40, outside the box")):
        with pytest.raises(lacli.LacliError, match=words):
            published._point(truth, box())


class Stiff(Membranes):
    """Linear cells, say: every feature five standard deviations of its target too small, at a tenth of the cost."""

    def __call__(self, inputs: Any) -> Any:
        for index, done in super().__call__(inputs):
            yield index, Outcome({k: v - 0.5 for k, v in done.outputs.items()}, gradients=done.gradients, cpu_s=0.1)


def test_the_cheapest_numerics_that_leave_the_posterior_where_it_is_are_recommended(
    scene: lacli.Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def simulator(scene: lacli.Scene, *_: Any, **__: Any) -> Membranes:
        return Stiff() if scene.numerics.order == 1 else Membranes()

    monkeypatch.setattr("lacli.calibration.simulator.simulator", simulator)
    save(hollow_cube(), tmp_path / "finer")
    given: dict[str, Any] = {"finer": tmp_path / "finer", "box": box(), "tolerance_sd": 0.5, "store": tmp_path / "runs"}
    found = lacli.tradeoff(scene, TARGETS, figures=True, **given)
    assert isinstance(found, numerics.CalibrationTradeoff) and found.inputs == INPUTS
    assert [e.name for e in found.effects] == [
        "linear, own mesh", "quadratic, own mesh", "linear, finer", "quadratic, finer",
    ]  # fmt: skip
    assert found.recommended is found.effects[1]
    assert np.abs(found.effects[1].shift).max() < 0.01 < 0.5 < np.abs(found.effects[0].shift).max()
    assert found.pictures == (tmp_path / "runs" / numerics.FIGURE,) and found.pictures[0].stat().st_size > 10_000
