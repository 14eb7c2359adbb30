"""The error of a tracked mitral annulus, from the motion's file to the targets' covariance."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from shapes import hollow_cube

from lacli.base.errors import InputError, LacliError, SceneError
from lacli.base.schema import write_arrays
from lacli.calibration.annulus import annulus_effects, known_share, left_out, with_annulus
from lacli.contracts.bundle import Bundle, save
from lacli.contracts.labels import RINGS
from lacli.contracts.motion import Motion, save_motion
from lacli.contracts.priors import Prior
from lacli.contracts.scene import Scene, build_scene
from lacli.contracts.sections import ANNULUS_MODES
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.runs import Outcome
from lacli.motion.annulus import ERROR, MOST, asked_motion, known_error, off_modes

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
    assert known_error(folder) == pytest.approx((0.9, 0.9 / 6.0))
    bundle = _ringed()
    ids = np.unique(bundle.triangles[bundle.tags == RINGS["mv"]])
    still = Motion(np.array([0.0, 0.4]), ids, np.repeat(bundle.points[ids][None], 2, axis=0), 0.4)
    save_motion(still, folder)
    assert known_error(folder) is None, "what users write tells no error"
    write_arrays(folder / "motion.npz", {f.name: getattr(still, f.name) for f in dataclasses.fields(still)} | {ERROR: 0.9})
    assert known_error(folder) is None, "of no way there is no share"
    assert 0.0 < MOST < 1.0


def test_the_annulus_errs_in_six_ways_of_length_one(folder: Path) -> None:
    motion = asked_motion(_scene(folder).motion, _ringed(), folder)
    assert motion is not None
    modes = off_modes(motion)
    assert modes.shape == (ANNULUS_MODES, 4, len(motion.wall_point), 3)
    assert np.sqrt((modes[:, 2] ** 2).sum(axis=2).mean(axis=1)) == pytest.approx(np.ones(6))
    assert modes[:, [0, 1, 3]] == pytest.approx(modes[:, [2]] * np.array([0.0, 0.5, 0.2])[None, :, None, None]), "with the way"
    along, aside, across, tilt, other, wider = modes[:, 2]
    assert along == pytest.approx(np.tile([0.0, 0.0, -1.0], (len(along), 1))), "down, as it went"
    for field in (aside, across):
        assert np.ptp(field, axis=0) == pytest.approx(0.0, abs=1e-12) and field[:, 2] == pytest.approx(0.0, abs=1e-9)
    for field in (tilt, other):
        assert field[:, :2] == pytest.approx(0.0, abs=1e-12) and field.mean(axis=0) == pytest.approx(0.0, abs=1e-9)
    arms = motion.positions[0] - motion.positions[0].mean(axis=0)
    assert (wider * arms).sum() > 0.0 and wider[:, 2] == pytest.approx(0.0, abs=1e-12)
    # no way is a mixture of others: a ring's own error is told apart
    flat = modes[:, 2].reshape(ANNULUS_MODES, -1)
    assert np.linalg.matrix_rank(flat @ flat.T, tol=1e-6) == ANNULUS_MODES


def test_a_scene_s_annulus_is_off_by_what_it_says(folder: Path) -> None:
    bundle = _ringed()
    plain = asked_motion(_scene(folder).motion, bundle, folder)
    off = asked_motion(_scene(folder, "motion.annulus_off_mm=[2, 0, 0, 0, 0, 0.5]").motion, bundle, folder)
    assert plain is not None and off is not None
    wider = 0.5 * off_modes(plain)[5, 2]
    assert off.displacement()[2] - plain.displacement()[2] == pytest.approx(np.array([0.0, 0.0, -2.0]) + wider)
    assert off.positions[0] == pytest.approx(plain.positions[0])
    for words, value in (("six lengths", "[1, 2]"), ("six lengths", "[99, 0, 0, 0, 0, 0]")):
        with pytest.raises(SceneError, match=words):
            _scene(folder, f"motion.annulus_off_mm={value}")
    with pytest.raises(SceneError, match="annulus_off_mm would do nothing"):
        _scene(folder, "motion.annulus_off_mm=[1, 0, 0, 0, 0, 0]", "motion.annulus=none")
    still = dataclasses.replace(plain, positions=np.repeat(plain.positions[:1], 4, axis=0))
    with pytest.raises(InputError, match="does not move"):
        off_modes(still)


class _Stand:
    """Features linear in how far the annulus goes and how wide it is; fails where it is told to."""

    def __init__(self, scene: Scene, fails: bool = False) -> None:
        self.off, self.fails = np.array(scene.motion.annulus_off_mm or [0.0] * ANNULUS_MODES), fails

    def __call__(self, rows: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        assert rows.to_dict("records") == [{"edp_mmhg": 9.0, "alpha_roof": 1.0}], "the prior's mean, the box's middle"
        if self.fails and self.off.any():
            yield 0, Outcome({}, "failed", "newton_limit", message="no equilibrium")
        else:
            along, wider = self.off[0] * math.sqrt(6.0), self.off[5] * math.sqrt(6.0)
            yield 0, Outcome({"b_roof_mm": 3.0 - along / 3.0, "esv_ml": 90.0 + along * 5.0 / 3.0 + 2.0 * wider})


def test_a_run_for_each_way_tells_what_one_standard_deviation_changes(folder: Path) -> None:
    def simulator(scene: Scene) -> Any:
        return _Stand(scene)

    heard: list[tuple[int, int]] = []
    effects, words = annulus_effects(
        _scene(folder), _scene(folder), BOX, TARGETS, simulator, lambda done, total: heard.append((done, total))
    )
    assert heard == [(done, 7) for done in range(1, 8)]
    # .9 mm of a point are shared by six ways, .9 / 6^.5 mm each
    assert effects["b_roof_mm"] == pytest.approx([-0.3, 0, 0, 0, 0, 0])
    assert effects["esv_ml"] == pytest.approx([1.5, 0, 0, 0, 0, 1.8])
    assert "known to 0.9 mm, 15 % of its way" in words and "b_roof_mm (0.6 sd of its own" in words
    held = with_annulus(TARGETS, effects)
    # .25 + .09, 16 + 2.25 + 3.24, and what both owe to one way
    assert held.covariance == pytest.approx(np.array([[0.34, -0.45], [-0.45, 21.49]]))
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
