"""Derivatives as columns of a table of runs: read, carried through every selection, their units checked by the table itself."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.base.errors import TableError
from lacli.contracts.tables.columns import derivative_of
from lacli.contracts.tables.gradients import gradient_columns, name_of
from lacli.contracts.tables.table import combine, read_runs

INPUTS, OUTPUTS = ("alpha_roof", "edp_mmhg", "k_kpa_per_um"), ("esv_ml", "d_roof_mm")


def runs(n=30, seed=0):
    """Inputs and outputs with derivatives by hand: esv = 50 / a + 2 e + e^2 / 10, d = log(a) e + 100 k."""
    rng = np.random.default_rng(seed)
    a, e, k = rng.uniform(0.5, 4.0, n), rng.uniform(1.0, 12.0, n), rng.uniform(1e-4, 5e-3, n)
    x = pd.DataFrame({"alpha_roof": a, "edp_mmhg": e, "k_kpa_per_um": k})
    y = pd.DataFrame({"esv_ml": 50 / a + 2 * e + e**2 / 10, "d_roof_mm": np.log(a) * e + 100 * k})
    y["desv_ml/dalpha_roof"], y["desv_ml/dedp_mmhg"], y["desv_ml/dk_kpa_per_um"] = -50 / a**2, 2 + e / 5, 0.0
    y["dd_roof_mm/dalpha_roof"], y["dd_roof_mm/dedp_mmhg"], y["dd_roof_mm/dk_kpa_per_um"] = e / a, np.log(a), 100.0
    return x, y


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_derivatives_are_read_from_both_kinds_of_file(tmp_path: Path, ending: str) -> None:
    x, y = runs()
    paths = tmp_path / f"x.{ending}", tmp_path / f"y.{ending}"
    for frame, path in zip((x, y), paths, strict=True):
        frame.to_csv(path, index=False) if ending == "csv" else frame.to_parquet(path)
    table = read_runs(*paths)
    assert table.inputs == INPUTS and table.outputs == OUTPUTS and not table.notes
    assert table.gradients.shape == (30, 3, 2)
    for i, given_ in enumerate(INPUTS):
        for j, output in enumerate(OUTPUTS):
            assert np.array_equal(table.gradients[:, i, j], y[f"d{output}/d{given_}"]), (output, given_)


def test_a_table_without_derivatives_has_none() -> None:
    x, y = runs()
    assert combine(x, y[list(OUTPUTS)]).gradients is None


def test_derivatives_go_with_their_runs_and_outputs() -> None:
    """Failed runs, a still input, a flat output, a repeated run and a choice of outputs take theirs along."""
    x, y = runs()
    x["still"], y["flat"], y["dflat/dstill"], y["desv_ml/dstill"] = 1.7, 3.0, 0.0, 5.0
    y["status"] = "done"
    y.loc[4, "status"] = "failed"
    twice = pd.concat([x, x.iloc[:3]]), pd.concat([y, y.iloc[:3]])
    table = combine(*twice)
    kept = [i for i in range(30) if i != 4]
    assert table.inputs == INPUTS and table.outputs == OUTPUTS
    assert np.array_equal(table.gradients[:, 1, 1], y["dd_roof_mm/dedp_mmhg"].to_numpy()[kept])
    assert np.array_equal(table.select(["d_roof_mm"]).gradients[:, :, 0], table.gradients[:, :, 1])
    one = combine(*twice, output_names=["d_roof_mm"])
    assert np.array_equal(one.gradients, table.select(["d_roof_mm"]).gradients)


def test_unknown_derivatives_are_nan_and_said() -> None:
    x, y = runs()
    y.loc[[2, 7], [c for c in y.columns if "/d" in c]] = np.nan
    y.loc[9, "desv_ml/dedp_mmhg"] = np.nan
    table = combine(x, y.drop(columns="dd_roof_mm/dedp_mmhg"))
    assert np.isnan(table.gradients[[2, 7]]).all() and np.isnan(table.gradients[:, 1, 1]).all()
    assert np.isnan(table.gradients).sum() == 2 * 6 + 1 + 28
    assert [note for note in table.notes if "2 run(s) tell no derivatives" in note]
    y[[c for c in y.columns if "/d" in c]] = np.nan
    empty = combine(x, y)
    assert empty.gradients is None and "empty" in " ".join(empty.notes)


WRONG = {
    "kPa for mmHg": ("desv_ml/dedp_mmhg", 1 / 0.133322),
    "per kPa/mm": ("dd_roof_mm/dk_kpa_per_um", 1e3),
    "L for mL": ("desv_ml/dalpha_roof", 1e-3),
    "another sign": ("dd_roof_mm/dalpha_roof", -1.0),
    "a fifth": ("dd_roof_mm/dedp_mmhg", 0.2),
}


@pytest.mark.parametrize("column, factor", WRONG.values(), ids=WRONG)
def test_a_derivative_in_another_unit_is_refused_by_name(column: str, factor: float) -> None:
    x, y = runs()
    y[column] *= factor
    with pytest.raises(TableError, match=column) as caught:
        combine(x, y)
    told = float(str(caught.value).split("differ by ")[1].split(" ")[0])
    assert told == pytest.approx(1 / factor, rel=0.35)  # differences say the correction, to what 30 runs can tell


def test_all_derivatives_of_another_unit_are_one_message() -> None:
    x, y = runs()
    y[[c for c in y.columns if c.startswith("desv_ml/")]] *= 1000.0
    with pytest.raises(TableError, match="So do"):
        combine(x, y)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 8), st.integers(15, 60), st.floats(0.1, 2.0))
def test_right_derivatives_are_never_refused(seed: int, d: int, n: int, bend: float) -> None:
    """Waves of any direction and length over the box, noise in the values: no unit is doubted for the function's shape."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (n, d))
    w = rng.normal(size=(6, d)) * bend
    phase, size = rng.uniform(0, 6, 6), rng.normal(size=6)
    y = np.sin(x @ w.T + phase) @ size + 0.02 * rng.normal(size=n)
    slope = (np.cos(x @ w.T + phase) * size) @ w
    names = [f"x{i}" for i in range(d)]
    outputs = pd.DataFrame({"f": y} | {f"df/d{name}": slope[:, i] for i, name in enumerate(names)})
    assert combine(pd.DataFrame(x, columns=names), outputs).gradients.shape == (n, d, 1)


def test_names_that_fit_nothing_are_refused() -> None:
    x, y = runs()
    with pytest.raises(TableError, match="derivative by esp_mmhg, which is no input"):
        combine(x, y.rename(columns={"desv_ml/dedp_mmhg": "desv_ml/desp_mmhg"}))
    with pytest.raises(TableError, match="derivative of what is no output"):
        combine(x, y.rename(columns={"desv_ml/dedp_mmhg": "desv/dedp_mmhg"}))
    with pytest.raises(TableError, match="belong beside the outputs"):
        combine(x.assign(**{"desv_ml/dedp_mmhg": 1.0}), y)
    with pytest.raises(TableError, match="row 4 holds 'soft'"):
        combine(x, y.assign(**{"desv_ml/dedp_mmhg": ["1"] * 3 + ["soft"] * 27}))
    with pytest.raises(TableError, match="too large"):
        combine(x, y.assign(**{"desv_ml/dedp_mmhg": 1e200}))


_WORDS = st.text(st.characters(codec="ascii", categories=["L", "N"], include_characters="_/@. "), min_size=1, max_size=8)


@given(st.lists(_WORDS, min_size=1, max_size=4, unique=True), st.lists(_WORDS, min_size=1, max_size=4, unique=True))
def test_a_column_that_is_named_for_a_derivative_is_one(outputs: list[str], inputs: list[str]) -> None:
    names = [name_of(o, i) for o in outputs for i in inputs]
    assert all(derivative_of(name, outputs) is not None for name in names)
    found = gradient_columns(names, outputs, inputs)
    assert set(found) == set(names) and all(name_of(*parts) == name for name, parts in found.items())
