"""What a calibration of a study costs at most: by the method that it will use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from shapes import hollow_cube

from lacli.api.cohort import runs_at_most
from lacli.cli.study.cohort import _cost_words
from lacli.cohort.steps import Step
from lacli.contracts.bundle import save


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save(hollow_cube(), tmp_path / "la")
    (tmp_path / "scene.toml").write_text('[anatomy]\nbundle = "elsewhere"\n[numerics]\norder = 1\n')
    return tmp_path / "scene.toml"


def calibration(scene: Path, *more: str) -> Step:
    words = ("calibrate", str(scene), "--set", f"anatomy.bundle={scene.parent / 'la'}", *more)
    return Step("calibrate", words, (scene,), scene.parent / "result.json")


# the published method's default: 200 runs, then four waves of 100
@pytest.mark.parametrize(
    ("given", "runs"),
    [
        ({}, 60),
        ({"max-runs": 24}, 24),
        ({"method": "published"}, 600),
        ({"max-waves": 2}, 300),
        ({"first-runs": 40, "wave-runs": 20, "max-waves": 3}, 80),
        ({"max-waves": 2, "max-runs": 250}, 250),
        ({"sensitivities": False}, 600),
        ({"method": "sequential", "max-runs": 30}, 30),
    ],
)
def test_the_runs_are_those_of_the_method_that_the_options_ask_for(scene: Path, given: dict[str, Any], runs: int) -> None:
    assert runs_at_most(calibration(scene), given) == (runs, 0)


def test_a_scene_that_tells_no_derivatives_is_calibrated_by_waves(scene: Path) -> None:
    scene.write_text(scene.read_text() + 'unloading = "backward"\n')
    assert runs_at_most(calibration(scene), {}) == (600, 0)
    assert runs_at_most(calibration(scene, "--set", "numerics.unloading=prestrain"), {})[0] == 60
    scene.unlink()  # its step will say so
    assert runs_at_most(calibration(scene), {}) == (60, 0)


@pytest.mark.parametrize(
    ("given", "runs"),
    [
        ({}, (60, 12)),
        ({"max-runs": 40, "reference-runs": 8}, (40, 8)),
        ({"cheap": ["none"]}, (60, 0)),
        ({"cheap": "none"}, (60, 0)),
        ({"cheap": ["order=1", "cell_size_mm=6"]}, (60, 12)),
        ({"method": "published"}, (600, 0)),
    ],
)
def test_of_quadratic_cells_a_few_are_the_scene_s_own(scene: Path, given: dict[str, Any], runs: tuple[int, int]) -> None:
    assert runs_at_most(calibration(scene, "--set", "numerics.order=2"), given) == runs


def test_a_study_costs_cheap_runs_and_dear_ones() -> None:
    cost = {
        "calibrations": 10, "runs_each": 60, "cpu_s_per_run": 6.0, "reference_runs_each": 12, "cpu_s_per_reference_run": 60.0,
        "compared": 0, "compared_runs_each": 0,
    }  # fmt: skip
    # by hand: 10 (60 6 + 12 60) s = 3 h
    assert _cost_words(cost).startswith("10 calibrations to do, of at most 60 runs each and 12 of the scene's own")
    assert ": 3 CPU hours at most, at 6 s a run and 60 s one of the scene's own," in _cost_words(cost)
    assert "not known" in _cost_words(cost | {"cpu_s_per_reference_run": None})
    assert _cost_words(cost | {"reference_runs_each": 0, "cpu_s_per_reference_run": None}).endswith(
        "of at most 60 runs each: 1 CPU hours at most, at 6 s a run as in this study so far."
    )
    # and for the comparisons 10 (16 6 + 8 60) s = 1.6 h
    compared = {"compared": 10, "compared_runs_each": 16}
    assert "10 whose models are to be compared, with at most 16 runs more each: 4.6 CPU hours" in _cost_words(cost | compared)
    alone = _cost_words(cost | compared | {"calibrations": 0, "runs_each": 0, "reference_runs_each": 0})
    assert alone.startswith("10 whose models are to be compared") and ": 1.6 CPU hours at most" in alone
    assert _cost_words(cost | {"calibrations": 0}) == "No simulations to make."
