"""Where runs have been: what is extrapolation is told, what is not is not."""

import numpy as np
import pytest

from lacli.base.errors import UsageError
from lacli.inference.box import make_box
from lacli.inference.design import design
from lacli.inference.sampling.coverage import check_coverage, coverage, unvisited

UNIT = make_box(["a", "b"], [0.0, 0.0], [1.0, 1.0])
RUNS = design(UNIT, 256, seed=1)


def test_a_design_covers_its_own_box():
    found = coverage(UNIT, RUNS)
    assert found.share == 0.0 and found.beyond == () and found.words() == ""


@pytest.mark.parametrize("d", [1, 3, 9])
@pytest.mark.parametrize("runs", [20, 60, 400])
def test_even_runs_are_not_said_to_leave_holes(d, runs):
    box = make_box([f"x{i}" for i in range(d)], [0.0] * d, [1.0] * d)
    assert coverage(box, design(box, runs, "lhs", seed=3)).words() == ""


@pytest.mark.parametrize(("upper", "out"), [(2.0, 0.49), (1.5, 0.32), (1.01, 0.0)])
def test_what_is_beyond_the_runs_is_measured_and_named(upper, out):
    """Runs reach 1.00, and 2 % of their range count as theirs: (upper - 1.02) / upper of the box is extrapolation."""
    found = coverage(make_box(["a", "b"], [0.0, 0.0], [1.0, upper]), RUNS)
    assert found.share == pytest.approx(out, abs=0.01)
    if out:
        words = found.words()
        assert f"{found.share:.1%} of the box" in words and "b: runs 0.0" in words and f"box 0 to {upper:g}" in words
        assert "a: runs" not in words


def test_a_gap_within_the_range_is_seen():
    runs = RUNS[(RUNS[:, 0] < 0.3) | (RUNS[:, 0] > 0.7)]
    found = coverage(UNIT, runs)
    # 154 runs: 7 parts of the range, of which the middle one, 3/7 to 4/7, is wholly in the gap
    assert (
        len(runs) == 154 and found.share == pytest.approx(1 / 7, abs=0.003) and "a part within the runs' range" in found.words()
    )
    middle = np.array([[0.5, 0.5], [0.1, 0.9]])
    assert unvisited(middle, runs).tolist() == [True, False]


def test_an_empty_corner_of_two_inputs_is_seen():
    runs = design(UNIT, 600, seed=2)
    runs = runs[(runs[:, 0] < 0.5) | (runs[:, 1] < 0.5)]
    assert unvisited(np.array([[0.9, 0.9], [0.9, 0.1], [0.1, 0.9]]), runs).tolist() == [True, False, False]


def test_runs_that_are_even_in_the_logarithm_leave_no_hole():
    box = make_box(["a"], [1.0], [1000.0])
    runs = np.exp(design(make_box(["a"], [0.0], [np.log(1000.0)]), 200, seed=4))
    assert coverage(box, runs).share == 0.0


def test_nearly_all_extrapolation_is_refused():
    wide = make_box(["a", "b"], [-50.0, -50.0], [50.0, 50.0])
    with pytest.raises(UsageError, match=r"of the box is where no run has been.*Narrow the box.* Or give --box"):
        check_coverage(wide, RUNS, remedy=" Or give --box.")
    inside = np.full((5, 2), 0.5)
    assert check_coverage(wide, RUNS, inside).share == 0.0  # only the points asked of count
