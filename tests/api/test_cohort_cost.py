"""What a calibration of a study costs at most: by the method that it will use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from shapes import hollow_cube

from lacli.api.cohort import runs_at_most
from lacli.cohort.steps import Step
from lacli.contracts.bundle import save


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save(hollow_cube(), tmp_path / "la")
    (tmp_path / "scene.toml").write_text('[anatomy]\nbundle = "elsewhere"\n')
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
    assert runs_at_most(calibration(scene), given) == runs


def test_a_scene_that_tells_no_derivatives_is_calibrated_by_waves(scene: Path) -> None:
    scene.write_text(scene.read_text() + '[numerics]\nunloading = "backward"\n')
    assert runs_at_most(calibration(scene), {}) == 600
    assert runs_at_most(calibration(scene, "--set", "numerics.unloading=prestrain"), {}) == 60
    scene.unlink()  # its step will say so
    assert runs_at_most(calibration(scene), {}) == 60
