"""The parts of the calibration that seeks the posterior: emulator, steps, draws."""

from __future__ import annotations

import numpy as np
import pytest
from membranes import box, respond

from lacli.calibration.sequential import emulator
from lacli.calibration.sequential.change import expected_change
from lacli.calibration.sequential.descent import levenberg, lowest
from lacli.calibration.sequential.laplace import Laplace, spread_out
from lacli.calibration.sequential.scale import Scale
from lacli.calibration.simulator import times_of
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box


def runs(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    scale = Scale.of(box())
    z = np.random.default_rng(seed).random((count, 3))
    x = scale.to_x(z)
    found = [respond(point) for point in x]
    jacobian = np.array([slope for _, slope in found]) * scale.slope(x)[:, None, :]
    return z, np.array([y for y, _ in found]), jacobian


def test_the_scale_s_slope_is_its_derivative() -> None:
    scale = Scale.of(make_box(("a", "b"), (0.1, -1.0), (4.0, 3.0)))
    assert scale.logged.tolist() == [True, False]
    z = np.array([[0.3, 0.6]])
    h = 1e-6
    difference = (scale.to_x(z + h) - scale.to_x(z - h)) / (2 * h)
    assert difference == pytest.approx(scale.slope(scale.to_x(z)), rel=1e-8)
    assert scale.to_z(scale.to_x(z)) == pytest.approx(z)
    assert scale.to_x(np.array([[0.0, 1.0]])).tolist() == [[0.1, 3.0]]


def test_the_kernel_s_blocks_are_derivatives_of_its_values() -> None:
    lengths, h = np.array([0.4, 0.9]), 1e-4
    a, b = np.array([[0.3, 0.7]]), np.array([[0.5, 0.2]])
    all_, none = np.ones(1, bool), np.zeros(1, bool)
    k = emulator._kernel(a, all_, b, all_, lengths)

    def value(p: np.ndarray, q: np.ndarray) -> float:
        return float(emulator._kernel(p, none, q, none, lengths)[0, 0])

    for i in range(2):
        e = h * np.eye(2)[i : i + 1]
        assert k[0, 1 + i] == pytest.approx((value(a, b + e) - value(a, b - e)) / (2 * h), rel=1e-6)
        assert k[1 + i, 0] == pytest.approx((value(a + e, b) - value(a - e, b)) / (2 * h), rel=1e-6)
        for j in range(2):
            f = h * np.eye(2)[j : j + 1]
            mixed = value(a + e, b + f) - value(a + e, b - f) - value(a - e, b + f) + value(a - e, b - f)
            assert k[1 + i, 1 + j] == pytest.approx(mixed / (4 * h * h), rel=1e-5, abs=1e-6)


def test_an_emulator_with_derivatives_is_far_better_than_its_values_alone() -> None:
    z, y, jacobian = runs(20)
    test_z, test_y, _ = runs(200, 1)
    with_ = emulator.fit(z, y, jacobian)
    without = emulator.fit(z, y, np.full_like(jacobian, np.nan))
    errors = []
    for fitted in (with_, without):
        mean, variance = fitted.predict(test_z)
        error = mean - test_y @ fitted.rotation
        errors.append(float(np.sqrt((error**2).sum(1).mean())))
        # what it says of its error, over all components, against the error: within a factor of 3 either way
        ratio = (error**2).sum() / variance.sum()
        assert 0.1 < ratio < 9.0
    assert errors[0] < 0.35 * errors[1]


def test_an_emulator_keeps_the_runs_and_its_slope_is_its_mean_s() -> None:
    z, y, jacobian = runs(12)
    fitted = emulator.fit(z, y, jacobian)
    assert fitted.mean(z) == pytest.approx(y @ fitted.rotation, abs=1e-2 * np.ptp(y))
    assert fitted.share(z).max() < 1e-3
    point, h = np.array([0.4, 0.3, 0.8]), 1e-5
    for i in range(3):
        e = h * np.eye(3)[i]
        difference = (fitted.mean((point + e)[None]) - fitted.mean((point - e)[None]))[0] / (2 * h)
        assert fitted.slope(point)[:, i] == pytest.approx(difference, abs=1e-5 * np.abs(jacobian).max())


def test_a_planned_run_lowers_the_variance_as_the_run_itself_will() -> None:
    z, y, jacobian = runs(9)
    fitted = emulator.fit(z[:8], y[:8], jacobian[:8])
    joined = fitted.joined_by(z[8:])
    there = np.random.default_rng(4).random((50, 3))
    assert (joined.share(there) <= fitted.share(there) + 1e-12).all()
    assert joined.share(z[8:])[0] < 1e-3 < fitted.share(z[8:])[0] * 1e3


def test_the_expected_change_falls_with_runs() -> None:
    rng = np.random.default_rng(0)
    draws = 0.5 + 0.05 * rng.standard_normal((500, 3))
    found = []
    for count in (6, 30):
        z, y, jacobian = runs(count)
        target = np.array(respond(Scale.of(box()).to_x(np.full((1, 3), 0.5))[0])[0])
        fitted = emulator.fit(z, (y - target) / 0.1, jacobian / 0.1)
        found.append(float(expected_change(fitted, draws, np.random.default_rng(1)).max()))
    assert found[1] < 0.5 * found[0]


def test_a_damped_step_keeps_to_box_and_radius() -> None:
    residual, jacobian = np.array([10.0, -4.0]), np.array([[1.0, 0.0], [0.0, 100.0]])
    step, expected = levenberg(residual, jacobian, np.array([0.1, 0.5]), 0.0, 0.35)
    # undamped the step is (-10, .04): the first is stopped at the end of the box
    assert step == pytest.approx([-0.1, 0.04], abs=1e-6)
    # 10^2 - 9.9^2 + 4^2
    assert expected == pytest.approx(100.0 - 9.9**2 + 16.0, rel=1e-6)


def test_the_lowest_point_of_an_emulator_is_the_truth() -> None:
    z, y, jacobian = runs(20)
    truth = np.array([0.6, 0.4, 0.5])
    target = respond(Scale.of(box()).to_x(truth[None])[0])[0]
    fitted = emulator.fit(z, (y - target) / 0.1, jacobian / 0.1)
    found, misfit = lowest(fitted, np.full(3, 0.5))
    assert found == pytest.approx(truth, abs=0.03)
    assert misfit < 2.0


def test_draws_of_a_truncated_gaussian_have_its_moments() -> None:
    precision = np.linalg.inv(np.array([[0.01, 0.006], [0.006, 0.01]]))
    inner = Laplace(np.array([0.5, 0.5]), precision).draw(4000, 1.0, np.random.default_rng(0))
    assert np.cov(inner.T) == pytest.approx(np.array([[0.01, 0.006], [0.006, 0.01]]), abs=1e-3)
    # at the end of the box half of it is cut off: the mean of a half-normal is sd sqrt(2 / pi)
    end = Laplace(np.array([0.0, 0.5]), np.diag([100.0, 100.0])).draw(4000, 1.0, np.random.default_rng(0))
    assert end.min() >= 0.0
    assert end[:, 0].mean() == pytest.approx(0.1 * np.sqrt(2.0 / np.pi), abs=0.004)


def test_points_are_spread_out_and_away_from_those_known() -> None:
    candidates = np.array([[0.0, 0.0], [0.01, 0.0], [1.0, 0.0], [0.5, 0.5]])
    chosen = spread_out(candidates, 2, Laplace(np.zeros(2), np.eye(2)), np.array([[0.0, 0.0]]))
    # farthest from the origin first, then the middle (.71 from both)
    assert chosen.tolist() == [[1.0, 0.0], [0.5, 0.5]]


def test_a_scene_s_frames_are_at_its_targets_times() -> None:
    assert times_of(["esv_ml", "n_roof_mm@0.3", "volume_ml@0.1", "n_roof_mm@0.1", "other@0.7"]) == (0.1, 0.3)


def test_errors_of_the_scene_widen_targets() -> None:
    targets = Targets(("a", "b"), np.array([1.0, 2.0]), np.array([0.3, 1.0]), np.array([[0.09, 0.1], [0.1, 1.0]]))
    wide = targets.widened({"a": 0.4})
    assert wide.sd == pytest.approx([0.5, 1.0])  # sqrt(.09 + .16)
    assert wide.covariance == pytest.approx(np.array([[0.25, 0.1], [0.1, 1.0]]))
