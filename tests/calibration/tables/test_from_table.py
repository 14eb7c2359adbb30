"""Calibrations on runs done elsewhere: what their emulators, their notes and their refusals agree with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.api import inference
from lacli.api.posterior import posterior
from lacli.base.errors import UsageError
from lacli.calibration.calibration import Calibration, Settings
from lacli.calibration.from_table import calibrate_table
from lacli.contracts.tables.table import read_one
from lacli.contracts.targets import Targets
from lacli.inference.box import Box, make_box
from lacli.inference.design import design
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
