"""The most probable point held against the targets: misfits, contradictions, ends of ranges, in words."""

import numpy as np
import pytest

from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.sampling.verdict import judge

BOX = make_box(["a", "b"], [0.0, 0.0], [10.0, 10.0])


class Exact:
    """f = a, g = a + b, each with an emulator's variance of 0.09."""

    def predict_truth(self, x):
        return np.c_[x[:, 0], x.sum(1)], np.full((len(x), 2), 0.09)


def verdict(mean, x, sd=(0.4, 0.4), draws=None, threshold=3.0):
    return judge(Exact(), Targets(("f_mm", "g_mm"), np.array(mean), np.array(sd)), BOX, np.array(x), threshold, draws)


def test_a_point_that_fits_has_nothing_to_say():
    found = verdict([3.0, 7.0], [3.0, 4.0])
    assert found.plausible and found.warnings() == [] and found.document()["warnings"] == []
    assert found.sd == pytest.approx([0.3, 0.3]) and found.implausibility == pytest.approx([0.0, 0.0])


def test_a_misfit_is_in_standard_deviations_of_both():
    """4 - 3 = 1 over sqrt(0.4^2 + 0.3^2) = 0.5: 2."""
    found = verdict([3.0, 8.0], [4.0, 4.0])
    assert found.implausibility == pytest.approx([2.0, 0.0]) and found.plausible
    assert not verdict([3.0, 8.0], [4.0, 4.0], threshold=2.0).plausible


def test_a_target_out_of_reach_is_told_from_one_that_is_only_missed():
    told = verdict([15.0, 7.0], [10.0, 0.0]).warnings()
    assert told[0].startswith(
        "no point of the box reaches f_mm: 10 where the target is 15 ± 0.4 (implausibility 10, threshold 3)"
    )
    missed = verdict([5.0, 7.0], [10.0, 0.0]).warnings()
    assert missed[0].startswith("the most probable point misses f_mm") and "contradict" in missed[2]


def test_targets_that_are_reached_alone_but_not_together_contradict():
    """f = 8 and g = 2 want b = -6; each alone is reached."""
    found = verdict([8.0, 2.0], [5.0, 0.0])
    assert found.reachable == (True, True) and not found.plausible
    assert any("each target alone is reached in the box, all together are not" in text for text in found.warnings())


@pytest.mark.parametrize(("x", "gathered", "ends"), [
    ([9.99, 5.0], 9.9, {"a": "upper"}), ([5.0, 0.01], 0.1, {"b": "lower"}), ([5.0, 5.0], 5.0, {}),
])  # fmt: skip
def test_an_input_at_an_end_is_named_where_the_draws_gather_there(x, gathered, ends):
    rng = np.random.default_rng(0)
    draws = np.c_[rng.uniform(4, 6, 500), rng.uniform(4, 6, 500)]
    for i, value in enumerate(x):
        if value in (9.99, 0.01):
            draws[:, i] = gathered + 0.01 * rng.standard_normal(500)
    found = verdict([x[0], sum(x)], x, draws=draws)
    assert found.at_end == ends
    assert bool(ends) == any("may lie outside the box" in text for text in found.warnings())


def test_a_flat_posterior_has_its_maximum_anywhere():
    draws = np.random.default_rng(1).uniform(0, 10, (2000, 2))
    assert verdict([9.99, 14.99], [9.99, 5.0], draws=draws).at_end == {}
