"""Tables of runs: rows are paired by what they say, and what cannot be learnt from is refused or said."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.base.errors import TableError
from lacli.contracts.tables.checks import check_inputs, check_sizes, distances, stray_outputs
from lacli.contracts.tables.pairing import check_shared_columns, pair

RNG = np.random.default_rng(8)


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(7)), st.integers(0, 7))
def test_rows_in_any_order_are_paired_by_their_label(order: list[int], kept: int) -> None:
    inputs = pd.DataFrame({"run_id": [f"r{i}" for i in range(7)], "a": np.arange(7.0)})
    outputs = pd.DataFrame({"run_id": [f"r{i}" for i in order], "y": [10.0 * i for i in order]}).iloc[: max(kept, 1)]
    x, y, notes = pair(inputs, outputs, "t")
    assert (y["y"].to_numpy() == 10.0 * x["a"].to_numpy()).all()
    assert len(x) == max(kept, 1)
    assert any("without outputs" in note for note in notes) == (max(kept, 1) < 7)


def test_labels_that_cannot_pair_are_refused() -> None:
    a = pd.DataFrame({"run_id": [1, 2, 2], "a": [1.0, 2, 3]})
    b = pd.DataFrame({"run_id": [2, 1, 2], "y": [1.0, 2, 3]})
    with pytest.raises(TableError, match="the inputs have 2 more than once"):
        pair(a, b, "t")
    with pytest.raises(TableError, match="no run is in both tables"):
        pair(a.iloc[:2], b.assign(run_id=[7, 8, 9]), "t")
    with pytest.raises(TableError, match="2 rows of inputs but 3 rows of outputs"):
        pair(a[["a"]].iloc[:2], b[["y"]], "t")
    same = pd.DataFrame({"run_id": ["007", "8"], "a": [1.0, 2]})
    _, y, notes = pair(same, pd.DataFrame({"run_id": [7.0, 8.0], "y": [1.0, 2]}), "t")
    assert notes == [] and y["y"].tolist() == [1.0, 2.0], "7, 7.0 and 007 are one label"


def test_a_column_in_both_tables_says_the_same() -> None:
    a, b = pd.DataFrame({"a": [1.0, 2.0]}), pd.DataFrame({"a": [1.0, 2.5]})
    check_shared_columns(a, a * (1 + 1e-9), "t")
    with pytest.raises(TableError, match=r"a is 2 in the inputs and 2.5 in the outputs, row 2 \(1 such rows\)"):
        check_shared_columns(a, b, "t")


def test_inputs_that_depend_on_each_other_are_named() -> None:
    x = RNG.random((40, 3))
    notes: list[str] = []
    check_inputs(("a", "b", "c"), x, "t", notes)
    assert notes == []
    with pytest.raises(TableError, match="inputs a and b are linearly dependent"):
        check_inputs(("a", "b", "c"), np.column_stack([x[:, 0], 2 * x[:, 0] + 1, x[:, 2]]), "t", notes)
    with pytest.raises(TableError, match="inputs a, b and c are linearly dependent"):
        check_inputs(("a", "b", "c"), np.column_stack([x[:, :2], x[:, 0] - 2 * x[:, 1]]), "t", notes)
    with pytest.raises(TableError, match="their logarithms linearly"):
        z = np.exp(3.0 * x[:, :2])
        check_inputs(("a", "b", "c"), np.column_stack([z, z[:, 0] * z[:, 1]]), "t", notes)
    check_inputs(("n", "b"), np.column_stack([np.arange(1.0, 41.0), x[:, 0]]), "t", notes)
    assert any("input n counts the rows" in note for note in notes)


def test_a_mark_of_failure_is_no_value_and_a_far_one_is_said() -> None:
    y = np.column_stack([RNG.normal(90.0, 5.0, 30), RNG.normal(5.0, 1.0, 30)])
    notes: list[str] = []
    assert not stray_outputs(("v", "d"), y, range(30), notes).any() and notes == []
    y[4, 0], y[7, 1] = -1e6, 5.0 + 200 * np.subtract(*np.quantile(y[:, 1], [0.75, 0.25]))
    stray = stray_outputs(("v", "d"), y, range(30), notes)
    assert np.flatnonzero(stray).tolist() == [4]
    assert "output v is -1e+06 in row 5" in notes[0] and "output d is" in notes[1] and "row 8" in notes[1]
    assert distances(np.array([[1.0], [2.0], [3.0], [4.0], [5.0]]))[:, 0] == pytest.approx([1.0, 0.5, 0.0, 0.5, 1.0])


def test_what_is_too_large_or_small_to_calculate_with_names_its_row() -> None:
    check_sizes(("a",), np.array([[1e99], [np.nan]]), "input")
    with pytest.raises(TableError, match=r"input a is 1e\+101 in row 2: too large"):
        check_sizes(("a",), np.array([[1.0], [1e101]]), "input")
    with pytest.raises(TableError, match="input a is nowhere above 1e-100: too small"):
        check_sizes(("a",), np.array([[1e-120], [0.0]]), "input")
