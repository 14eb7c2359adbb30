"""Bounds of tables, boxes that reach 0, targets that no measurement gives: each refused or thinned with a word."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from lacli.base.errors import TableError
from lacli.contracts.tables import file
from lacli.contracts.tables.absent import is_code
from lacli.contracts.tables.table import combine
from lacli.contracts.targets import read_targets
from lacli.inference.emulation.emulator import fit_emulator
from lacli.inference.emulation.scales import may_be_logarithmic


@pytest.mark.parametrize("ending", ["csv", "parquet"])
@pytest.mark.parametrize(
    ("limit", "value", "words"),
    [
        ("MOST_ROWS", 9, r"about \d+ rows|10 rows"),
        ("MOST_COLUMNS", 2, "3 columns; a table of at most 2"),
        ("_MOST_CELLS", 20, "cells; a table of at most 20"),
        ("MOST_BYTES", 10, "at most 0 MB"),
    ],
)
def test_a_table_beyond_a_limit_is_not_read(ending, limit, value, words, tmp_path, monkeypatch):
    frame = pd.DataFrame(np.random.default_rng(0).random((12, 3)), columns=["a", "b", "c"])
    path = tmp_path / f"t.{ending}"
    frame.to_csv(path, index=False) if ending == "csv" else frame.to_parquet(path)
    assert file.read_frame(path).shape == (12, 3)
    monkeypatch.setattr(file, limit, value)
    with pytest.raises(TableError, match=rf"t\.{ending}: .*(?:{words})"):
        file.read_frame(path)


def test_more_runs_than_are_learnt_from_are_thinned_with_a_word():
    x = np.random.default_rng(1).random((500, 2))
    frame = pd.DataFrame(np.c_[x, x.sum(1), x.prod(1)], columns=["a", "b", "f", "g"])
    table = combine(frame[["a", "b"]], frame[["f", "g"]], most=100)
    assert table.runs <= 100 and any("500" in note for note in table.notes)
    assert not combine(frame[["a", "b"]], frame[["f", "g"]]).notes


@given(st.floats(0.0, 1e-6), st.floats(0.1, 100.0))
def test_an_input_whose_range_reaches_0_is_never_logarithmic(low, high):
    """Unless it stays positive over a wide ratio: then it may be."""
    x = np.linspace(low, high, 20)[:, None]
    assert may_be_logarithmic(x)[0] == (low > 0)
    assert not may_be_logarithmic(-x)[0] and not may_be_logarithmic(x - 1e-3 * high)[0]


def test_an_input_taken_as_it_is_stays_linear():
    """log y is linear in log x here: without the wish, the logarithm is chosen."""
    x = np.exp(np.random.default_rng(2).uniform(np.log(0.01), np.log(10.0), (40, 1)))
    y = 3.0 + np.log(x[:, 0])
    assert fit_emulator(x, y, starts=1).log_inputs.tolist() == [True]
    assert fit_emulator(x, y, starts=1, may_log=np.array([False])).log_inputs.tolist() == [False]


@pytest.mark.parametrize(
    ("mean", "sd", "words"),
    [
        ("1.0", "0.0", "sd must be positive"), ("1.0", "-1", "sd must be positive"), ("1.0", "1e-300", "that exact"),
        ("1e9", "1e-6", "that exact"), ("1.0", "1e7", "tells nothing"), ("1e101", "1e101", "tells nothing"),
        ("nan", "1.0", "number for mean"), ("1.0", "inf", "number for sd"), ("true", "1.0", "number for mean"),
        ('"3"', "1.0", "finite number for mean"), ("1.0", "1e-101", "that exact"),
    ],
)  # fmt: skip
def test_targets_that_no_measurement_gives_are_refused(mean, sd, words, tmp_path):
    (tmp_path / "t.toml").write_text(f"[targets.my_feature]\nmean = {mean}\nsd = {sd}\n")
    with pytest.raises(TableError, match=rf"t\.toml: \[my_feature\].*{words}"):
        read_targets(tmp_path / "t.toml")


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e3))
def test_targets_of_any_usual_size_come_back(tmp_path_factory, mean, sd):
    assume(not is_code(mean) and not is_code(sd))  # 999 and its like: refused as marks of a missing value
    path = tmp_path_factory.mktemp("t") / "t.toml"
    path.write_text(f"[targets.d_mm]\nmean = {mean!r}\nsd = {sd!r}\n")
    found = read_targets(path)
    assert (found.mean[0], found.sd[0]) == (mean, sd)
