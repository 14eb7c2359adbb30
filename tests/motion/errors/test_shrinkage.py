"""Registration finds too little motion: the share is told by known motions and undone, its error kept in the covariance."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.anatomy.surface_features import Endocardium
from lacli.motion.errors.shrinkage import Shrinkage, group_of, shrinkage_of, spread
from lacli.motion.errors.uncertainty import error_model
from lacli.motion.targets import Course, measured, published
from lacli.synthetic.atrium import synthesize

KEYS = ("volume_ml", "d_global_mm", "n_roof_mm", "n_septum_mm", "a_roof_mm")


def test_the_slope_of_errors_on_changes_by_hand() -> None:
    # n: errors -.1, -.2 | -.3, -.2 at changes 1, 2 | 3, 2: slope -(.1 + .4 + .9 + .4) / 18 = -.1; none is left
    changes = np.array([[10.0, 1.0, 1.0, 2.0, 0.0], [20.0, 2.0, 3.0, 2.0, 0.0]])
    errors = np.array([[-1.0, 0.1, -0.1, -0.2, 0.5], [-2.0, -0.2, -0.3, -0.2, 0.5]])
    found = shrinkage_of(KEYS, errors, changes)
    assert found.share[[0, 2, 3]] == pytest.approx(-0.1)
    assert found.sd[[0, 2, 3]] == pytest.approx(0.05), "no error of its own, half of it for what known motions do not tell"
    # d_global: slope (.1 - .4) / 5 = -.06; e - s v = .16, -.08; by motion .16, -.16, one of two motions given for the slope;
    # sd^2 = 2 (2 x .16^2) / 25 + .03^2
    assert found.share[1] == pytest.approx(-0.06)
    assert found.sd[1] == pytest.approx(np.sqrt(2 * 2 * 0.16**2 / 25 + 0.03**2))
    assert (found.share[4], found.sd[4]) == (0.0, 0.0), "what never changes tells no share"


def test_a_share_that_is_no_shrinkage_is_bounded_and_said_to_be_unsure() -> None:
    found = shrinkage_of(("n_roof_mm",), np.array([[-0.4], [-0.8]]), np.array([[1.0], [2.0]]))
    assert found.share[0] == pytest.approx(-0.15)
    assert found.sd[0] == pytest.approx(np.hypot(0.2, 0.25))


def test_undone_changes_are_what_was_true() -> None:
    found = Shrinkage(KEYS, np.array([-0.03, -0.02, -0.1, -0.1, 0.0]), np.full(5, 0.01))
    ed = {"volume_ml": 60.0, "n_roof_mm": 0.0, "other": 1.0}
    shrunk = {"volume_ml": 60.0 + 40.0 * 0.97, "n_roof_mm": 5.0 * 0.9, "other": 2.0}
    assert found.undone(shrunk, ed) == pytest.approx({"volume_ml": 100.0, "n_roof_mm": 5.0, "other": 2.0})


def test_one_share_s_error_moves_its_targets_together() -> None:
    found = Shrinkage(KEYS, np.zeros(5), np.array([0.01, 0.02, 0.01, 0.01, 0.03]))
    keys = ("volume_ml", "n_roof_mm", "d_global_mm", "n_roof_mm")
    covariance = found.covariance(keys, np.array([40.0, 5.0, 6.0, 10.0]))
    moved = np.array([0.4, 0.05, 0.12, 0.1])
    together = np.array([[1, 1, 0, 1], [1, 1, 0, 1], [0, 0, 1, 0], [1, 1, 0, 1]])
    assert covariance == pytest.approx(np.outer(moved, moved) * together)
    shrunk = Shrinkage(KEYS, np.full(5, -0.1), found.sd)
    # the derivative of v / (1 + s) by s, at the corrected v / (1 + s)
    assert shrunk.covariance(keys, np.array([40.0, 5.0, 6.0, 10.0])) == pytest.approx(covariance / 0.81)
    assert group_of("volume_ml") == group_of("n_roof_mm") != group_of("d_global_mm") == group_of("d_roof_mm")


def test_a_region_that_loses_more_than_others_is_an_error_of_its_own_in_all_frames() -> None:
    keys = ("n_roof_mm", "n_septum_mm")
    # the roof loses a tenth in every motion, the septum nothing: 5 % together, and .1 / sqrt(2) apart
    changes = np.array([[2.0, 2.0], [4.0, 4.0], [3.0, 3.0]])
    found = shrinkage_of(keys, changes * [-0.1, 0.0], changes)
    assert found.share == pytest.approx([-0.05, -0.05])
    assert found.regional == pytest.approx([0.1 / np.sqrt(2.0)] * 2)
    covariance = found.covariance(("n_roof_mm", "n_roof_mm", "n_septum_mm"), np.array([2.0, 4.0, 4.0]))
    shared = found.sd[0] ** 2 * np.outer([2, 4, 4], [2, 4, 4])
    own = 0.005 * np.array([[4, 8, 0], [8, 16, 0], [0, 0, 16]])
    assert covariance == pytest.approx((shared + own) / 0.95**2)
    # as much as the slopes' own errors make is none between regions
    rng = np.random.default_rng(2)
    apart = [shrinkage_of(keys, 0.1 * rng.normal(size=(5, 2)), rng.uniform(2, 4, (5, 2))).regional for _ in range(300)]
    assert np.mean(np.square(apart)) < 2.5e-4
    assert spread("n_roof_mm", 0.3, np.array([4.0]), {"n": {"share": 0.0, "sd": 0.0, "regional": 0.1}}) == pytest.approx([0.5])


def test_a_band_widens_with_the_change() -> None:
    stated = {"volume": {"share": -0.03, "sd": 0.01}}
    # noise and share are of what was tracked, 3 % too little
    assert spread("volume_ml", 0.3, np.array([0.0, 40.0]), stated) == pytest.approx([0.3 / 0.97, 0.5 / 0.97])
    assert spread("volume_ml", 0.3, np.array([40.0]), None) == pytest.approx([0.3])


@pytest.mark.parametrize("motions", [2, 5])
def test_stated_errors_are_those_made_however_few_motions_tell_them(motions: int) -> None:
    """Over many patients, a new motion's error after its share is undone against what is stated of it, in the mean square."""
    rng = np.random.default_rng(4)
    keys = ("volume_ml", "d_global_mm")
    made, stated = np.zeros(2), np.zeros(2)
    for _ in range(1200):
        change = rng.uniform(5.0, 15.0, (motions + 1, 2))
        error = rng.normal(size=change.shape)
        rows, changes = ([dict(zip(keys, row, strict=True)) for row in of[:-1]] for of in (error, change))
        model = error_model(rows, changes)
        shrinkage = model.shrinkage
        assert shrinkage is not None
        undoing = 1.0 / (1.0 + shrinkage.share)
        made += ((change[-1] + error[-1]) * undoing - change[-1]) ** 2
        # of the share's sd, what is for known motions being easier is not at issue here: no share is true
        sampled = np.maximum(shrinkage.sd**2 - (0.5 * shrinkage.share) ** 2, 0.0)
        stated += ((model.sd * undoing) ** 2) + sampled * (change[-1] * undoing) ** 2
    assert stated / made == pytest.approx([1.0, 1.0], rel=0.12)


def test_targets_are_free_of_it_and_the_published_seven_as_tracked() -> None:
    bundle, _ = synthesize(1, None, cell_size_mm=9.0)
    surface = Endocardium.of(bundle)
    times = np.arange(10) / 10
    grown = 0.05 * np.sin(np.pi * times)[:, None, None] ** 2 * bundle.points
    raw = Course.of(surface, times, grown)
    keys = tuple(raw.features[0])
    rng = np.random.default_rng(0)
    changes = [{key: raw.features[i][key] - raw.features[0][key] for key in keys} for i in range(1, 10)]
    errors = [{key: -0.03 * change + 1e-3 * rng.normal() for key, change in row.items()} for row in changes]
    model = error_model(errors, changes)
    assert model.shrinkage is not None
    assert (model.sd < 2e-3).all(), "what goes with the change is no noise"
    course = raw.restored(model.shrinkage)
    es = course.phases.es
    before, after = raw.tracked_at(es), course.features_at(es)
    assert after["volume_ml"] - raw.features[0]["volume_ml"] == pytest.approx(
        (before["volume_ml"] - raw.features[0]["volume_ml"]) / 0.97, rel=2e-3
    )
    assert course.features_at(0.0) == pytest.approx(raw.features[0], abs=1e-9), "end-diastole stays"
    assert course.phases.es_volume_ml == pytest.approx(after["volume_ml"], rel=1e-3)
    found = measured(course, model)
    at = found.targets.names.index("esv_ml")
    assert found.targets.mean[at] == pytest.approx(after["volume_ml"])
    # half of 3 % of the change, and next to nothing else
    assert found.targets.sd[at] == pytest.approx(0.015 * (after["volume_ml"] - course.features[0]["volume_ml"]), rel=0.05)
    assert np.linalg.eigvalsh(found.covariance).min() > 0
    seven = published(course, dict.fromkeys(("global", "roof", "septum", "lateral", "anterior", "posterior"), 0.2))
    assert seven.targets.mean[0] == pytest.approx(before["volume_ml"])
