"""The error of a tracked mitral annulus, from the motion's file to the targets' covariance."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from shapes import hollow_cube

from lacli.base.errors import LacliError, SceneError
from lacli.base.schema import write_arrays
from lacli.calibration.annulus import annulus_effects, known_share, left_out, with_annulus
from lacli.contracts.bundle import Bundle, save
from lacli.contracts.labels import RINGS
from lacli.contracts.motion import Motion, save_motion
from lacli.contracts.priors import Prior
from lacli.contracts.scene import Scene, build_scene
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.runs import Outcome
from lacli.motion.annulus import ERROR, MOST, asked_motion, known_error

TARGETS = Targets(
    ("b_roof_mm", "esv_ml"), np.array([3.0, 80.0]), np.array([0.5, 4.0]), priors=(Prior("edp_mmhg", "normal", 9.0, 1.0),)
)
BOX = make_box(["edp_mmhg", "alpha_roof"], [4.0, 0.5], [12.0, 1.5])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A bundle whose annulus went 6 mm down at end-systole and was tracked to .9 mm."""
    bundle = _ringed()
    save(bundle, tmp_path)
    ids = np.unique(bundle.triangles[bundle.tags == RINGS["mv"]])
    course = np.array([0.0, 0.5, 1.0, 0.2])[:, None, None] * np.array([0.0, 0.0, -6.0])
    motion = Motion(np.array([0.0, 0.2, 0.4, 0.8]), ids, bundle.points[ids] + course, 0.4)
    save_motion(motion, tmp_path)
    arrays = {f.name: getattr(motion, f.name) for f in dataclasses.fields(motion)}
    write_arrays(tmp_path / "motion.npz", {**arrays, ERROR: 0.9})
    return tmp_path


def _ringed() -> Bundle:
    bundle = hollow_cube()
    tags = bundle.tags.copy()
    tags[np.flatnonzero(tags == 2)[:4]] = RINGS["mv"]
    return dataclasses.replace(bundle, tags=tags)


def _scene(folder: Path, *more: str) -> Scene:
    return build_scene({"anatomy": {"bundle": str(folder)}}, list(more), folder=folder, where="test")


def test_the_annulus_goes_so_many_times_as_far(folder: Path) -> None:
    bundle = _ringed()
    plain = asked_motion(_scene(folder).motion, bundle, folder)
    farther = asked_motion(_scene(folder, "motion.annulus_times=1.5").motion, bundle, folder)
    assert plain is not None and farther is not None
    assert farther.displacement() == pytest.approx(1.5 * plain.displacement())
    assert farther.displacement()[2, :, 2] == pytest.approx(-9.0)
    with pytest.raises(SceneError, match="annulus_times would do nothing"):
        _scene(folder, "motion.annulus_times=1.5", "motion.annulus=none")


def test_the_error_is_a_share_of_the_way_at_end_systole(folder: Path) -> None:
    assert known_error(folder) == pytest.approx(0.9 / 6.0)
    bundle = _ringed()
    ids = np.unique(bundle.triangles[bundle.tags == RINGS["mv"]])
    still = Motion(np.array([0.0, 0.4]), ids, np.repeat(bundle.points[ids][None], 2, axis=0), 0.4)
    save_motion(still, folder)
    assert known_error(folder) is None, "what users write tells no error"
    write_arrays(folder / "motion.npz", {f.name: getattr(still, f.name) for f in dataclasses.fields(still)} | {ERROR: 0.9})
    assert known_error(folder) is None, "of no way there is no share"
    assert 0.0 < MOST < 1.0


class _Stand:
    """Features linear in how far the annulus goes; fails where it is told to."""

    def __init__(self, scene: Scene, fails: bool = False) -> None:
        self.times, self.fails = scene.motion.annulus_times, fails

    def __call__(self, rows: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        assert rows.to_dict("records") == [{"edp_mmhg": 9.0, "alpha_roof": 1.0}], "the prior's mean, the box's middle"
        if self.fails and self.times > 1.0:
            yield 0, Outcome({}, "failed", "newton_limit", message="no equilibrium")
        else:
            yield 0, Outcome({"b_roof_mm": 3.0 - 2.0 * self.times, "esv_ml": 90.0 + 10.0 * self.times})


def test_two_runs_tell_what_one_standard_deviation_changes(folder: Path) -> None:
    def simulator(scene: Scene) -> Any:
        return _Stand(scene)

    effects, words = annulus_effects(_scene(folder), _scene(folder), BOX, TARGETS, simulator)
    assert effects == pytest.approx({"b_roof_mm": -0.3, "esv_ml": 1.5})
    assert "known to 15 % of its way" in words and "b_roof_mm (0.6 standard deviations" in words
    held = with_annulus(TARGETS, effects)
    # .25 + .09, 16 + 2.25, and what both owe to one error
    assert held.covariance == pytest.approx(np.array([[0.34, -0.45], [-0.45, 18.25]]))
    assert held.own_sd == pytest.approx(TARGETS.sd)
    held_still = _scene(folder, "motion.annulus=none")
    assert annulus_effects(held_still, held_still, BOX, TARGETS, simulator) == ({}, "")
    assert with_annulus(TARGETS, {}) is TARGETS


def test_effects_have_no_rounding_of_the_solver(folder: Path) -> None:
    """Runs that agree to the solver's tolerance make one calibration."""

    class Rounded(_Stand):
        def __call__(self, rows: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            for index, outcome in super().__call__(rows):
                yield index, Outcome({name: value * (1 + 3e-12) for name, value in outcome.outputs.items()})

    plain, rounded = (
        annulus_effects(_scene(folder), _scene(folder), BOX, TARGETS, kind)[0]  # type: ignore[arg-type]
        for kind in (_Stand, Rounded)
    )
    assert plain == rounded


def test_a_run_that_the_machine_ended_says_nothing_of_the_scene(folder: Path) -> None:
    class Lost(_Stand):
        def __call__(self, rows: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            yield 0, Outcome({}, "failed", "lost_worker", message="It was lost.")

    with pytest.raises(LacliError, match=r"ended by the machine \(lost_worker\): It was lost. Call again"):
        annulus_effects(_scene(folder), _scene(folder), BOX, TARGETS, Lost)  # type: ignore[arg-type]


def test_what_a_posterior_lacks_is_told(folder: Path) -> None:
    assert known_share(_scene(folder)) == pytest.approx(0.15) and known_share(_scene(folder, "motion.annulus=none")) == 0.0
    assert "known to 15 % of its way, which is not in the posterior" in left_out(0.15)


def test_a_run_that_fails_is_told_and_nothing_is_added(folder: Path) -> None:
    effects, words = annulus_effects(_scene(folder), _scene(folder), BOX, TARGETS, lambda scene: _Stand(scene, True))  # type: ignore[arg-type,return-value]
    assert effects == {} and "not in the posterior" in words and "newton_limit" in words
