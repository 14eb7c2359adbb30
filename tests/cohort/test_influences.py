"""What the patients' calibrations say of their inputs, frames, emulators and numerics; the figures made of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.cohort.analysis.fits import courses, over_frames, over_numerics, over_outputs
from lacli.cohort.analysis.influences import influences, over_patients
from lacli.report.cohort_figures import courses_figure, influence_figure, ninety

POSTERIOR = [
    {"input": "alpha", "map": 1.0, "sd": 0.1, "prior_sd": 2.0},
    {"input": "edp_mmhg", "map": 5.0, "sd": 0.5, "prior_sd": 1.0},
]
FIT = [
    {"feature": "esv_ml", "target": 100.0, "sd": 5.0, "own_sd": 3.0, "emulated": 103.0, "simulated": 102.0},
    {"feature": "d_roof_mm@0.2", "target": 3.0, "sd": 0.5, "own_sd": 0.3, "emulated": 3.3, "simulated": None},
    {"feature": "a word", "target": 1.0, "sd": 1.0, "emulated": 1.0},
]


def runs(folder: Path) -> Path:
    table = {
        "alpha": [1.05, 3.0, 1.0, 1.0], "edp_mmhg": [5.0, 5.0, 5.0, 5.0], "esv_ml": 100.0, "d_roof_mm@0.2": 3.0,
        "desv_ml/dalpha": [-2.0, 9.0, np.nan, 7.0], "desv_ml/dedp_mmhg": [3.0, 9.0, np.nan, 7.0],
        "dd_roof_mm@0.2/dalpha": [0.0, 9.0, np.nan, 7.0], "dd_roof_mm@0.2/dedp_mmhg": [0.5, 9.0, np.nan, 7.0],
        "status": ["done", "done", "done", "failed"],
    }  # fmt: skip
    folder.mkdir()
    pd.DataFrame(table).to_csv(folder / "runs.csv", index=False)
    return folder


def test_shares_are_of_the_run_that_is_nearest_and_tells(tmp_path: Path) -> None:
    rows = influences("a", runs(tmp_path / "c"), {"posterior": POSTERIOR, "fit": FIT})
    # (-2 x 2)^2 = 16, (3 x 1)^2 = 9; and 0, .25
    assert rows[0] == {"participant_id": "a", "feature": "esv_ml", "alpha": pytest.approx(0.64), "edp_mmhg": pytest.approx(0.36)}
    assert rows[1] == {"participant_id": "a", "feature": "d_roof_mm@0.2", "alpha": 0.0, "edp_mmhg": 1.0}
    assert influences("a", tmp_path, {"posterior": POSTERIOR, "fit": FIT}) == [], "runs made elsewhere"
    other = [{**rows[0], "participant_id": "b", "alpha": 0.0, "edp_mmhg": 1.0}]
    inputs, features, mean = over_patients([*rows, *other])
    assert inputs == ["alpha", "edp_mmhg"] and features == ["esv_ml"], "only what all have"
    assert mean == pytest.approx(np.array([[0.32], [0.68]]))


def test_inputs_that_make_ninety_percent() -> None:
    shares = np.array([[0.5, 0.95, 0.0], [0.3, 0.05, 0.0], [0.15, 0.0, 0.0], [0.05, 0.0, 0.0]])
    # .5 + .3 is not yet .9, with .15 it is more; .95 alone is; where nothing varies, none
    assert ninety(shares).tolist() == [[True, True, False], [True, False, False], [True, False, False], [False, False, False]]


def test_courses_and_frames() -> None:
    rows = courses("a", {"fit": FIT}, 0.4)
    assert [(r["feature"], r["time"], r["at_map"], r["sd"]) for r in rows] == [
        ("volume_ml", 0.4, 102.0, 3.0), ("d_roof_mm", 0.2, 3.3, 0.3),
    ]  # fmt: skip
    assert [r["feature"] for r in courses("a", {"fit": FIT}, None)] == ["d_roof_mm"], "end-systole's time is not known"
    early, late = over_frames(rows)
    assert (early["time"], early["rmse_mm"], early["rmse_in_sd"]) == (0.2, pytest.approx(0.3), pytest.approx(1.0))
    assert (late["time"], late["rmse_mm"], late["rmse_in_sd"]) == (0.4, None, pytest.approx(2.0 / 3.0))


def test_numerics_and_emulators_over_patients() -> None:
    volume, roof = over_numerics({"a": {"fit": FIT}})
    assert volume["discretisation_median"] == pytest.approx(4.0) and volume["over_measurement"] == pytest.approx(4.0 / 3.0)
    assert roof["discretisation_largest"] == pytest.approx(0.4)
    waves = [{"r2": {"esv_ml": 0.5}}, {"r2": {"esv_ml": 0.9, "d_roof_mm": None}}]
    (row,) = over_outputs({"a": {"waves": waves}, "b": {"waves": [{"r2": {"esv_ml": 0.7}}]}, "c": {}})
    assert row == {"output": "esv_ml", "patients": 2, "r2_mean": pytest.approx(0.8), "r2_least": 0.7, "of": "b"}


def test_the_figures_are_drawn(tmp_path: Path) -> None:
    influence_figure(["alpha", "edp_mmhg"], ["esv_ml"], np.array([[0.64], [0.36]]), [tmp_path / "i.png", tmp_path / "i.pdf"])
    frame = pd.DataFrame([{**row, "participant_id": person} for person in "ab" for row in courses(person, {"fit": FIT}, 0.4)])
    courses_figure(frame, [tmp_path / "c.png", tmp_path / "c.svg"])
    assert all((tmp_path / name).stat().st_size > 1000 for name in ("i.png", "i.pdf", "c.png", "c.svg"))
