"""A motion's stated error: all features of a region err by the region's one shift."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.anatomy.surface_features import Endocardium
from lacli.motion.errors.stated import stated_model
from lacli.motion.targets import Course, measured
from lacli.synthetic.atrium import synthesize


def test_features_of_one_shift_go_together() -> None:
    bundle = synthesize(1, volume_ml=40.0, cell_size_mm=8.0, order=1, descent_mm=4.0)[0]
    surface = Endocardium.of(bundle)
    times = np.arange(6) / 6
    # every point goes out along its own radius: a region's displacement is nearly its normal component
    radius = bundle.points - bundle.points.mean(axis=0)
    course = Course.of(surface, times, 0.1 * np.sin(np.pi * times)[:, None, None] ** 2 * radius)
    model = stated_model(bundle, course, 0.3, 0.3)
    place = {key: number for number, key in enumerate(model.keys)}

    def between(one: str, other: str) -> float:
        return float(model.correlation[place[one], place[other]])

    assert between("d_roof_mm", "n_roof_mm") > 0.6, "the wall that stands too far out has moved too far"
    assert between("volume_ml", "n_roof_mm") > 0.1 and between("volume_ml", "n_lateral_mm") > 0.1
    assert abs(between("n_roof_mm", "n_septum_mm")) < 0.3, "regions shift by themselves, but for the border that they share"
    # five regions of n sum to the volume, but for the tenth that is each one's own
    n = [f"n_{region}_mm" for region in ("anterior", "posterior", "septum", "lateral", "roof")]
    assert sum(between("volume_ml", key) ** 2 for key in n) == pytest.approx(0.81, abs=0.25)
    assert np.diag(model.correlation) == pytest.approx(np.ones(len(model.keys)))
    assert np.linalg.eigvalsh(model.correlation).min() > 0.0999
    np.linalg.cholesky(measured(course, model).covariance)
