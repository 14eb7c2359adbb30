"""Frames that a wall reaches on either side: found from values and derivatives, left out and told; and priors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.calibration.sequential import branches
from lacli.calibration.sequential.calibration import calibrate_sequentially
from lacli.calibration.sequential.evidence import gather, narrowed
from lacli.calibration.sequential.result import Sequential
from lacli.calibration.sequential.scale import Scale
from lacli.calibration.sequential.search import Settings
from lacli.contracts.priors import Prior
from lacli.contracts.targets import Targets
from lacli.inference.box import Box, make_box
from lacli.inference.runs import Outcome, RunLog, runs_identity
from lacli.inference.sampling.posterior import Settings as Sampling

INPUTS = ("alpha_roof", "edp_mmhg")
ES = ("d_roof_mm", "n_roof_mm", "a_roof_mm", "b_roof_mm", "d_septum_mm")
EARLY = ("b_roof_mm@0.1", "a_roof_mm@0.1")
QUICK = Settings(mcmc=Sampling(ess=600, rhat=1.05, max_steps=2000))


class Swinging:
    """At end-systole smooth; in an early frame the wall swings to either side where it is soft: which, no parameter tells."""

    def __init__(self, swing: float = 5.0) -> None:
        self.swing = swing

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        for index, (a, p) in enumerate(inputs[list(INPUTS)].to_numpy(float)):
            y, slope = {}, {}
            for j, name in enumerate(ES):
                stiff = 1.0 + (0.4 + 0.2 * j) * a
                y[name] = (p + 4.0 + j) / stiff
                slope[name, "alpha_roof"], slope[name, "edp_mmhg"] = -(p + 4.0 + j) * (0.4 + 0.2 * j) / stiff**2, 1.0 / stiff
            # digits of the inputs that no search knows of
            side = 1.0 if int(1e6 * (a + p)) % 2 else -1.0
            for name in EARLY:
                y[name] = 0.1 * p + (side * self.swing * (2.0 - a) if a < 2.0 else 0.0)
                slope[name, "alpha_roof"], slope[name, "edp_mmhg"] = (-side * self.swing if a < 2.0 else 0.0), 0.1
            yield index, Outcome(y, gradients=slope, cpu_s=1.0)

    def determined_by(self, inputs: object) -> dict[str, float]:
        return {"swing": self.swing}


def space() -> Box:
    return make_box(INPUTS, (0.125, 1.0), (4.0, 12.0))


def targets_at(x: tuple[float, float], priors: tuple[Prior, ...] | None = None) -> Targets:
    y = next(iter(Swinging()(pd.DataFrame([x], columns=list(INPUTS)))))[1].outputs
    names = (*ES, *EARLY)
    return Targets(names, np.array([y[name] for name in names]), np.full(len(names), 0.1), None, priors)


def log_of(simulator: Swinging, targets: Targets, folder: Path) -> RunLog:
    return RunLog(folder / "runs.csv", INPUTS, targets.names, runs_identity(simulator, INPUTS, targets.names))


def calibrated(targets: Targets, folder: Path, swing: float = 5.0) -> Sequential:
    simulator = Swinging(swing)
    return calibrate_sequentially(simulator, space(), targets, QUICK, folder, log_of(simulator, targets, folder))


def test_a_frame_of_two_states_is_left_out_and_told(tmp_path: Path) -> None:
    found = calibrated(targets_at((1.0, 6.0)), tmp_path)
    assert found.left_out == EARLY
    assert found.targets.names == ES
    assert any("2 targets are left out, all of the frames at 0.1" in note for note in found.notes)
    row = found.table[0]
    assert float(row["low95"]) < 1.0 < float(row["high95"])


def test_a_frame_of_one_state_is_kept(tmp_path: Path) -> None:
    found = calibrated(targets_at((3.0, 6.0)), tmp_path, swing=0.0)
    assert found.left_out == ()
    assert found.targets.names == (*ES, *EARLY)


def test_one_run_elsewhere_is_left_out_by_itself(tmp_path: Path) -> None:
    simulator, targets = Swinging(0.0), targets_at((3.0, 6.0))
    log = log_of(simulator, targets, tmp_path)
    x = np.array([[3.0 + 0.05 * i, 6.0] for i in range(12)])
    log.run(simulator, x)
    log.rows[tuple(x[5])]["b_roof_mm@0.1"] = 9.0
    seen = branches.look(gather(log, x, targets, Scale.of(space())), targets)
    assert seen.times == ()
    assert seen.strays.tolist() == [i == 5 for i in range(12)]


@pytest.mark.parametrize("kind", ["normal", "lognormal"])
def test_a_prior_is_a_square_of_its_own(kind: str, tmp_path: Path) -> None:
    prior = Prior("alpha_roof", kind, 1.2, 0.3)  # type: ignore[arg-type]
    simulator, targets = Swinging(0.0), targets_at((1.0, 6.0), (prior,))
    log, scale = log_of(simulator, targets, tmp_path), Scale.of(space())
    x = np.array([[0.8, 6.0], [1.2, 6.0], [1.9, 6.0]])
    log.run(simulator, x)
    found = gather(log, x, targets, scale)
    assert found.targets == len(targets.names)
    of_prior = -0.5 * (found.misfit - found.chi2)
    density = prior.log_density(x[:, 0])
    assert np.diff(of_prior) == pytest.approx(np.diff(density), rel=1e-9)
    h = 1e-6
    near = scale.to_x(found.z + np.array([h, 0.0]))
    log.run(simulator, near)
    moved = gather(log, near, targets, scale)
    assert (moved.residual[:, -1] - found.residual[:, -1]) / h == pytest.approx(found.jacobian[:, -1, 0], rel=1e-4)


def test_priors_decide_what_targets_leave_open(tmp_path: Path) -> None:
    # one target, two inputs: along the valley only the priors tell, and ends cut off
    names = ("d_roof_mm",)
    y = next(iter(Swinging()(pd.DataFrame([(1.0, 6.0)], columns=list(INPUTS)))))[1].outputs["d_roof_mm"]
    prior = Prior("edp_mmhg", "normal", 7.0, 0.5, 6.0, 12.0)
    targets = Targets(names, np.array([y]), np.array([0.1]), None, (prior,))
    found = calibrated(targets, tmp_path)
    flat = found.chain.flat()
    assert flat[:, 1].min() >= 6.0
    # quadrature of the simulator itself
    a, p = np.meshgrid(np.linspace(0.125, 4.0, 400), np.linspace(6.0, 12.0, 400), indexing="ij")
    log = -0.5 * (((p + 4.0) / (1.0 + 0.4 * a) - y) / 0.1) ** 2 - 0.5 * ((p - 7.0) / 0.5) ** 2
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    for i, exact in enumerate((a, p)):
        mean = float((weight * exact).sum())
        sd = float(np.sqrt((weight * (exact - mean) ** 2).sum()))
        assert abs(flat[:, i].mean() - mean) < 0.15 * sd
        assert flat[:, i].std() == pytest.approx(sd, rel=0.12)


def test_ends_of_priors_narrow_the_box() -> None:
    box = narrowed(space(), targets_at((1.0, 6.0), (Prior("edp_mmhg", "uniform", np.nan, np.nan, 4.0, 9.0),)))
    assert box.lower.tolist() == [0.125, 4.0]
    assert box.upper.tolist() == [4.0, 9.0]
