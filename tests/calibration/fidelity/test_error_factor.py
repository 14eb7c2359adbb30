"""How much larger the simulator's errors are than stated, by what is left of the misfit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from membranes import INPUTS, OUTPUTS, Membranes, box, respond

from lacli.calibration.sequential.calibration import calibrate_sequentially
from lacli.calibration.sequential.evidence import Evidence
from lacli.calibration.sequential.fidelity.error_factor import error_factor
from lacli.calibration.sequential.result import Sequential, document
from lacli.calibration.sequential.search import Search, Settings
from lacli.contracts.targets import Targets
from lacli.inference.runs import RunLog, runs_identity
from lacli.inference.sampling.posterior import Settings as Sampling

P, D = 60, 5


def _left(s: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A linear model's residual at its best point, with errors s times as large as those stated, and the covariances."""
    rng = np.random.default_rng(seed)
    jacobian = 20.0 * rng.normal(size=(P, D))
    measured, common = np.diag(rng.uniform(0.5, 2.0, P) ** 2), rng.normal(size=(P, 6))
    added = 0.5 * common @ common.T + np.diag(rng.uniform(0.2, 1.0, P))
    error = rng.multivariate_normal(np.zeros(P), measured) + s * rng.multivariate_normal(np.zeros(P), added)
    precision = np.linalg.inv(measured + added)
    z = -np.linalg.solve(jacobian.T @ precision @ jacobian, jacobian.T @ precision @ error)
    return error + jacobian @ z, jacobian, measured, added


@pytest.mark.parametrize("s", [1.0, 3.0, 6.0])
def test_the_factor_that_errors_were_drawn_with_is_found(s: float) -> None:
    found = [error_factor(*_left(s, seed)) for seed in range(40)]
    value = np.array([f.value for f in found])
    # of 60 residuals about half tell of the errors, so ln s is known within about .15; errors are never taken for smaller
    assert np.median(value) == pytest.approx(s, rel=0.12)
    assert (value >= 1.0).all()
    # at the end of what is allowed the interval's own end is above it, by a fortieth of the distribution
    assert np.mean([f.low <= max(s, 1.2) and s <= f.high for f in found]) >= 0.85


def test_one_residual_tells_what_the_closed_form_says() -> None:
    """p = 1, no inputs to speak of, S = 1, A = 1: -ln(1 + s^2) / 2 - r^2 / (2 (1 + s^2)) - (ln s / ln 2)^2 / 2 is highest where
    s^2 (r^2 - 1 - s^2) / (1 + s^2)^2 = ln s / (ln 2)^2; at s = 2 that is r^2 = 5 + (25 / 4) / ln 2 = 14.017."""
    r = np.sqrt(5.0 + 6.25 / np.log(2.0))
    found = error_factor(np.array([r]), np.zeros((1, 1)), np.eye(1), np.eye(1))
    assert found.value == pytest.approx(2.0, rel=0.01)  # the grid's step


def test_what_inputs_can_take_up_tells_nothing() -> None:
    jacobian = 1e4 * np.eye(2)
    found = error_factor(np.array([50.0, -80.0]), jacobian, np.eye(2), np.eye(2))
    assert found.value == 1.0


def test_a_prior_that_forbids_what_inputs_would_take_up_makes_the_misfit_tell() -> None:
    """The input could take the residual up; its prior of sd 1e-4 about the best point does not: as without inputs."""
    r = np.array([np.sqrt(5.0 + 6.25 / np.log(2.0))])
    held = (np.zeros(1), np.array([[1e4]]))
    assert error_factor(r, np.array([[10.0]]), np.eye(1), np.eye(1)).value < 1.5
    assert error_factor(r, np.array([[10.0]]), np.eye(1), np.eye(1), held).value == pytest.approx(2.0, rel=0.01)


def test_errors_times_a_factor_leave_the_measurement_as_it_is() -> None:
    targets = Targets(("a", "b"), np.zeros(2), np.array([3.0, 1.0]))
    wide = targets.widened({"a": 4.0, "b": 2.0}, np.array([[1.0, 0.5], [0.5, 1.0]]))
    larger = wide.with_errors_times(2.0)
    # 9 + 4 * 16, 1 + 4 * 4; off the diagonal 4 * .5 * 4 * 2
    assert larger.covariance == pytest.approx(np.array([[73.0, 16.0], [16.0, 17.0]]))
    assert larger.sd == pytest.approx(np.sqrt([73.0, 17.0])) and larger.own_sd == pytest.approx([3.0, 1.0])
    assert larger.added == pytest.approx([8.0, 4.0])
    assert larger.select(["b"]).errors == pytest.approx(np.array([[16.0]]))
    assert targets.with_errors_times(2.0) is targets
    independent = targets.widened({"a": 4.0}).with_errors_times(3.0)
    assert independent.covariance is None and independent.sd == pytest.approx([np.sqrt(9.0 + 144.0), 1.0])


def _calibrated(folder: Path, infer: bool) -> Sequential:
    """To targets that no parameters give: off by three times the errors stated for the simulator, by turns."""
    y = respond(np.array([1.2, 1.8, 6.0]))[0]
    stated = 0.05
    off = 3.0 * stated * np.where(np.arange(len(y)) % 2, 1.0, -1.0)
    targets = Targets(OUTPUTS, y + off, np.full(len(y), 0.03)).widened(dict.fromkeys(OUTPUTS, stated))
    simulator = Membranes()
    log = RunLog(folder / "runs.csv", INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS))
    settings = Settings(max_runs=40, first_runs=6, mode_runs=4, infer_errors=infer, mcmc=Sampling(ess=300))
    return calibrate_sequentially(simulator, box(), targets, settings, folder, log)


def test_a_posterior_is_wider_where_the_misfit_says_that_errors_are_larger(tmp_path: Path) -> None:
    taken, stated = (_calibrated(tmp_path / str(infer), infer) for infer in (True, False))
    assert taken.error_factor is not None and stated.error_factor is None
    # residuals of .15 where .03 was measured: s = sqrt(.15^2 - .03^2) / .05 = 2.9 but for the prior and what inputs take up
    assert 1.8 < taken.error_factor.value < 3.2 and taken.error_factor.low < taken.error_factor.value < taken.error_factor.high
    assert any("times as large as stated" in note for note in taken.notes)
    assert not any("times as large as stated" in note for note in stated.notes)
    assert document(taken)["error_factor"]["value"] == taken.error_factor.value and document(stated)["error_factor"] is None
    wide = np.array([row["sd"] for row in taken.table]) / np.array([row["sd"] for row in stated.table])
    # all but the measurement's share of the errors is s times as large
    assert (wide > 1.5).all() and (wide < 1.1 * taken.error_factor.value).all()
    # what is told of each target says so: sd beside its own
    own = np.array([[row["sd"], row["own_sd"]] for row in taken.fit])
    assert own[:, 0] == pytest.approx(np.hypot(0.03, taken.error_factor.value * 0.05)) and own[:, 1] == pytest.approx(0.03)


def test_a_measurement_lost_beside_the_added_errors_is_no_failure() -> None:
    # own errors of a billionth of a millimetre, found as the difference of two covariances of 0.09 mm2: 1e-18 is below rounding
    p = 6
    added = 0.09 * (0.5 + 0.5 * np.eye(p))
    lower = np.linalg.cholesky(added + 1e-18 * np.eye(p))
    measured = lower @ lower.T - added
    # six errors of their own, three times as large as the sqrt(0.045) mm that differences have, no inputs to take them up
    residual = 3.0 * np.sqrt(0.045) * np.array([1.0, -1.0] * 3)
    found = error_factor(residual, np.zeros((p, 1)), measured, added)
    # the maximum of -p t - p 9 exp(-2 t) / 2 - (t / ln 2)^2 / 2
    t = np.linspace(0.0, 3.4, 100_001)
    expected = np.exp(t[np.argmax(-p * t - 0.5 * p * 9.0 * np.exp(-2.0 * t) - 0.5 * (t / np.log(2.0)) ** 2)])
    assert found.value == pytest.approx(expected, rel=0.01)


def test_the_factor_is_read_off_a_run_of_the_reference_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs: a cheap one, which its correction puts onto the targets, and the reference's own, off by what makes s = 2."""
    targets = Targets(("a",), np.zeros(1), np.ones(1)).widened({"a": 1.0})
    simulator = Membranes()
    log = RunLog(tmp_path / "runs.csv", INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS))
    search = Search(simulator, box(), targets, Settings(), log, lambda status: None)
    # the residual of the closed form above, in standard deviations of sqrt(1 + 1); no input moves it
    residual = np.array([[0.0], [np.sqrt((5.0 + 6.25 / np.log(2.0)) / 2.0)]])
    x = np.array([[1.0, 1.0, 5.0], [1.2, 1.8, 6.0]])
    still, none = np.zeros((2, 1, 3)), np.zeros((2, 1))
    evidence = Evidence(x, search.scale.to_z(x), residual, still, np.empty((0, 3)), 1, none, dear=np.array([False, True]))
    monkeypatch.setattr(search, "evidence", lambda: evidence)
    search.infer_errors(evidence)
    assert search.error_factor is not None and search.error_factor.value == pytest.approx(2.0, rel=0.01)
    assert evidence.best == 1 and replace(evidence, dear=None).best == 0
    # where none of the reference's own tells derivatives, the best that does
    untold = np.array([[[0.0, 0.0, 0.0]], [[np.nan, 0.0, 0.0]]])
    assert replace(evidence, jacobian=untold).best == 0
