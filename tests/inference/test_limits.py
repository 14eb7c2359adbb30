"""Bounds of tables, boxes that reach 0, targets that no measurement gives: each refused or thinned with a word."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from lacli.api import inference
from lacli.base.errors import TableError
from lacli.contracts.tables import file
from lacli.contracts.tables.absent import is_code
from lacli.contracts.tables.table import combine
from lacli.contracts.targets import read_targets
from lacli.inference.box import make_box
from lacli.inference.design import design
from lacli.inference.emulation.emulator import fit_emulator
from lacli.inference.emulation.emulator_set import EmulatorSet
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


def test_indices_over_ranges_that_break_an_ordering_say_so():
    """Of edp 1 to 20 and esp 13 to 37, edp is above esp in a triangle of 7 by 7: 24.5 / (19 x 24) = 5.4 %."""
    names = ["edp_mmhg", "esp_mmhg"]
    space = make_box(names, [1.0, 13.0], [20.0, 37.0])
    x = design(space, 30)
    fitted = EmulatorSet(space.names, (fit_emulator(x, x[:, 1] - x[:, 0], "y", starts=1),))
    found = inference.sensitivity(fitted, box=space, count=64, draws=0)
    assert "of these ranges edp_mmhg is not below esp_mmhg" in found.warning
    assert 1.0 - space.share_in_order() == pytest.approx(0.0537, abs=0.005)  # four standard errors of 2^15 points
    assert found.outside >= 1.0 - space.share_in_order()
    apart = make_box(names, [1.0, 21.0], [20.0, 37.0])
    assert apart.share_in_order() == 1.0 and "ranges" not in inference.sensitivity(fitted, box=apart, count=64, draws=0).warning
