"""The synthetic CT's wall is as thick as its truth says."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.synthetic.walled import LA, LV, MUSCLE, walled


def test_truth_and_image_agree() -> None:
    made = walled(1, (2.0, 2.0), (1.6, 1.6, 1.6), noise_hu=0.0)
    free = made.body & ~made.touching
    # the shape's measure is a distance within 5 % on most of the wall, and short of it where vessels blend
    assert np.percentile(made.thickness[free], [1, 50]) == pytest.approx([2.0, 2.0], abs=0.1)
    assert 0.005 < made.touching[made.body].mean() < 0.1
    assert {0, LA, LV, MUSCLE} == set(np.unique(made.rough.array).tolist())

    def value(away: float) -> np.ndarray:
        index = np.round(made.ct.to_index(made.points[free] + away * made.normal[free])).astype(int)
        return made.ct.array[index[:, 2], index[:, 1], index[:, 0]]

    # blood 350, muscle 100, fat and lung below 0: two voxels inside, mid-wall, two outside
    assert np.median(value(-4.0)) == pytest.approx(350.0, abs=3.0)
    assert 60.0 < np.median(value(1.0)) < 200.0
    assert np.median(value(6.0)) < -30.0


def test_without_neighbours_only_the_atrium_touches_itself() -> None:
    alone = walled(1, (2.0, 2.0), (2.4, 2.4, 2.4), neighbours=False)
    beside = walled(1, (2.0, 2.0), (2.4, 2.4, 2.4))
    assert alone.touching[alone.body].sum() < 0.5 * beside.touching[beside.body].sum()
