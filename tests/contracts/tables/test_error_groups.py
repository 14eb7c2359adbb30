"""Pairs of features in groups, and correlations learnt by group."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.contracts.tables.error_groups import Groups, normalised

NAMES = ["d_roof_mm", "d_septum_mm", "esv_ml", "volume_ml@0.2", "odd"]


def test_pairs_are_grouped_by_kind_region_and_time() -> None:
    groups = Groups.of_features(NAMES)

    def named(i: int, j: int, of: Groups = groups) -> str:
        return of.names[of.of[i, j]]

    assert named(0, 1) == named(1, 0) == "d d, two regions, one time"
    assert named(2, 3) == "volume volume, one region, two times"
    assert named(0, 2) == "d volume, two regions, one time"
    assert named(0, 2, Groups.of_features(NAMES, whole_with_all=True)) == "d volume, one region, one time"
    assert named(4, 2) == "odd volume, one region, two times"


def test_means_become_correlations() -> None:
    groups = Groups.of_features(NAMES[:3])
    product = np.array([[9.0, 0.4, 0.2], [0.4, 9.0, 0.6], [0.2, 0.6, 9.0]])
    means = groups.means(product)
    assert means == {"d d, two regions, one time": pytest.approx(0.4), "d volume, two regions, one time": pytest.approx(0.4)}
    found = groups.correlation(means, 0.5, np.array([1.0, -1.0, 1.0]))
    assert found == pytest.approx(np.array([[1.0, -0.2, 0.2], [-0.2, 1.0, -0.2], [0.2, -0.2, 1.0]]))
    # twice as large as stated, and all alike: sizes do not count
    assert normalised([(groups, np.array([2.0, 2.0, 4.0]))]) == {name: pytest.approx(0.98) for name in means}
