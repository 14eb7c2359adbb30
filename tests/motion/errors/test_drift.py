"""A cycle's drift that is spread over it: its own error is in the frames' from then on."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from shapes import hollow_cube

from lacli.anatomy.surface_features import Endocardium
from lacli.motion.errors.courses import course as course_of
from lacli.motion.errors.drift import frame_errors, widened
from lacli.motion.errors.uncertainty import ErrorModel
from lacli.motion.targets import Course, measured

TIMES = np.array([0.0, 0.25, 0.5, 0.75])


@pytest.mark.parametrize("between", [0.0, 0.4])
def test_corrected_frames_have_the_covariance_of_the_errors_that_are_made(between: float) -> None:
    rng = np.random.default_rng(3)
    # errors of three frames and of the last, which is end-diastole again, a part shared by all
    made = np.sqrt(between) * rng.normal(size=(200_000, 1)) + np.sqrt(1 - between) * rng.normal(size=(200_000, 4))
    left = made[:, :3] - TIMES[1:] * made[:, 3:]
    shared, own = frame_errors(TIMES[1:], True)
    assert between * np.outer(shared, shared) + (1 - between) * own == pytest.approx(np.cov(left.T), abs=0.02)


def test_targets_of_a_corrected_cycle_err_by_more_and_go_together() -> None:
    bundle = hollow_cube()
    grown = 0.1 * np.sin(np.pi * TIMES)[:, None, None] ** 2 * bundle.points
    surface = Endocardium.of(bundle)
    keys = tuple(surface.features(surface.ed))
    model = ErrorModel(keys, np.full(len(keys), 0.2), np.eye(len(keys)), 0.0, 5)
    covariance = {}
    for closed in (False, True):
        found = measured(Course.of(surface, TIMES, grown, closed), model)
        one, other = (found.targets.names.index(f"d_global_mm@{t}") for t in (0.25, 0.75))
        covariance[closed] = found.covariance[np.ix_([one, other], [one, other])]
    assert covariance[False] == pytest.approx(0.04 * np.eye(2), rel=1e-3)
    t = np.array([0.25, 0.75])
    assert covariance[True] == pytest.approx(0.04 * (np.eye(2) + np.outer(t, t)), rel=1e-3)


def test_a_band_is_wider_where_a_drift_was_corrected() -> None:
    frame = pd.DataFrame({"time": TIMES, "n_roof_mm": [0.0, 2.0, 4.0, 2.0]})
    sd = [course_of(frame, {"sd": {"n_roof_mm": 0.2}, "closure_mm": c}, "n_roof_mm", np.array([0.5]))[1] for c in (None, 0.3)]
    assert sd[0] == pytest.approx([0.2]) and sd[1] == pytest.approx([0.2 * np.sqrt(1.25)])
    assert widened(np.array([0.5]), False) == pytest.approx([1.0])
