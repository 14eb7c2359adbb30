"""What the errors of a tracked motion's frames have in common, by kind of feature."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.anatomy.surface_features import Endocardium
from lacli.motion.errors import uncertainty
from lacli.motion.errors.uncertainty import ErrorModel
from lacli.motion.targets import Course, measured
from lacli.synthetic.atrium import synthesize


def test_what_frames_share_is_told_by_kind() -> None:
    """Errors along the normal that all motions share, tangential ones that none does: all that is seen of n, nothing of a."""
    rng = np.random.default_rng(6)
    keys = ["n_roof_mm", "n_septum_mm", "a_roof_mm", "a_septum_mm"]
    rows = [dict(zip(keys, [0.3, -0.3, *rng.normal(0, 0.3, 2)], strict=True)) for _ in range(2000)]
    between = uncertainty.error_model(rows).between
    assert between == pytest.approx([(0.95 - 0.5) / 1.9**2 + 0.5] * 2 + [0.5 * (1 - 1 / 1.4**2)] * 2, abs=0.02)


def test_targets_share_between_frames_what_their_kind_does() -> None:
    bundle = synthesize(1, volume_ml=40.0, cell_size_mm=8.0, order=1, descent_mm=4.0)[0]
    times = np.arange(8) / 8
    grown = 0.1 * np.sin(np.pi * times)[:, None, None] ** 2 * bundle.points
    course = Course.of(Endocardium.of(bundle), times, grown)
    keys = tuple(course.features[0])
    shared = np.array([0.4 if key.startswith("n") else 0.1 for key in keys])
    found = measured(course, ErrorModel(keys, np.full(len(keys), 0.2), np.eye(len(keys)), shared, 5))
    names = found.targets.names
    for key, b in (("n_roof_mm", 0.4), ("a_roof_mm", 0.1)):
        i, j = names.index(f"{key}@0.25"), names.index(f"{key}@0.75")
        assert found.covariance[i, j] == pytest.approx(b * 0.04, rel=1e-3)
        assert found.covariance[i, i] == pytest.approx(0.04, rel=1e-3)
