"""Runs that say of themselves that they have two equilibria: errors, columns, and that no calibration takes them for smooth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from membranes import INPUTS, OUTPUTS, Membranes, box, respond

from lacli.calibration.sequential import branches
from lacli.calibration.sequential.calibration import calibrate_sequentially
from lacli.calibration.sequential.evidence import gather
from lacli.calibration.sequential.scale import Scale
from lacli.calibration.sequential.search import Settings
from lacli.calibration.simulator import _outcome
from lacli.contracts.tables.table import is_bookkeeping, read_frame
from lacli.contracts.targets import Targets
from lacli.inference.runs import Outcome, RunLog, runs_identity
from lacli.inference.sampling.posterior import Settings as Sampling
from lacli.mechanics.simulation import RunResult

QUICK = Settings(mcmc=Sampling(ess=600, rhat=1.05, max_steps=2000))
APART, SD = 3.0, 0.1


class Torn(Membranes):
    """Soft roofs may have two states, ``APART`` apart in each output; which one a run shows no parameter tells, that there are
    two the run does."""

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        for index, outcome in super().__call__(inputs):
            x = inputs[list(INPUTS)].to_numpy(float)[index]
            digits = int(1e6 * x.sum()) % 4 if x[0] < 1.4 else 0
            y = {name: value + APART * (digits == 1) for name, value in outcome.outputs.items()}
            yield index, replace(outcome, outputs=y, spread=dict.fromkeys(y, APART * (digits > 0)))


def targets_at(x: tuple[float, float, float]) -> Targets:
    return Targets(OUTPUTS, respond(np.array(x))[0], np.full(len(OUTPUTS), SD), None)


def log_of(simulator: Membranes, folder: Path) -> RunLog:
    return RunLog(folder / "runs.csv", INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS))


def run_result(folder: Path, **more: object) -> RunResult:
    return RunResult("k", folder, "done", None, "", {"esv_ml": 100.0, "d_roof_mm": 5.0, **more}, {})


def test_half_the_spread_is_an_error_of_the_run(tmp_path: Path) -> None:
    # two states, one as likely as the other, 3 mL apart: sd 1.5 mL; with .8 mL of discretisation sqrt(2.25 + .64) = 1.7
    found = _outcome(run_result(tmp_path, equilibria_spread={"esv_ml": 3.0, "d_roof_mm": 0.4}), {"esv_ml": 0.8}, framed=False)
    assert found.errors == pytest.approx({"esv_ml": 1.7, "d_roof_mm": 0.2})
    assert found.spread == {"esv_ml": 3.0, "d_roof_mm": 0.4}
    untold = _outcome(run_result(tmp_path), {"esv_ml": 0.8}, framed=False)
    assert (untold.errors, untold.spread) == ({"esv_ml": 0.8}, {})


def test_a_feature_at_the_time_of_end_systole_has_its_spread(tmp_path: Path) -> None:
    pd.DataFrame({"time": [0.0, 0.4], "phase": ["ed", "reservoir"], "d_roof_mm": [0.0, 5.0]}).to_csv(tmp_path / "transients.csv")
    found = _outcome(run_result(tmp_path, equilibria_spread={"esv_ml": 3.0, "d_roof_mm": 0.4}), {}, framed=True)
    assert found.spread == {"esv_ml": 3.0, "volume_ml@0.4": 3.0, "d_roof_mm": 0.4, "d_roof_mm@0.4": 0.4}
    assert found.errors["d_roof_mm@0.4"] == pytest.approx(0.2)


def test_spreads_are_kept_in_a_table_and_are_no_outputs(tmp_path: Path) -> None:
    simulator = Torn()
    x = np.array([[1.0, 1.0, 5.0 + 1e-6 * i] for i in range(4)] + [[3.0, 1.0, 5.0]])
    log_of(simulator, tmp_path).run(simulator, x)
    again = RunLog(tmp_path / "runs.csv", INPUTS, OUTPUTS, None)
    spread = again.spread(x, OUTPUTS[:2])
    assert sorted(spread[:4, 0].tolist()) == [0.0, APART, APART, APART]
    assert spread[4].tolist() == [0.0, 0.0]
    frame = read_frame(tmp_path / "runs.csv")
    told = [name for name in frame.columns if name.endswith("_equilibria_spread")]
    assert len(told) == len(OUTPUTS)
    assert all(is_bookkeeping(name) for name in told)
    plain = Membranes()
    (tmp_path / "plain").mkdir()
    log = log_of(plain, tmp_path / "plain")
    log.run(plain, x)
    assert not any("spread" in name for name in read_frame(tmp_path / "plain" / "runs.csv").columns)
    assert gather(log, x, targets_at((1.0, 1.0, 5.0)), Scale.of(box())).spread.tolist() == np.zeros((5, 12)).tolist()


def test_runs_with_two_equilibria_are_set_aside_but_for_the_best_one(tmp_path: Path) -> None:
    simulator, targets = Torn(), targets_at((1.0, 1.0, 5.0))
    x = np.array([[1.0 + 0.1 * i, 1.0, 5.0] for i in range(8)])
    log = log_of(simulator, tmp_path)
    log.run(simulator, x)
    for i, point in enumerate(x):
        # of a run in the middle they are apart by less than the target's error
        apart = {1: APART, 2: 0.9 * SD, 6: APART}.get(i, 0.0)
        y = respond(point)[0]
        log.rows[tuple(point)] |= {name: value + (apart if i == 6 else 0.0) for name, value in zip(OUTPUTS, y, strict=True)}
        log.rows[tuple(point)] |= {f"{name}_equilibria_spread": apart for name in OUTPUTS}
    found = gather(log, x, targets, Scale.of(box()))
    assert found.spread[1] == pytest.approx(np.full(12, APART / SD))
    seen = branches.look(found, targets)
    assert seen.torn.tolist() == [i in (1, 6) for i in range(8)]
    assert seen.strays.tolist() == seen.torn.tolist()
    for name in OUTPUTS:
        log.rows[tuple(x[0])][f"{name}_equilibria_spread"] = APART
    seen = branches.look(gather(log, x, targets, Scale.of(box())), targets)
    assert seen.torn.tolist() == [i in (0, 1, 6) for i in range(8)]
    assert seen.strays.tolist() == [i in (1, 6) for i in range(8)]  # the run at the targets stays


def test_a_calibration_goes_on_without_them_and_says_so(tmp_path: Path) -> None:
    truth = (1.3, 1.5, 6.0)
    simulator = Torn()
    found = calibrate_sequentially(simulator, box(), targets_at(truth), QUICK, tmp_path, log_of(simulator, tmp_path))
    assert any("runs have two equilibria" in note and "left out" in note for note in found.notes)
    assert not found.refused
    for row, value in zip(found.table, truth, strict=True):
        assert float(row["low95"]) < value < float(row["high95"])
        assert math.isfinite(float(row["map"]))
