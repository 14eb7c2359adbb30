"""Kinds of odd tables that people have: each refused, or taken with a word; never another number without one."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.base.errors import TableError
from lacli.contracts.tables.columns import DONE, FAILED, LABELS, UNFINISHED, run_states, to_numbers
from lacli.contracts.tables.file import read_frame
from lacli.contracts.tables.table import combine


def frames(n=40):
    a, b, c = np.random.default_rng(0).uniform(1, 4, (3, n))
    return pd.DataFrame({"a": a, "b": b, "c": c}), pd.DataFrame({"f": a**2 + b, "g": b * c})


@given(st.sampled_from(LABELS), st.permutations(range(40)), st.sampled_from([int, float, "r{:03d}".format]), st.integers(0, 3))
def test_rows_are_paired_by_any_label_in_any_order(label, order, spelling, lost):
    x, y = frames()
    plain = combine(x, y)
    x, y = (frame.assign(**{label: [spelling(i) for i in range(40)]}) for frame in (x, y))
    y = y.iloc[list(order)].reset_index(drop=True)
    y = y.iloc[: 40 - lost] if list(order) != list(range(40)) else y
    table = combine(x, y.rename(columns={label: label.upper()}))
    kept = {row.tobytes() for row in table.x}
    for row, values in zip(plain.x, plain.y, strict=True):  # whatever is kept has its own outputs beside it
        if row.tobytes() in kept:
            at = next(i for i, other in enumerate(table.x) if np.array_equal(other, row))
            assert np.array_equal(table.y[at], values)
    assert table.inputs == ("a", "b", "c") and table.outputs == ("f", "g")


@given(st.sampled_from(sorted(DONE | FAILED | UNFINISHED)), st.sampled_from([str.upper, str.title, str.lower]))
def test_words_of_status_are_known_however_they_are_spelt(word, spelling):
    done, failed = run_states(pd.DataFrame({"Status": [spelling(word).replace("_", " ")]}), "t")
    assert (bool(done[0]), bool(failed[0])) == (word in DONE, word in FAILED)


@pytest.mark.parametrize("word", ["all right", "", None, "maybe"])
def test_other_words_are_named_with_the_known_ones(word):
    x, y = frames()
    with pytest.raises(TableError, match=r"row 1 .*completed.*failed"):
        combine(x, y.assign(status=[word] + ["done"] * 39))


@pytest.mark.parametrize(
    "made",
    [
        lambda x: 2 * x.a + 1,
        lambda x: (2 * x.a + 1).round(4),
        lambda x: x.a + 2 * x.b - x.c,
        lambda x: x.a**2,
        lambda x: np.exp(x.a),
        lambda x: x.a * x.b / x.c,
        lambda x: 1 / x.a,
    ],
)
def test_inputs_that_depend_on_others_are_named(made):
    x, y = frames()
    with pytest.raises(TableError, match=r"inputs .*a.* and a2 are .*dependent .*Leave one out"):
        combine(x.assign(a2=made(x)), y)


@pytest.mark.parametrize(
    ("column", "words"),
    [
        ([True, False] * 20, "True and False"),
        (["True", "false"] * 20, "True and False"),
        ([1 + 2j] * 40, "complex"),
        (pd.date_range("2024-01-01", periods=40), "dates"),
        (pd.timedelta_range("1h", periods=40), "durations"),
        (["x"] * 40, "not a number"),
        ([[1.0]] * 40, "number"),
    ],
)
def test_columns_of_no_numbers_are_refused_on_both_sides(column, words):
    x, y = frames()
    for frames_ in ((x.assign(h=column), y), (x, y.assign(h=column))):
        with pytest.raises(TableError, match=words):
            combine(*frames_)


@pytest.mark.parametrize("value", [1e20, -1e30, 1e90])
def test_a_mark_of_failure_among_outputs_is_a_failed_run(value):
    x, y = frames()
    table = combine(x, y.assign(f=y.f.where(y.index != 7, value)))
    assert table.runs == 39 and np.array_equal(table.failed_x, x.to_numpy()[[7]]) and "row 8" in table.notes[0]
    with pytest.raises(TableError, match="input a is"):
        combine(x.assign(a=x.a.where(x.index != 7, value)), y)


@pytest.mark.parametrize("suffix", ["_error", "_sd", "_std", "_discretisation_error"])
def test_errors_are_no_outputs(suffix):
    x, y = frames()
    table = combine(x, y.assign(**{"f" + suffix: 0.25}))
    assert table.outputs == ("f", "g") and np.array_equal(table.error_sd, np.tile([0.25, 0.0], (40, 1)))


def test_too_many_runs_are_thinned_with_a_word():
    x, y = frames(400)
    table = combine(x, y, most=100)
    assert table.runs == 100 and "100 of 400 finished runs" in table.notes[-1]
    assert np.allclose(table.y[:, 0], table.x[:, 0] ** 2 + table.x[:, 1])


@pytest.mark.parametrize("cells", [["9" * 400, "1"], [int("9" * 400), 1], ["1e400", "1"]])
def test_a_number_beyond_all_floats_is_infinite_and_named(cells):
    values = to_numbers(pd.Series(cells))
    assert np.isinf(values[0]) and values[1] == 1.0
    x, y = frames()
    with pytest.raises(TableError, match="a has no finite value in row 1"):
        combine(x.assign(a=[cells[0]] + ["1"] * 39), y)


def test_labels_beyond_all_floats_are_kept_apart():
    x, y = frames(9)
    names = [str(i) * 400 for i in range(1, 10)]
    table = combine(x.assign(run_id=names), y.assign(run_id=names).iloc[::-1].reset_index(drop=True))
    assert np.array_equal(table.y, y.to_numpy())


@pytest.mark.parametrize("heading", ["a,1e308", "1e400,b", "0x1.0", "a,nan", "3,4"])
def test_a_heading_that_is_a_number_is_no_name(heading, tmp_path):
    (tmp_path / "x.csv").write_text(f"{heading}\n" + "1,2\n" * 3)
    if heading == "0x1.0":
        (tmp_path / "x.csv").write_text("0x1.0,b\n1,2\n")
        assert list(read_frame(tmp_path / "x.csv").columns) == ["0x1.0", "b"]  # no number as tables have it
        return
    with pytest.raises(TableError, match=r"x\.csv: the first line holds numbers"):
        read_frame(tmp_path / "x.csv")
