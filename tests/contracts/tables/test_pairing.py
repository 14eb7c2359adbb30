"""Two tables of the same runs: paired by what labels them, never wrongly by position."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.base.errors import TableError
from lacli.contracts.tables.pairing import check_shared_columns, pair

X = pd.DataFrame({"run_id": [1, 2, 3], "alpha": [0.1, 0.2, 0.3]})


@given(st.permutations(list(range(12))), st.sets(st.integers(0, 11), max_size=6))
def test_any_order_and_any_rows_left_out_pair_rightly(order: list[int], gone: set[int]) -> None:
    x = pd.DataFrame({"run_id": range(12), "alpha": np.arange(12) / 10})
    y = pd.DataFrame({"run_id": [i for i in order if i not in gone]})
    y["esv_ml"] = 100.0 + y["run_id"]
    inputs, outputs, notes = pair(x, y, "here")
    assert len(inputs) == 12 - len(gone)
    assert (outputs["esv_ml"].to_numpy() == 100 + 10 * inputs["alpha"].to_numpy()).all()
    assert any("left out" in note for note in notes) == bool(gone)


def test_three_spellings_of_one_number_are_one_label() -> None:
    y = pd.DataFrame({"Run_ID": ["003", "1.0", "2"], "esv_ml": [3.0, 1.0, 2.0]})
    inputs, outputs, notes = pair(X, y, "here")
    assert outputs["esv_ml"].tolist() == [1.0, 2.0, 3.0] and inputs["alpha"].tolist() == [0.1, 0.2, 0.3]
    assert notes == ["runs are paired by run_id: the tables have them in another order or number."]


def test_without_labels_rows_belong_together_by_their_place() -> None:
    x, y = X[["alpha"]], pd.DataFrame({"esv_ml": [1.0, 2.0, 3.0]})
    assert pair(x, y, "here")[2] == []
    with pytest.raises(TableError, match=r"here: 3 rows of inputs but 2 rows of outputs.*run_id"):
        pair(x, y[:2], "here")


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        ([1, 1, 2], "from row 2 on, and cannot pair them: the outputs have 1 more than once"),
        ([7, 8, 9], "no run is in both tables: run_id 1, ... in one, 7, ... in the other"),
        ([1, None, 3], "labels the runs but is empty in row 2"),
    ],
)
def test_labels_that_pair_nothing_or_twice(labels: list[int | None], words: str) -> None:
    with pytest.raises(TableError, match=words.replace("(", r"\(")):
        pair(X, pd.DataFrame({"run_id": labels, "esv_ml": [1.0, 2, 3]}), "here")


def test_the_same_labels_under_two_names_in_another_order() -> None:
    with pytest.raises(TableError, match="run_id of the inputs and id of the outputs hold the same labels, in another order"):
        pair(X, pd.DataFrame({"id": [3, 2, 1], "esv_ml": [1.0, 2, 3]}), "here")


def test_a_number_that_both_tables_have_must_be_the_same() -> None:
    y = pd.DataFrame({"alpha": [0.1, 0.2, 0.31]})
    with pytest.raises(TableError, match=r"here: alpha is 0.3 in the inputs and 0.31 in the outputs, row 3 \(1 such rows\)"):
        check_shared_columns(X, y, "here")
    check_shared_columns(X, pd.DataFrame({"alpha": [0.1, 0.2, 0.3 * (1 + 1e-9)], "run_id": [9, 9, 9]}), "here")
