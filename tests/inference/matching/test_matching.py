"""History matching with simulators known exactly, and with emulators."""

import numpy as np
import pytest
from exact import ExactEmulators

from lacli.contracts.tables.table import RunTable
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.design import design, farthest
from lacli.inference.emulation import feasibility
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet
from lacli.inference.emulation.feasibility import learn
from lacli.inference.matching.matching import Region, Wave, match, next_runs, ruled_out_by, sweep

BOX = make_box(["x0", "x1", "x2"], [-1, -1, -1], [1, 1, 1])


def slab(sd, threshold, d=3):
    """y = x0 with target 0: what is left is |x0| < threshold sd."""
    emulators = ExactEmulators(d, 1, lambda x: x[:, :1])
    return Wave(emulators, Targets(("y0",), np.zeros(1), np.array([sd])), threshold)


def test_implausibility_by_hand():
    emulators = ExactEmulators(3, 2, lambda x: x[:, :2], lambda x: np.full((len(x), 2), 0.16))
    wave = Wave(emulators, Targets(("y0", "y1"), np.array([0.0, 1.0]), np.array([0.3, 0.3])), 3.0)
    # sd = sqrt(0.16 + 0.09) = 0.5: 0.5 / 0.5 and |0.25 - 1| / 0.5
    assert wave.implausibility(np.array([[0.5, 0.25, 0.0]]))[0] == pytest.approx([1.0, 1.5])
    assert wave.level(np.array([[0.5, 0.25, 0.0]]))[0] == pytest.approx(0.5)
    assert "y1 is 0.25 where the target is 1 ± 0.3 (implausibility 1.50, threshold 3)" in ruled_out_by(
        wave, np.array([[0.5, 0.25, 0.0]])
    )


def test_the_sweep_measures_a_slab():
    found = sweep(Region(BOX, (slab(0.1, 3.0),)), 20_000)
    assert found.share == pytest.approx(0.3, abs=3 * found.share_sd)


def test_waves_only_rule_out_and_change_is_measured_on_the_same_points():
    first = match(Region(BOX, (slab(0.1, 3.5),)), 4000, 20_000)
    assert first.share == pytest.approx(0.35, abs=0.012) and np.isnan(first.change)
    # the same emulators at 3.0: 0.30 of the box; nothing of it comes from better emulators
    second = match(Region(BOX, (slab(0.1, 3.5), slab(0.1, 3.0))), 4000, seed=1, previous=first)
    assert second.share == pytest.approx(0.30, abs=0.015) and second.change == 0.0
    # "emulators" that see more: |x0| < 0.27 of 0.30
    third = match(Region(BOX, (slab(0.1, 3.5), slab(0.1, 3.0), slab(0.09, 3.0))), 4000, seed=2, previous=second)
    assert third.share == pytest.approx(0.27, abs=0.015) and third.change == pytest.approx(0.1, abs=0.02)
    assert (np.abs(third.sample.points[:, 0]) < 0.27).all()
    # a uniform sample of the slab: x1 uniform on [-1, 1], variance 1/3
    assert third.sample.points[:, 1].var() == pytest.approx(1 / 3, rel=0.08)


def test_a_small_region_is_measured_by_levels():
    region = Region(BOX, (slab(1e-5, 3.0),))
    found = match(region, 1000, 5000)
    assert found.share == pytest.approx(3e-5, abs=3 * found.share_sd) and found.share_sd < 1e-5


@pytest.fixture(scope="module")
def fitted():
    x = design(BOX, 60)
    y = np.c_[np.exp(x[:, 0]) + 0.5 * x[:, 1], x[:, 1] * x[:, 2] + x[:, 0]]
    table = RunTable(BOX.names, ("p", "q"), x, y, np.zeros_like(y), np.empty((0, 3)))
    return EmulatorSet(BOX.names, tuple(fit_emulators(table)))


def test_the_quick_answer_is_the_exact_one(fitted):
    wave = Wave(fitted, Targets(("p", "q"), np.array([1.2, 0.1]), np.array([0.05, 0.05])), 3.0)
    x = BOX.uniform(20_000, np.random.default_rng(0))
    level = wave.level(x)
    for t in (0.3, 1.0, 4.0):
        assert np.array_equal(wave.below(x, t), level < t)
    region = Region(BOX, (wave, Wave(fitted, wave.targets, 2.0)))
    assert np.array_equal(region.contains(x), region.level(x) < 1.0)
    assert np.array_equal(region.contains(x + 0.9), (region.level(x + 0.9) < 1.0) & (x + 0.9 <= 1).all(1))


def test_next_runs_spread_over_the_region_and_keep_away_from_old_ones(fitted):
    wave = Wave(fitted, Targets(("p", "q"), np.array([1.2, 0.1]), np.array([0.05, 0.05])), 3.0)
    sample = Region(BOX, (wave,)).sample(3000, walkers=500)
    chosen = next_runs(sample, 30, sample.points[:50])
    assert wave.below(chosen, 1.0).all() and len(np.unique(chosen, axis=0)) == 30

    def nearest(a):
        z = a / sample.points.std(0)
        distance = np.linalg.norm(z[:, None] - z[None], axis=-1)
        return np.min(distance + 1e9 * np.eye(len(a)), axis=1)

    rng = np.random.default_rng(0)
    random = [nearest(sample.points[rng.permutation(3000)[:30]]).min() for _ in range(50)]
    assert nearest(chosen).min() > max(random)


def test_designs_fill_the_box_and_keep_orderings():
    box = make_box(["edp_mmhg", "esp_mmhg", "z"], [1, 5, 0], [12, 37, 1])
    for method in ("sobol", "lhs", "maximin"):
        x = design(box, 64, method, seed=2)
        assert x.shape == (64, 3) and box.contains(x).all()
        assert np.array_equal(x, design(box, 64, method, seed=2))
        assert not np.array_equal(x, design(box, 64, method, seed=3))
    x = design(make_box(["a", "b"], [0, 0], [1, 1]), 16, "lhs")
    assert (np.sort((x * 16).astype(int), axis=0) == np.arange(16)[:, None]).all()  # one in each row and column
    x = design(make_box(["a", "b"], [0, 0], [1, 1]), 16, "sobol")
    assert (np.bincount((x[:, 0] * 4).astype(int) * 4 + (x[:, 1] * 4).astype(int), minlength=16) == 1).all()


def test_farthest_goes_to_the_corners():
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5)), -1).reshape(-1, 2)
    chosen = grid[farthest(grid, 5)]
    assert {tuple(p) for p in chosen} == {(0.5, 0.5), (0, 0), (0, 1), (1, 0), (1, 1)}


def test_failures_are_learnt_and_avoided():
    rng = np.random.default_rng(0)
    x = BOX.uniform(120, rng)
    fails = x[:, 0] + x[:, 1] > 0.8
    model = learn(BOX, x[~fails], x[fails])
    assert model is not None and f"{fails.sum()} of 120 runs failed" in model.describe()
    chosen = design(BOX, 200, "sobol", accept=model.accept)
    blind = design(BOX, 200, "sobol")
    share = [(c[:, 0] + c[:, 1] > 0.8).mean() for c in (chosen, blind)]
    assert share[0] < 0.25 * share[1]
    assert learn(BOX, x, x[:2]) is None


def test_very_many_runs_are_learnt_from_in_bounded_time(monkeypatch):
    """Of 5,000 runs, 100 are taken and no more; the few failures among them are not lost."""
    monkeypatch.setattr(feasibility, "_MOST_RUNS", 100)
    x = BOX.uniform(5000, np.random.default_rng(0))
    edge = BOX.lower[0] + 0.9 * (BOX.upper[0] - BOX.lower[0])
    fails = x[:, 0] > edge
    model = learn(BOX, x[~fails], x[fails])
    assert model.used == len(model.classifier.base_estimator_.X_train_) == 100
    assert f"{fails.sum()} of 5000 runs failed (learnt from 100 of them" in model.describe()
    asked = BOX.uniform(400, np.random.default_rng(1))
    assert (model.accept(asked) == (asked[:, 0] > edge)).mean() < 0.1


def correlated(rho, targets=("y0", "y1"), sd=(0.2, 0.4)):
    """y = x0, x1, both targets 0, their errors correlated by rho."""
    sd = np.array(sd)
    covariance = np.array([[1.0, rho], [rho, 1.0]]) * np.outer(sd, sd)
    return Wave(ExactEmulators(3, 2, lambda x: x[:, :2]), Targets(targets, np.zeros(2), sd, covariance), 3.0)


def test_targets_that_err_together_rule_out_by_their_difference():
    # x = (0.2, -0.4): one sd off each, apart. Components (1, 1)/sqrt 2 and (1, -1)/sqrt 2 of the errors in sd, variances 1 + rho
    # and 1 - rho: (1 - 1)/sqrt 2 = 0, and (1 + 1)/sqrt 2 / sqrt 0.02 = 10
    wave = correlated(0.98)
    value = wave.implausibility(np.array([[0.2, -0.4, 0.0]]))[0]
    assert np.sort(value) == pytest.approx([0.0, 1.0, 1.0, 10.0], abs=1e-6)
    assert "y0" in ruled_out_by(wave, np.array([[0.2, -0.4, 0.0]])) and "10.00" in ruled_out_by(
        wave, np.array([[0.2, -0.4, 0.0]])
    )
    # both off the same way are no worse than each alone: sqrt 2 / sqrt 1.98
    assert wave.implausibility(np.array([[0.2, 0.4, 0.0]])).max() == pytest.approx(np.sqrt(2 / 1.98))
    # as without a covariance where the errors are not correlated
    alone = Wave(wave.emulators, Targets(wave.targets.names, wave.targets.mean, wave.targets.sd), 3.0)
    x = BOX.uniform(500, np.random.default_rng(0))
    assert np.array_equal(correlated(0.0).level(x), alone.level(x))
    assert wave.signed(x).shape == (500, 4) and alone.signed(x).shape == (500, 2)


def test_the_quick_answer_is_the_exact_one_with_components(fitted):
    covariance = 0.0025 * np.array([[1.0, 0.9], [0.9, 1.0]])
    wave = Wave(fitted, Targets(("p", "q"), np.array([1.2, 0.1]), np.array([0.05, 0.05]), covariance), 3.0)
    x = BOX.uniform(20_000, np.random.default_rng(0))
    level = wave.level(x)
    alone = Wave(fitted, Targets(("p", "q"), wave.targets.mean, wave.targets.sd), 3.0)
    assert (level >= alone.level(x)).all() and (level > 1.01 * alone.level(x)).any()
    for t in (0.3, 1.0, 4.0):
        assert np.array_equal(wave.below(x, t), level < t)
