"""Calibrations on runs done elsewhere: what their emulators, their notes and their refusals agree with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import lacli
from lacli.api import inference
from lacli.api.posterior import ELSEWHERE, posterior
from lacli.base.errors import LacliError, UsageError
from lacli.calibration.calibration import Calibration, Settings
from lacli.calibration.from_table import calibrate_table
from lacli.contracts.tables.table import read_one
from lacli.contracts.targets import Targets
from lacli.inference.box import Box, make_box
from lacli.inference.design import design
from lacli.inference.emulation.gradient_gp import GradientEmulators
from lacli.inference.runs import RunLog
from lacli.inference.sampling import posterior as mcmc

SETTINGS = Settings(starts=1, mcmc=mcmc.Settings(ess=100, rhat=1.2, max_steps=300))
NEAR_0 = make_box(["k", "b"], [0.0, 0.0], [5.0, 1.0])


def near_zero(x: np.ndarray) -> np.ndarray:
    """Two outputs of k and b; the first is steep at k = 0 and finite there."""
    k, b = x.T
    return np.c_[-np.log(k + 0.5) + 0.3 * b, b + 0.1 * k]


def goal(names: tuple[str, ...], at: np.ndarray, sd: float = 0.05) -> Targets:
    return Targets(names, at, np.full(len(names), sd))


def calibrated(folder: Path, frame: pd.DataFrame, targets: Targets, box: Box | None) -> Calibration:
    frame.to_csv(folder / "t.csv", index=False)
    return calibrate_table(folder / "t.csv", targets, box, SETTINGS, folder / "out", False, lambda status: None)[1]


def table_near_zero() -> pd.DataFrame:
    x = design(NEAR_0, 40)
    return pd.DataFrame(np.c_[x, near_zero(x)], columns=["k", "b", "y", "w"])


def test_an_input_whose_box_reaches_0_is_not_taken_as_its_logarithm(tmp_path: Path) -> None:
    result = calibrated(tmp_path, table_near_zero(), goal(("y", "w"), near_zero(np.array([[0.1, 0.5]]))[0]), NEAR_0)
    assert not result.emulators.log_share.any()
    edge = np.array([[0.0, 0.5], [1e-6, 0.5]])
    mean, variance = result.emulators.predict(edge)
    assert (np.abs(mean - near_zero(edge)) < 4 * np.sqrt(variance) + 1e-9).all()


def test_every_verb_refuses_a_box_at_whose_end_an_emulator_is_not_defined(tmp_path: Path) -> None:
    frame = table_near_zero()
    frame["y"] = np.log(frame["k"])  # nothing but its logarithm fits
    frame.to_csv(tmp_path / "t.csv", index=False)
    emulators = inference.fit(read_one(tmp_path / "t.csv", ["k", "b"], ["y"]))
    assert emulators.log_share[0] == 1.0
    targets = goal(("y",), np.array([0.0]))
    for verb in (
        lambda: inference.sensitivity(emulators, box=NEAR_0),
        lambda: inference.match(emulators, targets, box=NEAR_0),
        lambda: posterior(emulators, targets, tmp_path / "p", box=NEAR_0),
    ):
        with pytest.raises(UsageError, match="the box: k starts at 0; an emulator takes its logarithm"):
            verb()


WIDE = make_box(["a", "e"], [0.5, 5.0], [4.0, 9.0])


def straight(x: np.ndarray) -> np.ndarray:
    a, e = x.T
    return np.c_[100 - 12 * a + 2 * e, 8 - 2 * a + 0.3 * e]


def table_of_a_part() -> pd.DataFrame:
    """Runs where a is 0.5 to 1.5."""
    x = design(make_box(["a", "e"], [0.5, 5.0], [1.5, 9.0]), 40)
    return pd.DataFrame(np.c_[x, straight(x)], columns=["a", "e", "y", "w"])


def test_a_posterior_where_no_run_has_been_is_told_and_refused(tmp_path: Path) -> None:
    """a = 3 is beyond all runs; of the box, 2.5 / 3.5 = 71 % is (less the runs' margin of 2 runs in 40, 5 % of their range)."""
    table_of_a_part().to_csv(tmp_path / "t.csv", index=False)
    for at, refused in ((3.0, ELSEWHERE), (1.0, "")):
        targets = goal(("y", "w"), straight(np.array([[at, 7.0]]))[0])
        found = lacli.calibrate(None, targets, tmp_path / f"{at}", table=tmp_path / "t.csv", box=WIDE, settings=SETTINGS)
        assert found.refused == refused
        assert found.warnings[0].startswith("70.") and "of the box is where no run has been" in found.warnings[0]
        assert "a: runs 0.5" in found.warnings[0]
        assert any("of the posterior lies where no run has been" in text for text in found.warnings) == bool(refused)
        outside = json.loads((tmp_path / f"{at}" / "result.json").read_text())["outside_runs"]
        assert outside["box"] == pytest.approx(0.70, abs=0.01) and (outside["posterior"] > 0.95) == bool(refused)


def test_a_box_beside_the_runs_is_refused(tmp_path: Path) -> None:
    beside = make_box(["a", "e"], [3.0, 5.0], [4.0, 9.0])
    with pytest.raises(UsageError, match=r"100.0% of the box is where no run has been.*Narrow the box"):
        calibrated(tmp_path, table_of_a_part(), goal(("y", "w"), straight(np.array([[3.5, 7.0]]))[0]), beside)


def test_columns_that_vary_and_are_no_input_are_named(tmp_path: Path) -> None:
    """With the published ranges, and with a box that names fewer inputs than vary."""
    space = make_box(["alpha_septum", "edp_mmhg", "vein"], [0.5, 5.0, 0.5], [1.5, 9.0, 2.0])
    x = design(space, 40)
    y = straight(x[:, :2]) + 0.01 * x[:, 2:]
    frame = pd.DataFrame(np.c_[x, y], columns=[*space.names, "esv_ml", "d_septum_mm"])
    frame = frame.assign(d_roof_mm=frame["vein"], esv_ml_sd=0.1, mesh="fine", cpu_s=np.arange(40.0))  # none of them an input
    targets = goal(("esv_ml", "d_septum_mm"), straight(np.array([[1.0, 7.0]]))[0], sd=0.5)
    for number, (box, named) in enumerate(
        ((None, "vein varies"), (make_box(["vein"], [0.5], [2.0]), "alpha_septum, edp_mmhg vary"))
    ):
        (tmp_path / str(number)).mkdir()
        if box is not None:
            frame[["esv_ml", "d_septum_mm"]] = np.c_[frame["vein"], -frame["vein"]]
            targets = goal(("esv_ml", "d_septum_mm"), np.array([1.0, -1.0]), sd=0.5)
        notes = calibrated(tmp_path / str(number), frame, targets, box).waves[0].notes
        assert f"{named} between the runs" in notes[0] and "without being an input here" in notes[0]


def test_rows_of_the_same_inputs_are_those_of_the_table(tmp_path: Path) -> None:
    """Failed repeats of finished runs take nothing away; finished ones that contradict each other are told."""
    frame = table_of_a_part().assign(status="done")
    failed = frame.iloc[:10].assign(y=np.nan, w=np.nan, status="failed")
    other = frame.iloc[10:13].assign(y=frame["y"] + 0.1)
    pd.concat([frame, failed, other]).to_csv(tmp_path / "t.csv", index=False)
    log = RunLog(tmp_path / "t.csv", ("a", "e"), ("y", "w"), None)
    table = log.table(frame[["a", "e"]].to_numpy(), ("y", "w"))
    whole = read_one(tmp_path / "t.csv", ["a", "e"], ["y", "w"])
    assert table.runs == whole.runs == 43 and len(table.failed_x) == len(whole.failed_x) == 10
    for notes in (table.notes, whole.notes):
        assert any(text.startswith("3 run(s) have the inputs of another and other outputs") for text in notes)
    assert {tuple(row) for row in np.c_[table.x, table.y]} == {tuple(row) for row in np.c_[whole.x, whole.y]}


def wavy(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """sin(w x) and sin(w x) + a, (n, 2), with their derivatives (n, 4, 2)."""
    w = np.array([2.0, 1.0, 0.7, 0.4])
    value, slope = np.sin(x @ w), np.cos(x @ w)[:, None] * w
    return np.c_[value, value + x[:, 0]], np.stack([slope, slope + np.eye(4)[0]], axis=2)


def test_a_table_that_tells_derivatives_is_learnt_with_them(tmp_path: Path) -> None:
    """As every other reader of the table learns it; waves learn from values, as published."""
    space = make_box(list("abce"), [-1.0] * 4, [1.0] * 4)
    x = design(space, 16)
    y, slopes = wavy(x)
    frame = pd.DataFrame(np.c_[x, y], columns=[*space.names, "y", "w"])
    frame = frame.assign(**{f"d{o}/d{i}": slopes[:, j, p] for p, o in enumerate("yw") for j, i in enumerate(space.names)})
    targets = goal(("y", "w"), wavy(np.zeros((1, 4)))[0][0], sd=0.3)
    result = calibrated(tmp_path, frame, targets, space)
    own = inference.fit(read_one(tmp_path / "t.csv", space.names, ("y", "w")), box=space)
    at = space.uniform(200, np.random.default_rng(0))
    assert isinstance(result.emulators, GradientEmulators)
    assert np.array_equal(result.emulators.predict(at)[0], own.predict(at)[0])
    assert np.sqrt(np.mean((result.emulators.predict(at)[0] - wavy(at)[0]) ** 2)) < 0.15


def test_where_no_point_agrees_it_is_told_that_no_run_has_been_there(tmp_path: Path) -> None:
    targets = goal(("y", "w"), np.array([500.0, 500.0]))
    with pytest.raises(LacliError, match=r"no point of the box agrees with all targets.*70\.\d% of the box is where no run has"):
        calibrated(tmp_path, table_of_a_part(), targets, WIDE)
