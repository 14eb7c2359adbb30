"""The calibration driver on an analytic simulator: recovery, resume at any moment, failures, tables of others."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.base.errors import InputError, LacliError, UsageError
from lacli.calibration.calibration import Settings, calibrate
from lacli.calibration.synthetic_truth import targets_at, verify
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.runs import Outcome, RunLog, runs_identity
from lacli.inference.sampling import posterior as mcmc

BOX = make_box(["a", "b", "c"], [0.2, 0.2, 0.0], [4.0, 4.0, 1.0])
NAMES = ("v_ml", "d_one_mm", "d_two_mm")
TRUTH = np.array([1.0, 2.0, 0.4])
SETTINGS = Settings(first_runs=40, wave_runs=15, max_waves=3, starts=1, draws=3, mcmc=mcmc.Settings(ess=1500.0, walkers=20))


def function(x):
    a, b, c = x.T
    return np.c_[50 + 10 / a + 5 * c, 3 / np.sqrt(a) + c, 4 / b + 0.5 * c]


class Simulator:
    """Counts its runs; fails where told; may be cut off after some runs; finishes in a shuffled order."""

    def __init__(self, limit=10**9, fails=lambda x: np.zeros(len(x), bool), seed=0):
        self.count, self.limit, self.fails, self.seed = 0, limit, fails, seed

    def determined_by(self, inputs):
        return {"of": "three inputs"}

    def __call__(self, inputs):
        x = inputs.to_numpy(float)
        y, failed = function(x), self.fails(x)
        for i in np.random.default_rng(self.seed).permutation(len(x)):
            if self.count >= self.limit:
                raise KeyboardInterrupt
            self.count += 1
            yield (
                int(i),
                Outcome({}, "failed", "inverted_element") if failed[i] else Outcome(dict(zip(NAMES, y[i].tolist(), strict=True))),
            )


def targets(displacement=0.05, volume=0.01):
    return targets_at(dict(zip(NAMES, function(TRUTH[None])[0].tolist(), strict=True)), NAMES, displacement, volume)


def run(folder, simulator, settings=SETTINGS, goal=None):
    log = RunLog(folder / "runs.csv", BOX.names, NAMES, runs_identity(simulator, BOX.names, NAMES))
    return calibrate(simulator, BOX, goal or targets(), settings, folder, log)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(folder, Simulator())


def test_the_truth_is_recovered(whole):
    _, result = whole
    for row, truth in zip(result.table, TRUTH, strict=True):
        assert row["low95"] < truth < row["high95"]
    shares = [w.share for w in result.waves]
    assert shares[-1] <= shares[0] < 0.5
    last = result.waves[-1]
    assert set(last.ise) == set(last.r2) and min(last.ise.values()) > 0.85, "95 % of the runs within 2 sd, each left out"
    assert result.rmse_mm < 0.05  # the simulation at the most probable point against the targets' own 0.05 mm
    for row in result.fit:
        assert row["simulated"] == pytest.approx(row["emulated"], abs=4 * row["emulator_sd"] + 1e-6)
    assert result.draws.shape == (3, 3)


def same(folder, other):
    for name in ("result.json", "calibration.json"):
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name
    assert np.array_equal(mcmc.load_chain(folder / "chain.npz").samples, mcmc.load_chain(other / "chain.npz").samples)


def test_interrupted_and_started_again_it_ends_the_same_and_repeats_no_run(whole, tmp_path):
    total, starts = 0, 0
    for starts in range(1, 100):
        simulator = Simulator(limit=17, seed=starts)
        try:
            run(tmp_path, simulator)
            total += simulator.count
            break
        except KeyboardInterrupt:
            total += simulator.count
    assert starts > 2
    same(tmp_path, whole[0])
    assert total == len(pd.read_csv(whole[0] / "runs.csv"))


SCRIPT = """
import sys, time
from pathlib import Path
sys.path.insert(0, {root!r})
from tests.calibration import test_waves as t
class Slow(t.Simulator):
    def __call__(self, inputs):
        for item in super().__call__(inputs):
            time.sleep(0.01)
            yield item
t.run(Path({folder!r}), Slow())
"""


def test_kill_at_any_moment_and_rerun(whole, tmp_path):
    root = str(Path(__file__).parents[2])
    script = SCRIPT.format(root=root, folder=str(tmp_path))
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    for seconds in (1.5, 2.2, 2.9, 3.6, 4.3):
        process = subprocess.Popen(
            [sys.executable, "-c", script], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        end = time.monotonic() + seconds
        while time.monotonic() < end and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.wait()
    run(tmp_path, Simulator())
    same(tmp_path, whole[0])


def test_verification_by_synthetic_truth(tmp_path):
    simulator = Simulator()
    levels = verify(simulator, BOX, NAMES, TRUTH, replace(SETTINGS, max_waves=1), tmp_path, lambda status: None)
    assert [r.level for r in levels] == ["baseline", "high"]
    assert all(r.inside >= 2 and r.outside_posterior == 0 for r in levels)
    widths = [np.array([row["high95"] - row["low95"] for row in r.rows]) for r in levels]
    assert (widths[1] > widths[0]).all()  # more noise, less known
    assert simulator.count == 1 + 40 + 2 * 4  # the truth, one wave for both levels, the answer and three draws of each


def test_a_verification_tries_again_what_the_machine_ended(tmp_path):
    """The truth's own run, ended three times, is given up until it is asked for again."""

    class Ended(Simulator):
        def __call__(self, inputs):
            self.count += len(inputs)
            yield from ((i, Outcome({}, "failed", "out_of_memory")) for i in range(len(inputs)))

    def verified(simulator, retry):
        return verify(simulator, BOX, NAMES, TRUTH, replace(SETTINGS, max_waves=1), tmp_path, lambda status: None, retry)

    for simulator, asked in ((Ended(), 3), (Ended(), 0)):
        with pytest.raises(LacliError, match=r"ended by the machine 3 times or more.*call again with --retry"):
            verified(simulator, False)
        assert simulator.count == asked
    again = Simulator(limit=1)
    with pytest.raises(KeyboardInterrupt):  # the truth is run, and the first wave begins
        verified(again, True)
    assert again.count == 1 and (pd.read_csv(tmp_path / "runs.csv")["status"] == "done").all()


def test_failures_are_counted_and_avoided(tmp_path):
    simulator = Simulator(fails=lambda x: x[:, 0] < 0.6)
    result = run(tmp_path, simulator, replace(SETTINGS, max_waves=2))
    assert result.waves[0].failed > 2
    assert any("runs failed" in note for note in result.waves[0].notes)
    assert result.waves[1].failed - result.waves[0].failed <= 2


def test_targets_that_nothing_reaches(tmp_path):
    goal = Targets(NAMES, np.array([500.0, 3.4, 2.2]), np.array([1.0, 0.05, 0.05]))
    with pytest.raises(LacliError, match=r"no point of the box agrees with all targets: .* v_ml is .* target is 500"):
        run(tmp_path, Simulator(), goal=goal)


def test_a_folder_holds_one_calibration(whole, tmp_path):
    with pytest.raises(UsageError, match=r"a calibration made from something else: targets\.sd\.d_one_mm was 0\.05, is 0\.2"):
        run(whole[0], Simulator(), goal=targets(0.2))


@pytest.mark.parametrize("name", ["region.npz", "emulators.npz"])
def test_a_damaged_intermediate_is_named_and_can_be_removed(whole, tmp_path, name):
    folder, result = whole
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    file = sorted(copy.rglob(name))[0]
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=re.escape(str(file))):
        run(copy, Simulator())
    file.unlink()
    simulator = Simulator()
    again = run(copy, simulator)
    assert simulator.count == 0 and again.table == result.table


def test_budgets_stop_and_say_so(tmp_path):
    result = run(tmp_path, Simulator(), replace(SETTINGS, max_runs=50))
    assert len(result.waves) == 1 and result.stopped == "50 runs were allowed"


def test_runs_done_elsewhere(tmp_path):
    from lacli.inference.design import design

    x = design(BOX, 60)
    frame = pd.DataFrame(np.c_[x, function(x)], columns=[*BOX.names, *NAMES])
    frame.to_csv(tmp_path / "table.csv", index=False)
    log = RunLog(tmp_path / "table.csv", BOX.names, NAMES, None)
    result = calibrate(None, BOX, targets(), SETTINGS, tmp_path / "out", log, given=x)
    assert len(result.waves) == 1 and result.stopped == "runs from a table" and result.rmse_mm is None
    for row, truth in zip(result.table, TRUTH, strict=True):
        assert row["low95"] < truth < row["high95"]
    assert json.loads((tmp_path / "out" / "result.json").read_text())["waves"][0]["runs"] == 60


def test_a_first_wave_beyond_the_budget_is_refused(tmp_path):
    with pytest.raises(UsageError, match="40 runs are more than the 30 allowed"):
        run(tmp_path, Simulator(), replace(SETTINGS, max_runs=30))


def test_known_discretisation_errors_reach_emulator_and_likelihood(tmp_path):
    from lacli.inference.design import design

    x = design(BOX, 60)
    frame = pd.DataFrame(np.c_[x, function(x)], columns=[*BOX.names, *NAMES])
    frame["d_two_mm_discretisation_error"] = 0.3
    frame.to_csv(tmp_path / "table.csv", index=False)
    log = RunLog(tmp_path / "table.csv", BOX.names, NAMES, None)
    result = calibrate(None, BOX, targets(), SETTINGS, tmp_path / "out", log, given=x)
    assert [np.sqrt(result.emulators.error_variance(j, x[:1])[0]) for j in range(3)] == pytest.approx([0.0, 0.0, 0.3])
    # d_two alone tells b = 4 / (d_two - c / 2) = 4 / 2 at the truth: db = 4 / 2^2 * 0.3 = 0.3 at least
    assert float(result.table[1]["sd"]) > 0.3
    assert result.fit[2]["sd"] == 0.05  # the targets as given are what is shown
