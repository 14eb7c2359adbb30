"""Whether runs can be learnt from: strays, counters, and inputs that tell one another."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.base.errors import TableError
from lacli.contracts.tables.checks import check_inputs, check_sizes, distances

RNG = np.random.default_rng(0)
GOOD = RNG.random((40, 3))
NAMES = ("alpha", "edp", "pth")


def notes_of(x: np.ndarray, names: tuple[str, ...] = NAMES) -> list[str]:
    notes: list[str] = []
    check_inputs(names, x, "runs.csv", notes)
    return notes


def test_distances_by_hand() -> None:
    # quartiles of 0 .. 4 are 1 and 3, the median 2: 4 is one range from it; a column that does not vary has none
    values = np.column_stack([np.arange(5.0), np.ones(5), [0, 1, 2, 3, np.nan]])
    assert distances(values)[:, 0].tolist() == [1, 0.5, 0, 0.5, 1]
    assert distances(values)[:, 1].tolist() == [0] * 5 and distances(values)[4, 2] == 0


@pytest.mark.parametrize(("value", "words"), [(1e101, "too large to calculate with"), (1e-101, "too small to calculate with")])
def test_sizes_beyond_calculation(value: float, words: str) -> None:
    values = np.full((3, 1), value)
    with pytest.raises(TableError, match=rf"output esv .*{words}"):
        check_sizes(["esv"], values, "output")
    check_sizes(["esv"], np.array([[0.0], [np.nan], [1e99]]), "output")


@given(st.integers(0, 2**32 - 1))
def test_honest_designs_pass_without_a_word(seed: int) -> None:
    assert notes_of(np.random.default_rng(seed).random((40, 3)) + 0.1) == []


def test_a_stray_input_is_named_with_where_half_of_the_runs_lie() -> None:
    x = GOOD.copy()
    x[7, 1] = 1e6
    with pytest.raises(TableError, match=r"runs.csv: input edp is 1e\+06 where half of the runs lie in"):
        notes_of(x)


def test_a_counter_is_said() -> None:
    x = GOOD.copy()
    x[:, 0] = np.arange(40.0)
    (note,) = notes_of(x, ("number", "edp", "pth"))
    assert note.startswith("input number counts the rows")


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda x: x[:, 0] ** 3, r"inputs alpha and pth are dependent \(correlation"),
        (lambda x: 3 - 2 * x[:, 0], r"inputs alpha and pth are linearly dependent"),
        (lambda x: x[:, 0] - 2 * x[:, 1], r"inputs alpha, edp and pth are linearly dependent"),
        (lambda x: (x[:, 0] + 1e-3) * (x[:, 1] + 1e-3) / (x[:, 0] + 1e-3), r"linearly dependent"),
    ],
)
def test_inputs_that_tell_one_another_are_refused(made, words: str) -> None:  # type: ignore[no-untyped-def]
    x = GOOD.copy()
    x[:, 2] = made(x)
    with pytest.raises(TableError, match=words):
        notes_of(x)


def test_a_product_is_seen_by_its_logarithm_and_a_near_relation_is_only_said() -> None:
    x = np.exp(3 * GOOD)
    x[:, 2] = x[:, 0] * x[:, 1]
    with pytest.raises(TableError, match=r"dependent \(their logarithms linearly\)"):
        notes_of(x)
    y = GOOD.copy()
    y[:, 2] = y[:, 0] - y[:, 1] + 0.02 * RNG.random(40)
    (note,) = notes_of(y)
    assert "are nearly linearly dependent" in note and "can hardly be learnt" in note
