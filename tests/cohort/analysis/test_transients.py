"""Transients of the image, of the first runs and of the most probable one; by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.cohort.analysis.transients import KEYS, over_transients, transients

TIMES = [0.0, 0.2, 0.4, 0.7]
RESULT = {
    "posterior": [{"input": "alpha_roof", "map": 2.0, "sd": 0.1}, {"input": "edp_mmhg", "map": 5.0, "sd": 0.5}],
    "runs_by_stage": {"starts": 3, "steps": 1}, "fit": [],
}  # fmt: skip
RUNS = [(1.0, 5.0, "done"), (3.0, 5.0, "failed"), (4.0, 6.0, "done"), (0.5, 4.0, "done"), (2.0, 5.0, "done")]
USED = [{"feature": "d_roof_mm", "time": 0.4, "target": 3.9, "sd": 0.3}]


def course(size: float) -> pd.DataFrame:
    """Displacements 0, size / 2, size, size / 4; volume ten times that above 100."""
    shape = np.array([0.0, 0.5, 1.0, 0.25]) * size
    phase = ["ed", "reservoir", "reservoir", "conduit"]
    return pd.DataFrame({"time": TIMES, "phase": phase, "volume_ml": 100 + 10 * shape} | {key: shape for key in KEYS[1:]})


@pytest.fixture
def patient(tmp_path: Path) -> Path:
    """Runs of sizes 1, 2, 3 at the start and of 4 at the answer; the image's is 5, tracked at 10 frames."""
    calibration = tmp_path / "calibration"
    sizes = {0: 1.0, 2: 2.0, 3: 3.0, 4: 4.0}
    for number, size in sizes.items():
        alpha, edp, _ = RUNS[number]
        run = calibration / "runs" / f"key{9 - number}"
        run.mkdir(parents=True)
        (run / "scene.toml").write_text(f"[materials.alpha]\nroof = {alpha}\n[loads]\nedp_mmhg = {edp}\n")
        course(size).to_csv(run / "transients.csv", index=False)
    frame = pd.DataFrame(RUNS, columns=["alpha_roof", "edp_mmhg", "status"])
    # as many derivatives as a real table has
    slopes = pd.DataFrame({f"dy{k}/dalpha_roof": np.zeros(5) for k in range(300)})
    pd.concat([frame, pd.DataFrame({"cpu_s": np.ones(5)}), slopes], axis=1).to_csv(calibration / "runs.csv", index=False)
    motion = tmp_path / "motion"
    motion.mkdir()
    time = np.arange(10) / 10
    shape = 5.0 * np.sin(np.pi * time) ** 2
    columns = {"time": time, "phase": "reservoir", "volume_ml": 100 + 10 * shape} | {key: shape for key in KEYS[1:]}
    pd.DataFrame(columns).to_csv(motion / "transients.csv", index=False)
    phases = {"es": 0.5, "conduit_end": 0.7, "booster_start": 0.8}
    (motion / "tracking.json").write_text(json.dumps({"phases": phases, "sd": dict.fromkeys(KEYS, 0.3), "shrinkage": None}))
    return tmp_path


def at(rows: list[dict[str, object]], feature: str, time: float) -> dict[str, object]:
    (row,) = (r for r in rows if r["feature"] == feature and abs(float(str(r["time"])) - time) < 1e-6)
    return row


def test_the_image_s_the_first_runs_and_the_answer_s(patient: Path) -> None:
    rows = transients("a", patient, RESULT)
    row = at(rows, "d_roof_mm", 0.4)
    # of the search's first three, as it counts them, one failed: 1 and 2; the fourth, of size 3, is the search's next stage
    assert (row["first_runs"], row["first_low"], row["first_median"], row["first_high"]) == (2, 1.0, 1.5, 2.0)
    assert row["used"] is False and at(transients("a", patient, RESULT, USED), "d_roof_mm", 0.4)["used"] is True
    assert row["at_map"] == 4.0 and row["image"] == pytest.approx(5.0 * np.sin(0.4 * np.pi) ** 2, rel=1e-3)
    assert row["image_sd"] == pytest.approx(0.3) and row["phase"] == "reservoir"
    assert at(rows, "volume_ml", 0.7)["at_map"] == 110.0 and at(rows, "volume_ml", 0.7)["phase"] == "conduit"
    assert at(rows, "d_roof_mm", 0.05)["image_sd"] == pytest.approx(0.15), "none at end-diastole"
    between = at(rows, "d_roof_mm", 0.3)
    assert between["at_map"] is None and between["first_runs"] == 0, "runs are known at their own times only"
    assert at(rows, "d_roof_mm", 0.9)["phase"] == "booster"

    by_used = over_transients(transients("a", patient, RESULT, USED))
    assert [(r["time"], r["used"]) for r in by_used if r["phase"] == "reservoir"] == [
        (0.2, False), (0.4, True), (None, False), (None, True),
    ]  # fmt: skip
    found = over_transients(rows)
    early, late, conduit, whole, _ = sorted(found, key=lambda r: (r["time"] is None, r["time"] or 0.0, r["phase"] != "reservoir"))
    image = 5.0 * np.sin(0.2 * np.pi) ** 2
    assert (early["time"], early["rmse_mm"]) == (0.2, pytest.approx(abs(2.0 - image), rel=1e-3))
    off = [2.0 - image, 4.0 - 5.0 * np.sin(0.4 * np.pi) ** 2]
    assert late["volume_rmse_ml"] == pytest.approx(10 * abs(off[1]), rel=1e-3) and conduit["phase"] == "conduit"
    assert (whole["phase"], whole["time"]) == ("reservoir", None)
    assert whole["rmse_mm"] == pytest.approx(np.sqrt(np.mean(np.square(off))), rel=1e-3)


def test_a_frame_of_which_any_feature_was_a_target_is_not_held_out(patient: Path) -> None:
    """A distance along normals is no row of the table, and yet the frame was fitted."""
    along = [{"feature": "n_roof_mm", "time": 0.2, "target": 2.0, "sd": 0.3}]
    rows = transients("a", patient, RESULT, along)
    assert {row["used"] for row in rows if row["time"] == 0.2} == {True}
    told = {r["time"]: r["used"] for r in over_transients(rows) if r["time"] is not None}
    assert told == {0.2: True, 0.4: False, 0.7: False}
    # no motion tells end-systole's time: the runs do, whose reservoir ends at .4
    of_es = {**RESULT, "fit": [{"feature": "my own"}, {"feature": "n_roof_mm"}]}
    (patient / "motion" / "tracking.json").unlink()
    assert {r["time"] for r in transients("a", patient, of_es) if r["used"]} == {0.4}


def test_without_a_tracked_motion_the_targets_stand_for_the_image(patient: Path) -> None:
    (patient / "motion" / "tracking.json").unlink()
    moments = [{"participant_id": "a", "feature": "d_roof_mm", "time": 0.2, "target": 2.5, "sd": 0.2, "at_map": 2.0}]
    rows = transients("a", patient, RESULT, moments)
    row = at(rows, "d_roof_mm", 0.2)
    assert (row["image"], row["image_sd"], row["at_map"], row["phase"]) == (2.5, 0.2, 2.0, "reservoir")
    assert at(rows, "d_roof_mm", 0.4)["image"] is None
    assert [r["rmse_mm"] for r in over_transients(rows)] == [pytest.approx(0.5)] * 2


def test_runs_that_are_gone_or_beside_the_answer_are_not_shown(patient: Path) -> None:
    moved = {**RESULT, "posterior": [{"input": "alpha_roof", "map": 2.2, "sd": 0.1}, RESULT["posterior"][1]]}
    assert {row["at_map"] for row in transients("a", patient, moved)} == {None}
    waves = {**RESULT, "waves": [{"runs": 2}]}
    assert at(transients("a", patient, waves), "d_roof_mm", 0.4)["first_high"] == 2.0
    (patient / "calibration" / "runs").rename(patient / "elsewhere")
    assert {row["first_runs"] for row in transients("a", patient, RESULT)} == {0}


def test_of_two_fidelities_at_one_place_the_row_s_own_is_taken(patient: Path) -> None:
    calibration = patient / "calibration"
    cheap = calibration / "runs" / "cheap"
    cheap.mkdir()
    (cheap / "scene.toml").write_bytes((calibration / "runs" / "key5" / "scene.toml").read_bytes())
    course(40.0).to_csv(cheap / "transients.csv", index=False)
    (cheap / "manifest.json").write_text('{"cpu_s": 0.1}')
    (calibration / "runs" / "key5" / "manifest.json").write_text('{"cpu_s": 1.0}')
    assert at(transients("a", patient, RESULT), "d_roof_mm", 0.4)["at_map"] == 4.0
