"""What the patients' calibrations say of their inputs, frames, emulators and numerics; the figures made of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.cohort.analysis.fits import courses, over_frames, over_numerics, over_outputs, scores
from lacli.cohort.analysis.influences import by_patient, influences, over_patients
from lacli.contracts.targets import Targets
from lacli.inference.emulation.emulator import fit_emulator
from lacli.inference.emulation.emulator_set import EmulatorSet, save_emulators
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
    head = {"participant_id": "a", "by": "derivatives"}
    assert rows[0] == {**head, "feature": "esv_ml", "alpha": pytest.approx(0.64), "edp_mmhg": pytest.approx(0.36)}
    assert rows[1] == {**head, "feature": "d_roof_mm@0.2", "alpha": 0.0, "edp_mmhg": 1.0}
    assert influences("a", tmp_path, {"posterior": POSTERIOR, "fit": FIT}) == [], "runs made elsewhere"
    other = [{**rows[0], "participant_id": "b", "alpha": 0.0, "edp_mmhg": 1.0}]
    inputs, features, mean = over_patients([*rows, *other])
    assert inputs == ["alpha", "edp_mmhg"] and features == ["esv_ml"], "only what all have"
    assert mean == pytest.approx(np.array([[0.32], [0.68]]))
    inputs, people, of_each = by_patient([*rows, *other])
    # of a: the mean of .64 and 0
    assert people == ["a", "b"] and of_each == pytest.approx(np.array([[0.32, 0.0], [0.68, 1.0]]))


def test_without_derivatives_the_first_wave_s_emulators_tell(tmp_path: Path) -> None:
    # y = x + 3 z over [0, 1]^2: variances 1 and 9 twelfths; the second output is x alone
    x = np.random.default_rng(0).random((40, 2))
    emulators = [fit_emulator(x, x[:, 0] + 3.0 * x[:, 1], "esv_ml"), fit_emulator(x, x[:, 0].copy(), "d_roof_mm")]
    save_emulators(tmp_path / "wave_1" / "emulators.npz", EmulatorSet(("x", "z"), tuple(emulators)))
    box = {"box.names": ["x", "z"]} | {f"box.{end}.{name}": v for end, v in (("lower", 0), ("upper", 1)) for name in "xz"}
    (tmp_path / "calibration.json").write_text(json.dumps({"content": box}))
    volume, roof = influences("a", tmp_path, {"posterior": POSTERIOR, "fit": FIT, "waves": [{"runs": 40}]})
    assert volume["by"] == "total effects" and (volume["x"], volume["z"]) == pytest.approx((0.1, 0.9), abs=0.02)
    assert (roof["x"], roof["z"]) == pytest.approx((1.0, 0.0), abs=0.01)


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
    given = Targets(("esv_ml", "d_roof_mm@0.2"), np.array([100.0, 3.0]), np.array([3.0, 0.3]))
    volume, roof = over_numerics({"a": {"fit": FIT}}, {"a": given})
    assert volume["discretisation_median"] == pytest.approx(4.0) and volume["over_measurement"] == pytest.approx(4.0 / 3.0)
    assert roof["discretisation_largest"] == pytest.approx(0.4)
    waves = [{"r2": {"esv_ml": 0.5}}, {"r2": {"esv_ml": 0.9, "d_roof_mm": None}, "ise": {"esv_ml": 0.93}}]
    sequential = {"emulators": {"esv_ml": {"r2": 0.8, "ise": 0.97}}}
    told = {"a": {"waves": waves}, "b": {"waves": [{"r2": {"esv_ml": 0.7}}]}, "c": sequential, "d": {}}
    rows = [row for patient, result in told.items() for row in scores(patient, result)]
    assert rows[0] == {"participant_id": "a", "output": "esv_ml", "r2": 0.9, "ise": 0.93}
    (row,) = over_outputs(rows)
    assert row == {
        "output": "esv_ml", "patients": 3, "r2_mean": pytest.approx(0.8), "r2_least": 0.7, "of": "b",
        "ise_mean": pytest.approx(0.95), "ise_least": 0.93, "ise_of": "a",
    }  # fmt: skip


def test_what_targets_state_of_the_model_is_no_discretisation_error() -> None:
    """Of 25 mL^2, 9 are the measurement's; 16 are 4 times what was added: 4, of which 2.56 were stated."""
    given = Targets(("esv_ml",), np.array([100.0]), np.array([3.0])).widened({"esv_ml": 1.6})
    result = {"fit": FIT[:1], "error_factor": {"value": 2.0}}
    (row,) = over_numerics({"a": result, "b": {"fit": FIT[2:]}}, {"a": given})
    assert (row["patients"], row["discretisation_median"]) == (1, pytest.approx(1.2))
    assert row["over_measurement"] == pytest.approx(0.4)


def test_the_figures_are_drawn(tmp_path: Path) -> None:
    influence_figure(["alpha", "edp_mmhg"], ["esv_ml"], np.array([[0.64], [0.36]]), [tmp_path / "i.png", tmp_path / "i.pdf"])
    frame = pd.DataFrame([{**row, "participant_id": person} for person in "ab" for row in courses(person, {"fit": FIT}, 0.4)])
    courses_figure(frame, [tmp_path / "c.png", tmp_path / "c.svg"])
    assert all((tmp_path / name).stat().st_size > 1000 for name in ("i.png", "i.pdf", "c.png", "c.svg"))
