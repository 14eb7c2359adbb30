"""A missing-value code, or what its quantity cannot be, is never taken for a value, whoever reads the table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lacli.base.errors import TableError
from lacli.contracts.tables.absent import CODES, apart, check_column, codes, is_code

WRITTEN = (-9999.0, -999.0, 9999.0, 99999.0, 1e20, -1e20, 9.96921e36, -32768.0, 1e30)
values = arrays(float, st.integers(8, 60), elements=st.floats(0.5, 4.0), unique=True)


@given(x=values, code=st.sampled_from(WRITTEN), share=st.floats(0.01, 0.8), seed=st.integers(0, 99))
def test_codes_are_found_whatever_their_share(x: np.ndarray, code: float, share: float, seed: int) -> None:
    rows = np.random.default_rng(seed).permutation(len(x))[: max(1, min(len(x) - 2, int(share * len(x))))]
    x[rows] = code
    assert np.flatnonzero(codes(x)).tolist() == sorted(rows.tolist())
    with pytest.raises(TableError, match="mark of a missing value"):
        check_column("stiffness", x, "runs.csv: input", "Correct it.", lambda text: None)


@given(x=arrays(float, st.integers(2, 80), elements=st.floats(-1e6, 1e6)))
def test_what_lies_among_the_others_is_a_value(x: np.ndarray) -> None:
    """No value within twice the range of the others, or within their size from them, is a code."""
    for row in np.flatnonzero(codes(x)):
        others = np.delete(x, row)
        others = others[~np.isin(others, CODES)]
        assert x[row] < others.min() - np.ptp(others) or x[row] > others.max() + np.ptp(others)


@settings(max_examples=200)
@given(
    kind=st.sampled_from(["uniform", "normal", "six decades", "log-normal", "counts"]),
    n=st.integers(2, 300),
    seed=st.integers(0, 10**6),
)
def test_honest_columns_are_not_refused(kind: str, n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = {
        "uniform": lambda: rng.uniform(0.2, 6.8, n),
        "normal": lambda: rng.normal(0, 1, n),
        "six decades": lambda: 10 ** rng.uniform(-3, 3, n),
        "log-normal": lambda: np.exp(rng.normal(0, 2, n)),
        "counts": lambda: rng.integers(0, 1000, n).astype(float),
    }[kind]()
    assert not codes(x).any() and not apart(x).any()
    check_column("stiffness", x, "", "", lambda text: None)


def test_what_lies_apart_is_told_or_refused() -> None:
    x = np.linspace(1, 2, 20)  # range 1; 50 is 48 times that beyond, 1e6 far more than 1e4 times
    told: list[str] = []
    check_column("x", np.append(x, 50.0), "t:", "Correct it.", told.append)
    assert "x is 50 in row 21, where the others lie in 1 to 2" in told[0]
    with pytest.raises(TableError, match="x is 1e\\+06 in row 21"):
        check_column("x", np.append(x, 1e6), "t:", "Correct it.", told.append)


def test_a_known_quantity_is_held_against_what_it_can_be() -> None:
    told: list[str] = []
    check_column("c_roof_kpa", np.array([1.7, 1.8, 90.0]), "t:", "Correct it.", told.append)  # plausible to 60
    assert "row 3" in told[0] and "unusual" in told[0]
    with pytest.raises(TableError, match=r"c_roof_kpa, row 2: 1700 kPa is not possible.* for kPa"):
        check_column("c_roof_kpa", np.array([1.7, 1700.0]), "t:", "Correct it.", told.append)


def test_alone_a_code_is_one_where_it_can_be_nothing_else() -> None:
    assert is_code(-9999.0) and is_code(1e20) and not is_code(999.0) and not is_code(0.0) and not is_code(-998.0)


# --- every reader of a table ------------------------------------------------------------------------------------------


def _frame(n: int = 16) -> pd.DataFrame:
    rng = np.random.default_rng(3)
    x = rng.uniform(0.5, 4.0, (n, 2))
    return pd.DataFrame({"a": x[:, 0], "b": x[:, 1], "f": x.sum(1), "g": x[:, 0] * 3, "status": "ok"})


def _spoilt(folder: Path, column: str, code: float) -> Path:
    frame = _frame()
    frame.loc[4, column] = code
    frame.to_csv(folder / "t.csv", index=False)
    return folder / "t.csv"


def _emulate(file: Path) -> object:
    from lacli.contracts.tables.table import read_one

    return read_one(file, ["a", "b"], ["f", "g"])


def _design_runs(file: Path) -> object:
    from lacli.inference.box import make_box
    from lacli.inference.design_file import feasibility

    return feasibility(file, make_box(["a", "b"], [0, 0], [5, 5]))


def _log(file: Path) -> object:
    from lacli.inference.runs import RunLog

    return RunLog(file, ["a", "b"], ["f"], None)


def _from_table(file: Path) -> object:
    from lacli.calibration.calibration import Settings
    from lacli.calibration.from_table import calibrate_table
    from lacli.contracts.targets import Targets

    targets = Targets(("f",), np.array([4.0]), np.array([0.1]))
    return calibrate_table(file, targets, None, Settings(), file.parent / "out", False, lambda status: None)


READERS: dict[str, Callable[[Path], object]] = {
    "emulate": _emulate, "design --runs": _design_runs, "log": _log, "calibrate --from-table": _from_table,
}  # fmt: skip


@pytest.mark.parametrize("code", [-9999.0, -999.0, 9999.0, 1e20])
@pytest.mark.parametrize("reader", READERS)
def test_readers_of_runs_refuse_a_code_among_the_inputs(reader: str, code: float, tmp_path: Path) -> None:
    with pytest.raises(TableError, match=r"input b is .* in row 5: a mark of a missing value"):
        READERS[reader](_spoilt(tmp_path, "b", code))
    assert not (tmp_path / "out").exists()


def test_a_third_of_codes_among_the_outputs_are_failures(tmp_path: Path) -> None:
    frame = _frame(24)
    frame.loc[::3, "g"] = -9999.0
    frame.to_csv(tmp_path / "t.csv", index=False)
    table = _emulate(tmp_path / "t.csv")
    assert table.runs == 16 and len(table.failed_x) == 8  # type: ignore[attr-defined]
    assert any("mark of failure" in text for text in table.notes)  # type: ignore[attr-defined]


@pytest.mark.parametrize("code", [-9999.0, 1e20])
def test_an_error_of_an_output_is_no_code(code: float, tmp_path: Path) -> None:
    frame = _frame().assign(f_sd=np.linspace(0.1, 0.2, 16))
    frame.loc[2, "f_sd"] = code
    frame.to_csv(tmp_path / "t.csv", index=False)
    with pytest.raises(TableError, match=r"f_sd is .* in row 3: a mark of a missing value"):
        _emulate(tmp_path / "t.csv")


@pytest.mark.parametrize("code", ["-9999", "-999", "1e20", "9999"])
@pytest.mark.parametrize("column", ["age", "height_cm"])
def test_participants_have_no_codes(column: str, code: str, tmp_path: Path) -> None:
    from lacli.cohort.participants import read_participants

    (tmp_path / "b").mkdir()
    (tmp_path / "t.toml").write_text("[esv_ml]\nmean = 90.0\nsd = 4.0\n")
    rows = "\n".join(f"p{i},b,t.toml,{60 + i if i != 3 else code}" for i in range(9))
    (tmp_path / "p.csv").write_text(f"participant_id,bundle,targets,{column}\n{rows}\n")
    with pytest.raises(TableError, match="n/a where it is not known"):
        read_participants(tmp_path / "p.csv")


@pytest.mark.parametrize("column", ["alpha", "alpha_sd"])
def test_statistics_have_no_codes(column: str, tmp_path: Path) -> None:
    from lacli.cohort.analysis.observations import read_observations

    rng = np.random.default_rng(0)
    frame = pd.DataFrame({"participant_id": [f"p{i}" for i in range(12)], "region": "roof", "alpha": rng.uniform(0.5, 2, 12)})
    frame["alpha_sd"] = 0.1 + 0.01 * np.arange(12)
    frame.loc[7, column] = -999.0
    frame.to_csv(tmp_path / "t.csv", index=False)
    with pytest.raises(TableError, match=f"{column} is -999 in row 8"):
        read_observations(tmp_path / "t.csv", ["alpha"])


@pytest.mark.parametrize(
    ("name", "mean", "words"),
    [
        ("f", -9999, "mark of a missing value"),
        ("f", 1e20, "mark of a missing value"),
        ("esv_ml", 9999, "not possible"),
        ("esv_ml", -1, "not possible"),
        ("d_roof_mm@0.3", 999, "not possible"),
        ("area_strain_roof", -2, "not possible"),
    ],
)
def test_targets_are_no_codes(name: str, mean: float, words: str, tmp_path: Path) -> None:
    from lacli.contracts.targets import read_targets

    (tmp_path / "t.toml").write_text(f'["{name}"]\nmean = {mean}\nsd = 1.0\n')
    with pytest.raises(TableError, match=words):
        read_targets(tmp_path / "t.toml")


def test_rows_at_the_end_of_a_box_make_no_others_apart() -> None:
    """A search leaves many runs at a bound, which differ by rounding: those beside it are as good."""
    search = np.array([23.999999999998806, 22.497, 23.999999999917797, 22.462, 24.0, 23.831, 24.0, 20.33, 24.0, 22.9, 24.0, 24.0])
    assert not apart(search).any() and not apart(-search).any()
    # zeros among them are none of its values, and neither is another unit
    assert apart(np.where(np.arange(12) == 3, 0.0, np.full(12, 24.0) + 1e-9 * np.arange(12))).tolist() == [
        k == 3 for k in range(12)
    ]
    assert apart(np.where(np.arange(12) == 3, 24000.0, np.full(12, 24.0) + 1e-9 * np.arange(12))).sum() == 1
