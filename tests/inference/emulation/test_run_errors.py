"""The runs' own errors, as they vary over the box, in what targets are held against."""

import numpy as np
import pytest

from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.emulation.emulator import fit_emulator
from lacli.inference.emulation.emulator_set import EmulatorSet, load_emulators, save_emulators
from lacli.inference.emulation.run_errors import run_errors
from lacli.inference.matching.matching import Region, Wave
from lacli.inference.sampling.likelihood import Density
from lacli.inference.sampling.verdict import judge

RNG = np.random.default_rng(3)
X = RNG.uniform(1.0, 3.0, (40, 2))
Y = 20.0 + 4.0 * X[:, 0] - X[:, 1]
# from 0.02 to 0.82 along the first input
SD = 0.02 * np.exp(np.log(41.0) * (X[:, 0] - 1.0) / 2.0)


def emulators(sd, y=Y):
    return EmulatorSet(("a", "b"), (fit_emulator(X, y, "f", sd, starts=1), fit_emulator(X, y, "g", None, starts=1)))


@pytest.fixture(scope="module")
def rough():
    return emulators(SD)


@pytest.mark.parametrize("y", [Y, np.exp(0.1 * Y)], ids=["linear", "logarithmic"])
def test_an_error_that_grows_over_the_box_is_told_where_it_is(y):
    errors = run_errors(fit_emulator(X, y, "f", SD, starts=1))
    points = np.array([[1.2, 2.0], [2.0, 1.5], [2.8, 2.5]])
    assert np.sqrt(errors(points)) == pytest.approx(0.02 * np.exp(np.log(41.0) * (points[:, 0] - 1.0) / 2.0), rel=0.06)


def test_an_error_that_is_the_same_everywhere_stays_so():
    errors = run_errors(fit_emulator(X, Y, "f", np.full(40, 0.3), starts=1))
    assert errors(np.array([[1.0, 1.0], [9.0, -4.0]])) == pytest.approx([0.09, 0.09], rel=1e-6)


@pytest.mark.parametrize("runs", [5, 8, 20])
def test_few_runs_tell_no_more_than_their_own_errors(runs):
    sd = SD[:runs].copy()
    sd[0] = 0.0
    errors = run_errors(fit_emulator(X[:runs], Y[:runs], "f", sd, starts=1))
    values = errors(RNG.uniform(-5.0, 9.0, (200, 2)))
    assert (values > 0.0).all() and values.max() <= sd.max() ** 2 * (1 + 1e-9)


def test_runs_without_errors_add_nothing(rough):
    x = RNG.uniform(1.0, 3.0, (9, 2))
    assert not rough.error_variance(1, x).any()
    (_, plain), (_, whole) = rough.predict(x), rough.predict_truth(x)
    assert np.array_equal(whole[:, 1], plain[:, 1]) and np.allclose(whole[:, 0] - plain[:, 0], rough.error_variance(0, x))


def test_likelihood_matching_and_verdict_count_the_error_at_the_point(rough):
    """Targets 1 off the mean with sd 0.1: at the smooth end (error 0.02) far out, at the rough end (0.8) well within."""
    targets = Targets(("f", "g"), np.array([0.0, 0.0]), np.array([0.1, 0.1]))
    box = make_box(["a", "b"], [1.0, 1.0], [3.0, 3.0])
    for x, far in ((np.array([[1.05, 2.0]]), True), (np.array([[2.95, 2.0]]), False)):
        mean, variance = rough.predict(x)
        mine = Targets(("f", "g"), mean[0] + [1.0, 0.0], targets.sd)
        total = variance[0] + [rough.error_variance(0, x)[0], 0.0] + 0.1**2
        expected = -0.5 * ((np.array([1.0, 0.0]) ** 2 / total) + np.log(2.0 * np.pi * total)).sum()
        density = Density(rough, mine, Region(box))
        assert density.log_likelihood(x)[0] == pytest.approx(expected, rel=1e-9)
        assert density(x)[0] == pytest.approx(expected, rel=1e-9)
        wave = Wave(rough, mine, 3.0)
        assert bool(wave.level(x)[0] > 1.0) == far
        assert judge(rough, mine, box, x[0]).plausible != far
        # the quick way to a region gives the same answer, point by point
        many = np.vstack([x, RNG.uniform(1.0, 3.0, (200, 2))])
        assert np.array_equal(wave.below(many, 1.0), wave.level(many) < 1.0)
        # correlated targets take the same variance on their diagonal
        correlated = Targets(("f", "g"), mine.mean, mine.sd, np.diag(mine.sd**2))
        assert Density(rough, correlated, Region(box)).log_likelihood(x)[0] == pytest.approx(expected, rel=1e-9)


def test_a_file_brings_the_errors_back(rough, tmp_path):
    save_emulators(tmp_path / "e.npz", rough)
    x = RNG.uniform(1.0, 3.0, (9, 2))
    assert np.array_equal(load_emulators(tmp_path / "e.npz").error_variance(0, x), rough.error_variance(0, x))
