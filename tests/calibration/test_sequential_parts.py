"""The parts of the calibration that seeks the posterior: emulator, steps, draws."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from membranes import box, respond

from lacli.calibration.sequential import emulator
from lacli.calibration.sequential.change import expected_change
from lacli.calibration.sequential.descent import levenberg, lowest
from lacli.calibration.sequential.laplace import Laplace
from lacli.calibration.sequential.outputs import Features
from lacli.calibration.sequential.scale import Scale
from lacli.calibration.sequential.verdict import verdict
from lacli.calibration.simulator import asked, times_of
from lacli.contracts.scene import build_scene
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


def test_the_likelihood_s_gradient_is_its_derivative() -> None:
    z, y, jacobian = runs(9)
    told = np.arange(9) != 4  # one run tells no derivatives
    rows = emulator.Rows.of(z, told)
    moving = rows.observations(y[:, :3], jacobian[:, :3])
    for kind in ("squared_exponential", "matern52"):
        theta = np.log([0.7, 0.5, 1.4, 1e-4])
        _, gradient = emulator.cost(theta, rows, moving, kind)
        for i in range(4):
            h = 1e-5 * np.eye(4)[i]
            up, down = (emulator.cost(theta + sign * h, rows, moving, kind)[0] for sign in (1, -1))
            assert gradient[i] == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-3)


def test_components_that_hardly_move_do_not_decide_over_the_lengths() -> None:
    """Two components of waves, eight of a hundredth their size that are nearly straight: as good as the two alone."""
    rng = np.random.default_rng(2)

    def waves(per_unit: float, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return per_unit * rng.standard_normal((200, 4)), 2 * np.pi * rng.random(200), size * 0.1 * rng.standard_normal(200)

    made = [waves(2.0, 2.0), waves(2.0, 1.0)] + [waves(0.3, 0.02) for _ in range(8)]
    z, there = rng.random((12, 4)), rng.random((200, 4))
    y, truth = (np.stack([np.cos(at @ w.T + shift) @ a for w, shift, a in made], 1) for at in (z, there))
    slope = np.stack([-(np.sin(z @ w.T + shift) * a) @ w for w, shift, a in made], 1)
    off = []
    for count in (2, len(made)):
        fitted = emulator.fit(z, y[:, :count], slope[:, :count])
        error = fitted.mean(there) @ fitted.rotation.T - truth[:, :count]
        off.append(float(np.sqrt((error[:, :2] ** 2).sum(1).mean())))
    assert off[1] < 1.1 * off[0]


def test_fewer_components_have_the_same_misfit() -> None:
    z, y, jacobian = runs(15)
    # ten more outputs, linear in the inputs: with those before, 22 of which 10 never leave their trend
    linear = np.random.default_rng(5).standard_normal((3, 10))
    y, jacobian = np.hstack([y, z @ linear]), np.concatenate([jacobian, np.tile(linear.T, (15, 1, 1))], axis=1)
    fitted = emulator.fit(z, 20.0 * (y - y[0]), 20.0 * jacobian)
    there = np.random.default_rng(3).random((40, 3))
    whole, few = fitted.predict(there), fitted.reduced().predict(there)
    assert few[0].shape[1] < whole[0].shape[1]
    assert (few[0] ** 2).sum(1) == pytest.approx((whole[0] ** 2).sum(1), rel=1e-3)
    assert few[1].sum(1) == pytest.approx(whole[1].sum(1), rel=1e-2, abs=1e-4)


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


def test_runs_left_out_are_as_if_they_had_never_been_there(monkeypatch: pytest.MonkeyPatch) -> None:
    z, y, jacobian = runs(14)
    whole = emulator.fit(z, y, jacobian)
    error, share = whole.left_out()
    monkeypatch.setattr(emulator, "minimize", lambda cost, start, *more, **options: SimpleNamespace(x=start))  # the same lengths
    for i in (0, 9):
        kept = np.arange(14) != i
        rest = emulator.fit(z[kept], y[kept], jacobian[kept], start=whole)
        missed = y[i] - rest.mean(z[i : i + 1])[0] @ rest.rotation.T
        assert error[i] @ whole.rotation.T == pytest.approx(missed, rel=1e-4, abs=1e-6 * np.ptp(y))
        # a run has its nugget beside what is not known of the process
        unknown = rest.share(z[i : i + 1])[0] / rest.inflation + whole.nugget
        assert share[i] / whole.inflation == pytest.approx(unknown, rel=0.01)


def test_scores_of_features_by_runs_left_out() -> None:
    z, y, jacobian = runs(20)
    sd = np.full(12, 0.1)
    targets = Targets(tuple(f"f{j}" for j in range(12)), y.mean(0), sd)
    fitted = emulator.fit(z, (y - targets.mean) / 0.1, jacobian / 0.1)
    features = Features(fitted, Scale.of(box()), targets, ("f3", "f0"))
    assert features.predict(features.training_inputs())[0][:, 0] == pytest.approx(y[:, 3], rel=1e-3)
    r2, ise = features.left_out()
    error = (fitted.left_out()[0] @ fitted.rotation.T)[:, 3] * 0.1
    assert r2[0] == pytest.approx(1.0 - (error**2).sum() / ((y[:, 3] - y[:, 3].mean()) ** 2).sum(), rel=1e-4)
    assert r2.min() > 0.98 and ((ise >= 0.8) & (ise <= 1.0)).all() and (ise * 20 == pytest.approx(np.round(ise * 20)))


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


def test_a_scene_s_frames_are_at_its_targets_times() -> None:
    assert times_of(["esv_ml", "n_roof_mm@0.3", "volume_ml@0.1", "n_roof_mm@0.1", "other@0.7"]) == (0.1, 0.3)


def test_errors_of_the_scene_widen_targets() -> None:
    targets = Targets(("a", "b"), np.array([1.0, 2.0]), np.array([0.3, 1.0]), np.array([[0.09, 0.1], [0.1, 1.0]]))
    wide = targets.widened({"a": 0.4})
    assert wide.sd == pytest.approx([0.5, 1.0])  # sqrt(.09 + .16)
    assert wide.covariance == pytest.approx(np.array([[0.25, 0.1], [0.1, 1.0]]))


def test_a_calibration_to_times_names_all_frames_of_a_scene_with_a_conduit() -> None:
    """What it runs is a scene that can be read again."""
    given = build_scene({"anatomy": {"bundle": "/la"}}, ["outputs.conduit=true"], folder=Path("/"), where="test")
    framed = asked(given, ("n_roof_mm@0.2", "esv_ml"))
    assert framed.outputs.times == (0.2,) and not framed.outputs.conduit
    assert build_scene(framed.model_dump(mode="json", exclude_none=True), [], folder=Path("/"), where="again") == framed
    assert asked(given, ("esv_ml",)).outputs.conduit


def test_the_refusal_is_of_the_run_whose_misfit_is_told() -> None:
    """Row 1 is not the run that misses least (a cheap one does), but of the runs that count: its residuals are named."""
    targets = Targets(("a_mm", "b_mm"), np.zeros(2), np.array([0.5, 2.0]))
    residual = np.array([[5.0, 0.0], [1.0, 9.0]])
    evidence = SimpleNamespace(targets=2, residual=residual, misfit=(residual**2).sum(1), z=np.array([[0.2], [0.8]]))
    components = SimpleNamespace(
        rotation=np.eye(2), z=evidence.z, predict=lambda z: (np.zeros((len(z), 2)), np.ones((len(z), 2)))
    )  # fmt: skip
    words = verdict(evidence, components, targets, 82.0, 1, 1)  # type: ignore[arg-type]
    assert "chi^2 is 82 where 1 is expected" in words and "b_mm (+9.0 sd), a_mm (+1.0 sd)" in words
