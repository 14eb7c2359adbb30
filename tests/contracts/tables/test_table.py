"""Tables of runs, targets and boxes as users bring them: good, bad and odd."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.base.errors import TableError, UsageError
from lacli.contracts.priors import Prior
from lacli.contracts.tables.absent import CODES
from lacli.contracts.tables.table import combine, fewest_runs, read_frame, read_runs
from lacli.contracts.targets import Targets, read_targets, write_targets
from lacli.inference.box import CALIBRATION_INPUTS, make_box, published_box, read_box


def frames(n=20, d=3, p=2, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.random((n, d))
    return (
        pd.DataFrame(x, columns=[f"x{j}" for j in range(d)]),
        pd.DataFrame(np.c_[x.sum(1), x[:, 0] ** 2][:, :p], columns=["a_mm", "b_ml"][:p]),
    )


def test_a_good_table_is_taken_as_it_is():
    x, y = frames()
    table = combine(x, y)
    assert table.inputs == ("x0", "x1", "x2") and table.outputs == ("a_mm", "b_ml")
    assert np.array_equal(table.x, x.to_numpy()) and np.array_equal(table.y, y.to_numpy())
    assert not table.notes and not table.error_sd.any() and table.failed_x.shape == (0, 3)


def test_failed_runs_and_missing_outputs_are_kept_apart_and_counted():
    x, y = frames()
    y["status"] = "ok"
    y.loc[3, "status"] = "failed"
    y.loc[5, "a_mm"] = np.nan
    table = combine(x, y)
    assert table.runs == 18
    assert np.array_equal(table.failed_x, x.to_numpy()[[3, 5]])
    assert len(table.notes) == 2


def test_discretisation_errors_belong_to_their_outputs():
    x, y = frames()
    y["b_ml_discretisation_error"] = 0.25
    table = combine(x, y)
    assert table.outputs == ("a_mm", "b_ml")
    assert np.array_equal(table.error_sd, np.tile([0.0, 0.25], (20, 1)))


def test_constant_columns_and_repeated_runs_are_set_aside_with_a_note():
    x, y = frames()
    x["still"], y["flat"] = 1.7, 4.0
    table = combine(pd.concat([x, x.iloc[:4]]), pd.concat([y, y.iloc[:4]]))
    assert table.runs == 20 and table.inputs == ("x0", "x1", "x2") and table.outputs == ("a_mm", "b_ml")
    assert len(table.notes) == 3 and "still" in " ".join(table.notes) and "flat" in " ".join(table.notes)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda x, y: (x.assign(x1=x.x1.where(x.index != 7)), y), r"input x1 has no finite value in row 8"),
        (lambda x, y: (x.iloc[:5], y.iloc[:5]), r"5 finished runs for 3 inputs .* at least 9"),
        (lambda x, y: (x.iloc[:10], y), r"10 rows of inputs but 20 rows of outputs"),
        (lambda x, y: (x.assign(x0=["oops", *x.x0[1:]]), y), r"column x0, row 1 holds 'oops'"),
        (lambda x, y: (x, y.rename(columns={"a_mm": "x0"})), r"x0 is both an input and an output"),
        (lambda x, y: (x, y * 0), r"no output varies"),
        (lambda x, y: (x, y.assign(status="failed")), r"0 finished runs"),
    ],
)
def test_a_bad_table_gives_one_clear_message(spoil, message):
    with pytest.raises(TableError, match=message):
        combine(*spoil(*frames()))


def test_wrong_names_are_told_with_the_right_ones():
    x, y = frames()
    with pytest.raises(TableError, match="wrong is not a column; the columns are a_mm, b_ml"):
        combine(x, y, output_names=["wrong"])
    with pytest.raises(UsageError, match="no output c"):
        combine(x, y).select(["c"])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "", "cannot be read as a table"),
        ("a.csv", "x,y\n", "is empty"),
        ("a.csv", "x,x\n1,2\n", "occurs twice"),
        ("a.csv", "1.0,2.0\n3,4\n", "numbers, not column names"),
        ("a.csv", "x;y\n0,5;1,5\n0,6;2,5\n", "separated by semicolons. Separate them by commas"),
        ("a.csv", "x,y\n1,2,9\n3,4,9\n", "more cells than the header line"),
        ("a.parquet", "not parquet", "cannot be read as a table"),
    ],
)
def test_a_bad_file_gives_one_clear_message(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(TableError, match=message):
        read_frame(tmp_path / name)
    with pytest.raises(TableError, match="no such table"):
        read_frame(tmp_path / "absent.csv")


def test_a_comma_at_the_end_of_every_line_shifts_nothing(tmp_path):
    (tmp_path / "a.csv").write_text("x,y\n1,2,\n3,4,\n")
    assert read_frame(tmp_path / "a.csv").to_dict("list") == {"x": [1, 3], "y": [2, 4]}


def test_csv_and_parquet_give_the_same_bits(tmp_path):
    x, y = frames()
    x.to_csv(tmp_path / "x.csv", index=False)
    y.to_parquet(tmp_path / "y.parquet", index=False)
    table = read_runs(tmp_path / "x.csv", tmp_path / "y.parquet")
    assert np.array_equal(table.x, x.to_numpy()) and np.array_equal(table.y, y.to_numpy())


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.floats(-1e6, 1e6).filter(lambda v: v not in CODES), st.floats(1e-6, 1e6)), min_size=1, max_size=5))
def test_targets_come_back_as_written(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("t") / "targets.toml"
    targets = Targets(
        tuple(f"f{i}_mm" for i in range(len(values))), np.array([v[0] for v in values]), np.array([v[1] for v in values])
    )
    write_targets(path, targets)
    back = read_targets(path)
    assert back.names == targets.names and np.array_equal(back.mean, targets.mean) and np.array_equal(back.sd, targets.sd)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 6), st.integers(0, 1000), st.floats(1e-3, 1e3))
def test_correlated_targets_come_back_as_written(tmp_path_factory, p, seed, unit):
    path = tmp_path_factory.mktemp("t") / "mine.toml"
    rng = np.random.default_rng(seed)
    factor = unit * rng.normal(size=(p, p))
    covariance = factor @ factor.T + 0.01 * unit**2 * np.eye(p)
    sd = np.sqrt(np.diag(covariance))
    priors = (Prior("edp_mmhg", "lognormal", 8.0, 1.5, 2.0),)
    write_targets(path, Targets(tuple(f"f{i}_mm" for i in range(p)), rng.normal(size=p), sd, covariance, priors))
    back = read_targets(path)
    assert np.array_equal(back.covariance, covariance) and np.array_equal(back.sd, sd) and back.priors == priors
    assert {file.name for file in path.parent.iterdir()} == {"mine.toml", "mine_covariance.npz"}


def test_targets_whose_errors_are_not_the_measurement_s_alone_are_not_written(tmp_path):
    targets = Targets(("a_mm",), np.ones(1), np.ones(1)).widened({"a_mm": 0.5})
    with pytest.raises(TableError, match=r"errors were added to these targets"):
        write_targets(tmp_path / "t.toml", targets)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[a]\nmean = 1.0\nsd = 0.0\n", "sd must be positive"),
        ("[a]\nmean = nan\nsd = 1.0\n", "finite number for mean"),
        ("[a]\nmean = 1.0\nstd = 1.0\n", "unknown key std"),
        ("[a]\nmean = 1.0\n", "finite number for sd"),
        ("x = 3\n", "no target"),
        ("[a", "not valid TOML"),
    ],
)
def test_bad_targets(tmp_path, text, message):
    (tmp_path / "t.toml").write_text(text)
    with pytest.raises(TableError, match=message):
        read_targets(tmp_path / "t.toml")


def test_targets_may_stand_at_the_top_or_under_targets(tmp_path):
    for text in ("[a]\nmean = 1\nsd = 2\n", "[targets.a]\nmean = 1\nsd = 2\n"):
        (tmp_path / "t.toml").write_text(text)
        assert read_targets(tmp_path / "t.toml").names == ("a",)
    with pytest.raises(TableError, match="no value for b"):
        read_targets(tmp_path / "t.toml").select(["b"])


def test_the_published_box():
    box = published_box()
    assert box.names == CALIBRATION_INPUTS and box.d == 9
    # EDP 1 - 12 and ESP 13 - 37 do not overlap: no ordering is needed
    assert box.ordered == ()
    overlapping = make_box(["edp_mmhg", "esp_mmhg"], [1, 5], [12, 37])
    assert overlapping.ordered == ((0, 1),)
    x = overlapping.uniform(500, np.random.default_rng(0))
    assert (x[:, 0] < x[:, 1]).all() and overlapping.contains(x).all()
    assert not overlapping.contains(np.array([[11.0, 6.0]]))[0]


def test_bad_boxes(tmp_path):
    for text, message in (("[box]\na = [2, 1]\n", "lower end"), ("[box]\na = 3\n", "needs"), ("", "no range")):
        (tmp_path / "b.toml").write_text(text)
        with pytest.raises(UsageError, match=message):
            read_box(tmp_path / "b.toml")
    with pytest.raises(UsageError, match="never below"):
        make_box(["edp_mmhg", "esp_mmhg"], [30, 5], [40, 20])
    with pytest.raises(UsageError, match="no such box file"):
        read_box(Path("absent.toml"))


def test_fewest_runs_is_enough_for_five_folds():
    for d in range(1, 15):
        assert 0.8 * fewest_runs(d) >= d + 2  # a linear mean has d + 1 coefficients
