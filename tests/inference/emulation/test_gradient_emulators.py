"""Emulators learnt from gradients: as good as more runs, used by everything that uses emulators, stored and read again."""

import numpy as np
import pytest

from lacli.api import inference
from lacli.base.errors import InputError, UsageError
from lacli.base.schema import SEAL, write_arrays
from lacli.contracts.tables.table import RunTable
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.emulation.emulator_set import load_emulators, save_emulators
from lacli.inference.emulation.gradient_gp import fit_gradient_emulators
from lacli.inference.matching.matching import Region
from lacli.inference.sampling.likelihood import Density
from lacli.inference.surrogate import fit_surrogate

BOX = make_box(["alpha", "p", "idle"], [0.2, 1.0, 0.0], [4.0, 9.0, 1.0])


def truth(x):
    """v = 10 log(alpha) + p^2 / 10, w = sin(p / 3) / alpha^(1/2); ``idle`` does nothing."""
    a, p = x[:, 0], x[:, 1]
    return np.c_[10 * np.log(a) + p**2 / 10, np.sin(p / 3) / np.sqrt(a)]


def slopes(x):
    a, p, zero = x[:, 0], x[:, 1], np.zeros(len(x))
    v = np.c_[10 / a, p / 5, zero]
    w = np.c_[-0.5 * np.sin(p / 3) * a**-1.5, np.cos(p / 3) / 3 / np.sqrt(a), zero]
    return np.stack([v, w], axis=2)


def table(n=20, seed=0, p=2):
    x = BOX.uniform(n, np.random.default_rng(seed))
    mix = np.eye(2) if p == 2 else np.random.default_rng(5).normal(size=(2, p))
    names = ("v_ml", "w_mm") if p == 2 else tuple(f"y{j}" for j in range(p))
    return RunTable(BOX.names, names, x, truth(x) @ mix, np.zeros((n, p)), np.empty((0, 3)), (), slopes(x) @ mix)


@pytest.fixture(scope="module")
def fitted():
    return fit_gradient_emulators(table())


def test_twenty_runs_tell_values_and_slopes_in_the_units_of_the_table(fitted):
    x = BOX.uniform(200, np.random.default_rng(1))
    mean, variance = fitted.predict(x)
    error = mean - truth(x)
    assert 1 - (error**2).sum(0) / ((truth(x) - truth(x).mean(0)) ** 2).sum(0) == pytest.approx(1.0, abs=3e-3)
    assert (np.abs(error) < 2 * np.sqrt(variance)).mean() > 0.9
    assert fitted.log_inputs.tolist()[0]  # 10 log(alpha) is straight on it
    inside = x[(x[:, 0] > 0.5)]
    found, exact = fitted.predict_gradient(inside), slopes(inside)
    assert (np.abs(found - exact).max((0, 1)) < [0.6, 0.1]).all()  # the largest are 20 and 1.4
    assert np.array_equal(fitted.predict_mean(x), mean)
    assert fitted.predict_one(1, x)[0] == pytest.approx(mean[:, 1]) and fitted.predict_one(1, x)[1] == pytest.approx(
        variance[:, 1]
    )


def test_the_gradient_is_the_mean_s(fitted):
    x = BOX.uniform(20, np.random.default_rng(2))
    for j, h in enumerate(1e-5 * (BOX.upper - BOX.lower)):
        step = h * np.eye(3)[j]
        difference = (fitted.predict_mean(x + step) - fitted.predict_mean(x - step)) / (2 * h)
        assert fitted.predict_gradient(x)[:, j] == pytest.approx(difference, rel=1e-4, abs=1e-5)


def test_inputs_that_do_nothing_take_no_rows(fitted):
    assert all(g.data.active.tolist() == [0, 1] for g in fitted.processes)


def test_gradients_are_worth_runs(fitted):
    """The same emulator without its derivatives errs several times as much."""
    x = BOX.uniform(300, np.random.default_rng(3))
    plain = table()
    blind = RunTable(**{**plain.__dict__, "gradients": np.full_like(plain.gradients, np.nan)})
    errors = [np.sqrt(((e.predict_mean(x) - truth(x)) ** 2).mean(0)) for e in (fitted, fit_gradient_emulators(blind))]
    assert (errors[0] < 0.5 * errors[1]).all()


def test_many_outputs_are_a_few_processes(tmp_path):
    """Forty combinations of two functions: two components; what is cut off counts as variance."""
    many = fit_gradient_emulators(table(24, p=40))
    assert many.weights.shape[0] == 40 and 2 <= many.weights.shape[1] <= 3
    x = BOX.uniform(100, np.random.default_rng(4))
    exact = truth(x) @ np.random.default_rng(5).normal(size=(2, 40))
    mean, variance = many.predict(x)
    assert 1 - ((mean - exact) ** 2).sum() / ((exact - exact.mean(0)) ** 2).sum() > 0.99
    assert (variance >= many.residual * many.inflation * many.scale**2).all()
    some = many.select(["y7", "y3"])
    assert some.predict(x)[0] == pytest.approx(mean[:, [7, 3]], rel=1e-9)


def test_functions_drawn_scatter_as_the_variance_says(fitted):
    x = BOX.uniform(40, np.random.default_rng(6))
    mean, variance = fitted.predict(x)
    for j in range(2):
        drawn = fitted.draw(j, x, 200, seed=1)
        assert np.abs(drawn.mean(1) - mean[:, j]).max() < 1.5 * np.sqrt(variance[:, j]).max()
        ratio = drawn.std(1) / np.sqrt(variance[:, j])
        assert 0.3 < np.median(ratio) < 1.3  # the nugget is part of the variance, not of a function


def test_intervals_hold_on_functions_drawn_from_a_process():
    """Forty smooth random functions, sums of waves, learnt from 12 runs each with gradients: 95 % intervals at new points."""
    inside, count = 0, 0
    for seed in range(15):
        rng = np.random.default_rng(seed)
        w, phase, size = 1.2 * rng.normal(size=(30, 2)), rng.uniform(0, 6.3, 30), rng.normal(size=30)
        x, at = rng.uniform(-1, 1, (14, 2)), rng.uniform(-1, 1, (60, 2))
        y = np.cos(x @ w.T + phase) @ size
        slope = -(np.sin(x @ w.T + phase) * size) @ w
        runs = RunTable(("a", "b"), ("f",), x, y[:, None], np.zeros((14, 1)), np.empty((0, 2)), (), slope[:, :, None])
        mean, variance = fit_gradient_emulators(runs).predict(at)
        inside += int((np.abs(mean[:, 0] - np.cos(at @ w.T + phase) @ size) < 1.96 * np.sqrt(variance[:, 0])).sum())
        count += len(at)
    assert inside / count > 0.88


def test_stored_emulators_are_the_same_again(fitted, tmp_path):
    path = tmp_path / "emulators.npz"
    save_emulators(path, fitted)
    back = load_emulators(path)
    x = BOX.uniform(30, np.random.default_rng(7))
    assert back.content_digest() == fitted.content_digest()
    assert back.inputs == fitted.inputs and back.outputs == fitted.outputs
    assert all(np.array_equal(a, b) for a, b in zip(back.predict(x), fitted.predict(x), strict=True))
    assert back.training_inputs() == pytest.approx(table().x)


def test_a_damaged_file_is_one_message(fitted, tmp_path):
    path = tmp_path / "emulators.npz"
    save_emulators(path, fitted)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files if name != SEAL}
    for name, value in {
        "scale": -arrays["scale"], "0_theta": arrays["0_theta"] + 50, "0_active": np.array([0, 7]),
        "1_rows": arrays["1_rows"][:2],
        "u": arrays["u"] * 3, "weights": arrays["weights"][:, :0], "low": arrays["high"], "0_kernel": np.array(9),
    }.items():  # fmt: skip
        write_arrays(tmp_path / "other.npz", arrays | {name: value})  # sealed anew
        with pytest.raises(InputError, match="not an emulator file, or a damaged one"):
            load_emulators(tmp_path / "other.npz")


def test_they_serve_the_call_the_stand_in_and_the_indices():
    made = inference.emulate(table(), folds=4)
    assert all(score.r2 > 0.98 for score in made.scores)
    assert made.identity != inference.emulate(table(), folds=4, gradients=False, starts=1).identity
    found = inference.sensitivity(made.emulators, box=BOX, count=256, draws=4)
    assert np.abs(found.indices.st[:, 2]).max() < 0.02 and found.indices.st[0, 0] > 0.5
    targets = Targets(("v_ml", "w_mm"), truth(np.array([[1.5, 4.0, 0.5]]))[0], np.array([0.5, 0.05]))
    density = Density(made.emulators, targets, Region(BOX))
    _, error = fit_surrogate(density, BOX.uniform(400, np.random.default_rng(8)))
    assert np.isfinite(error)
    left = inference.match(made.emulators, targets, box=BOX, count=200, following=3)
    assert left.region.contains(np.array([[1.5, 4.0, 0.5]])).all() and len(left.next_runs) == 3


def test_a_table_without_derivatives_is_refused_by_name():
    plain = table()
    with pytest.raises(UsageError, match="d<output>/d<input>"):
        fit_gradient_emulators(RunTable(**{**plain.__dict__, "gradients": None}))


def test_the_runs_own_error_reaches_what_a_measurement_is_held_against():
    """Runs that say 0.3 mL and 0.02 mm: so much more variance, and none in the prediction of a run."""
    plain = table()
    rough = RunTable(**{**plain.__dict__, "error_sd": np.tile([0.3, 0.0], (plain.runs, 1))})
    made = fit_gradient_emulators(rough)
    x = BOX.uniform(20, np.random.default_rng(9))
    added = made.predict_truth(x)[1] - made.predict(x)[1]
    assert added[:, 0] == pytest.approx(0.09, rel=1e-6) and not added[:, 1].any()
