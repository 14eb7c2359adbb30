"""Calibration that seeks the posterior, on a simulator with known answers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from membranes import INPUTS, OUTPUTS, Membranes, box, respond

from lacli.base.errors import LacliError, UsageError
from lacli.calibration.sequential.calibration import calibrate_sequentially
from lacli.calibration.sequential.result import Sequential
from lacli.calibration.sequential.search import Settings
from lacli.contracts.targets import Targets
from lacli.inference.box import Box, make_box
from lacli.inference.runs import Outcome, RunLog, runs_identity
from lacli.inference.sampling.posterior import Settings as Sampling

QUICK = Settings(mcmc=Sampling(ess=600, rhat=1.05, max_steps=2000))


def targets_at(truth: np.ndarray, seed: int, sd: float = 0.1) -> Targets:
    """With errors that are correlated, drawn."""
    y, _ = respond(truth)
    correlation = 0.3 + 0.7 * np.eye(len(y))
    noise = sd * np.linalg.cholesky(correlation) @ np.random.default_rng(seed).standard_normal(len(y))
    return Targets(OUTPUTS, y + noise, np.full(len(y), sd), sd**2 * correlation)


def run(simulator: Membranes, targets: Targets, folder: Path, settings: Settings = QUICK) -> Sequential:
    log = RunLog(folder / "runs.csv", INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS))
    return calibrate_sequentially(simulator, box(), targets, settings, folder, log)


def exact(targets: Targets) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd of the posterior, by quadrature of the simulator itself over the box: first coarse, then where it is."""
    low, high = box().lower, box().upper
    inverse = np.linalg.inv(targets.covariance) if targets.covariance is not None else np.diag(targets.sd**-2)
    for _ in range(4):
        axes = [np.linspace(a, b, 31) for a, b in zip(low, high, strict=True)]
        x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        away = np.array([respond(point)[0] for point in x]) - targets.mean
        chi2 = np.einsum("mi,ij,mj->m", away, inverse, away)
        weight = np.exp(-0.5 * (chi2 - chi2.min()))
        weight /= weight.sum()
        mean = weight @ x
        sd = np.sqrt(weight @ (x - mean) ** 2)
        step = np.array([axis[1] - axis[0] for axis in axes])
        low = np.maximum(box().lower, mean - 6.0 * np.maximum(sd, step))
        high = np.minimum(box().upper, mean + 6.0 * np.maximum(sd, step))
    return mean, sd


def test_the_posterior_is_that_of_the_simulator_itself(tmp_path: Path) -> None:
    targets = targets_at(np.array([1.4, 1.5, 8.9]), 2)
    found = run(Membranes(), targets, tmp_path)
    mean, sd = exact(targets)
    flat = found.chain.flat()
    # sampling alone: an ESS of 600 leaves .04
    assert np.abs((flat.mean(0) - mean) / sd).max() < 0.15
    assert np.abs(flat.std(0) / sd - 1.0).max() < 0.12
    assert set(found.scores) == set(targets.names) and min(score["r2"] for score in found.scores.values()) > 0.9
    assert found.map_runs <= 20
    assert found.runs <= 60
    assert not found.refused
    assert found.sweep.elsewhere < 0.01


def test_an_interrupted_calibration_repeats_no_run_and_ends_the_same(tmp_path: Path) -> None:
    targets = targets_at(np.array([2.4, 1.4, 3.0]), 0)
    whole = run(Membranes(), targets, tmp_path / "whole")

    class Interrupted(Membranes):
        def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            for item in super().__call__(inputs):
                if self.calls > self.stop:
                    raise KeyboardInterrupt
                yield item

    calls = 0
    simulator: Membranes = Membranes()
    for stop in (2, 2, 2):
        simulator = Interrupted()
        simulator.stop = stop  # type: ignore[attr-defined]
        with pytest.raises(KeyboardInterrupt):
            run(simulator, targets, tmp_path / "parts")
        calls += stop
    simulator = Membranes()
    ended = run(simulator, targets, tmp_path / "parts")
    assert calls + simulator.calls == whole.runs
    assert np.array_equal(ended.x, whole.x)
    assert np.array_equal(ended.map_x, whole.map_x)
    assert np.array_equal(ended.chain.flat(), whole.chain.flat())


def test_a_folder_of_another_calibration_is_refused(tmp_path: Path) -> None:
    run(Membranes(), targets_at(np.array([2.4, 1.4, 3.0]), 0), tmp_path)
    with pytest.raises(UsageError, match="Choose another --out"):
        run(Membranes(), targets_at(np.array([2.4, 1.4, 3.0]), 1), tmp_path)


def test_runs_that_fail_in_a_part_of_the_box_are_gone_around(tmp_path: Path) -> None:
    truth = np.array([1.4, 1.5, 8.9])
    targets = targets_at(truth, 2)
    found = run(Membranes(fail=lambda x: x[0] < 0.6 or x[2] > 11.0), targets, tmp_path)
    mean, sd = exact(targets)
    assert found.failed > 0
    assert np.abs((found.chain.flat().mean(0) - mean) / sd).max() < 0.3


def test_runs_without_derivatives_are_said(tmp_path: Path) -> None:
    with pytest.raises(LacliError, match=r"tell no derivatives.*--method published"):
        run(Membranes(told=False), targets_at(np.array([2.4, 1.4, 3.0]), 0), tmp_path)


def test_a_simulator_that_only_fails_is_said(tmp_path: Path) -> None:
    with pytest.raises(LacliError, match="none finished"):
        run(Membranes(fail=lambda x: True), targets_at(np.array([2.4, 1.4, 3.0]), 0), tmp_path)


def test_targets_that_no_parameter_reaches_are_named(tmp_path: Path) -> None:
    given = targets_at(np.array([2.4, 1.4, 3.0]), 0)
    off = replace(given, mean=given.mean + 40.0 * (np.arange(12) == 4), covariance=None)
    found = run(Membranes(), off, tmp_path)
    assert "No parameter reaches" in found.refused
    assert "f4" in found.refused


def test_targets_that_contradict_each_other_are_said(tmp_path: Path) -> None:
    # neighbouring outputs are nearly functions of one another: one cannot be high where the other is low
    given = targets_at(np.array([2.4, 1.4, 3.0]), 0)
    off = replace(given, mean=given.mean + np.where(np.arange(12) % 2, 0.8, -0.8), covariance=None)
    found = run(Membranes(), off, tmp_path)
    assert "contradict" in found.refused


class Folded:
    """The first input acts through its square about the middle: two values are one."""

    inputs = ("a", "b")
    outputs = tuple(f"g{j}" for j in range(6))

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        for index, (a, b) in enumerate(inputs[list(self.inputs)].to_numpy(float)):
            y = [np.exp(-0.2 * j) * (a - 0.5) ** 2 * 4.0 + (0.5 + 0.1 * j) * b for j in range(6)]
            gradients = {}
            for j, name in enumerate(self.outputs):
                gradients[name, "a"] = 8.0 * np.exp(-0.2 * j) * (a - 0.5)
                gradients[name, "b"] = 0.5 + 0.1 * j
            yield index, Outcome(dict(zip(self.outputs, y, strict=True)), gradients=gradients)

    def determined_by(self, inputs: object) -> dict[str, str]:
        return {"model": "folded"}


def test_two_modes_are_both_found_and_both_sampled(tmp_path: Path) -> None:
    simulator = Folded()
    space: Box = make_box(simulator.inputs, (0.0, 0.0), (1.0, 1.0))
    truth = pd.DataFrame([[0.2, 0.6]], columns=list(simulator.inputs))
    y = np.array(list(next(simulator(truth))[1].outputs.values()))
    targets = Targets(simulator.outputs, y, np.full(6, 0.02))
    log = RunLog(tmp_path / "runs.csv", space.names, targets.names, runs_identity(simulator, space.names, targets.names))
    found = calibrate_sequentially(simulator, space, targets, QUICK, tmp_path, log)
    assert len(found.minima) == 2
    assert sorted(np.round(found.minima[:, 0], 2)) == pytest.approx([0.2, 0.8], abs=0.03)
    high = float((found.chain.flat()[:, 0] > 0.5).mean())
    # both modes are alike: half the posterior each (the two ensembles' shares scatter)
    assert 0.35 < high < 0.65


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say(tmp_path: Path) -> None:
    inside = total = 0
    for seed in range(20):
        rng = np.random.default_rng(1000 + seed)
        truth = box().from_unit(0.1 + 0.8 * rng.random(3))
        found = run(Membranes(), targets_at(truth, seed), tmp_path / str(seed))
        low, high = np.quantile(found.chain.flat(), [0.025, 0.975], axis=0)
        inside += int(((low <= truth) & (truth <= high)).sum())
        total += 3
    # 95 % of 60 is 57; three sds of the binomial, 1.7 each, below it
    assert inside >= 52
    assert total == 60
