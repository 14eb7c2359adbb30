"""Uniform samples of small regions whose volume and distribution are known."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import gamma

from lacli.inference.box import make_box
from lacli.inference.matching import nroy
from lacli.inference.matching.nroy import EmptyRegionError, sample_region

D = 9
BOX = make_box([f"x{i}" for i in range(D)], [-1] * D, [1] * D)


def ellipsoid(volume):
    """Semi-axes (9,) whose ellipsoid is ``volume`` of the box, as unequal as fits into it (centre 0.1): five to one at 1e-6."""
    axes = np.exp(np.linspace(-1, 1, D) * (0.8 if volume < 1e-4 else 0.1))
    unit = np.pi ** (D / 2) / gamma(D / 2 + 1) / 2**D
    return axes * (volume / unit / axes.prod()) ** (1 / D)


def uniformity(points, centre, axes):
    """p-values that the points are uniform in the ellipsoid: radius^9 uniform, each direction symmetric and of the right
    spread (uniform in a d-ball: variance of a coordinate 1 / (d + 2))."""
    z = (points - centre) / axes
    radius = stats.kstest((z**2).sum(1) ** (D / 2), "uniform").pvalue
    coordinate = [stats.kstest((z[:, i] + 1) / 2, stats.beta((D + 1) / 2, (D + 1) / 2).cdf).pvalue for i in range(D)]
    return radius, min(coordinate) * D


@pytest.mark.parametrize("volume", [1e-3, 1e-6])
def test_an_ellipsoid_is_filled_uniformly_and_measured(volume):
    axes, centre = ellipsoid(volume), np.full(D, 0.1)
    assert (axes + centre < 1).all()
    found = sample_region(lambda x: np.sqrt((((x - centre) / axes) ** 2).sum(1)), BOX, 10_000, seed=1)
    assert found.points.shape == (10_000, D) and (found.level < 1).all()
    assert abs(found.volume - volume) < 3 * found.volume_sd and found.volume_sd < 0.2 * volume
    # neighbours in time are correlated by at most 0.3: every fifth state or so is independent
    radius, coordinate = uniformity(found.points[::5], centre, axes)
    assert radius > 0.01 and coordinate > 0.01


def test_the_uniformity_test_can_fail():
    axes, centre = ellipsoid(1e-3), np.full(D, 0.1)
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((2000, D))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    exact = centre + axes * direction * rng.random((2000, 1)) ** (1 / D)
    assert min(uniformity(exact, centre, axes)) > 0.01
    # 3 % too little reach, and a slight lean to one side: both are seen
    assert uniformity(centre + 0.97 * (exact - centre), centre, axes)[0] < 0.01
    leaning = exact[rng.random(2000) < 0.5 + 0.5 * ((exact - centre) / axes)[:, 0]]
    assert uniformity(leaning, centre, axes)[1] < 0.01


def test_two_separate_parts_get_their_shares():
    # balls of radii 0.35 and 0.30 in three dimensions: volumes 0.35^3 : 0.30^3 = 0.6136 : 0.3864
    box = make_box(["a", "b", "c"], [-1] * 3, [1] * 3)
    c1, c2 = np.array([0.5, 0.5, 0.5]), np.array([-0.5, -0.5, -0.4])
    found = sample_region(
        lambda x: np.minimum(np.linalg.norm(x - c1, axis=1) / 0.35, np.linalg.norm(x - c2, axis=1) / 0.30), box, 8000, seed=2
    )
    share = (np.linalg.norm(found.points - c1, axis=1) < 0.35).mean()
    assert share == pytest.approx(0.6136, abs=0.05)
    assert found.volume == pytest.approx(4 / 3 * np.pi * (0.35**3 + 0.30**3) / 8, abs=3 * found.volume_sd)


def test_a_bent_shell_is_followed_all_round():
    # | |x| - 0.8 | < 0.01 in the plane: the angle is uniform, although no step along the box's axes is possible
    box = make_box(["a", "b"], [-1] * 2, [1] * 2)
    found = sample_region(lambda x: np.abs(np.linalg.norm(x, axis=1) - 0.8) / 0.01, box, 6000, seed=3)
    angle = np.arctan2(found.points[:, 1], found.points[:, 0])
    assert stats.kstest((angle[::4] + np.pi) / (2 * np.pi), "uniform").pvalue > 0.01
    assert found.volume == pytest.approx(2 * np.pi * 0.8 * 0.02 / 4, abs=3 * found.volume_sd)


def test_orderings_are_kept():
    box = make_box(["edp_mmhg", "esp_mmhg"], [0, 0], [10, 10])
    found = sample_region(lambda x: np.abs(x.sum(1) - 10) / 2, box, 2000, seed=4, walkers=500)
    assert (found.points[:, 0] < found.points[:, 1]).all()
    # the band |a + b - 10| < 2 below the diagonal is 18 of the triangle's 50
    assert found.volume == pytest.approx(18 / 50, abs=4 * found.volume_sd)


def test_an_empty_region_is_told_with_its_nearest_point():
    with pytest.raises(EmptyRegionError) as caught:
        sample_region(lambda x: 2.0 + (x**2).sum(1), BOX, 100, seed=0, walkers=400)
    assert caught.value.lowest == pytest.approx(2.0, abs=0.05)


def test_the_same_seed_gives_the_same_bits():
    one, two = (sample_region(lambda x: np.linalg.norm(x, axis=1) / 0.5, BOX, 500, seed=5, walkers=300) for _ in range(2))
    assert np.array_equal(one.points, two.points) and one.volume == two.volume


HALF = 0.2 * np.exp(np.linspace(-0.6, 0.6, D))  # the product of the half-widths, 0.2^9 = 5.1e-7, is the share of the box


def sheared(x):
    """Signed values of a box of half-widths HALF about 0.1, sheared: w_i = x_i + 0.2 sin(2 x_{i+1}) has determinant one, so
    points uniform in the region are uniform in w; cubics follow the sine to a few per cent."""
    w = x.copy()
    w[:, :-1] += 0.2 * np.sin(2.0 * x[:, 1:])
    return (w - 0.1) / HALF


def sheared_pvalue(points):
    """p-value of each w being uniform, the least of the nine times nine."""
    return D * min(stats.kstest((z + 1) / 2, "uniform").pvalue for z in sheared(points).T)


def sample_sheared():
    return sample_region(lambda x: np.abs(sheared(x)).max(1), BOX, 10_000, seed=3, values=sheared)


def test_guided_steps_leave_the_uniform_distribution(monkeypatch):
    found = sample_sheared()
    assert found.level == pytest.approx(np.abs(sheared(found.points)).max(1)) and (found.level < 1).all()
    assert abs(found.volume - HALF.prod()) < 3 * found.volume_sd and found.volume_sd < 0.2 * found.volume
    assert sheared_pvalue(found.points[::5]) > 0.01
    assert found.acceptance > 0.5  # the guide was there
    unguided = sample_region(lambda x: np.abs(sheared(x)).max(1), BOX, 10_000, seed=3)
    assert found.evaluations < 0.2 * unguided.evaluations


@pytest.mark.parametrize("corrected", [True, False])
def test_a_leaning_guide_is_corrected_for(monkeypatch, corrected):
    # a guide that favours one side by a factor of 3 to 1; without its part of the acceptance the sample would lean too
    class Leaning(nroy._Guide):
        def log_density(self, x, t):
            return super().log_density(x, t) + 0.55 * np.clip(sheared(x)[:, 4], -1, 1)

    def fit(x, values, box):
        guide = fitted(x, values, box)
        return guide and Leaning(guide.polynomial, guide.error)

    fitted = nroy._fit_guide
    monkeypatch.setattr(nroy, "_fit_guide", fit)
    if not corrected:
        detour = nroy._Population._detour
        monkeypatch.setattr(nroy._Population, "_detour", lambda *a: (detour(*a)[0], np.ones(len(a[1]), bool)))
    p = sheared_pvalue(sample_sheared().points[::5])
    assert p > 0.01 if corrected else p < 1e-6


@pytest.mark.parametrize("d", [1, 2, 5])
def test_levels_that_settle_above_the_region_are_not_followed_to_the_last_digit(d):
    """The lowest level, 9, is at a corner of the box; near it what is left shrinks for ever: that is seen after few levels."""
    box = make_box([f"x{i}" for i in range(d)], [0.0] * d, [1.0] * d)
    asked = []

    def level(x):
        asked.append(len(x))
        return 9.0 + x.sum(1)

    with pytest.raises(EmptyRegionError) as caught:
        sample_region(level, box, 100, seed=1, walkers=500)
    assert caught.value.lowest < 9.0 + 0.1 * d
    assert sum(asked) < 500 * 40 * 12  # a dozen levels of at most 40 steps; all levels to the smallest volume took 400 each


def test_a_region_far_down_a_narrow_slope_is_still_found():
    """A ball of radius 0.01 in five inputs, 5.26e-10 of the box, below a cone whose level is 100 at its rim's far side."""
    centre = np.array([0.31, 0.62, 0.5, 0.47, 0.55])
    box = make_box([f"x{i}" for i in range(5)], [0.0] * 5, [1.0] * 5)
    found = sample_region(lambda x: np.linalg.norm(x - centre, axis=1) / 0.01, box, 500, seed=2)
    exact = 8.0 * np.pi**2 / 15.0 * 0.01**5
    assert abs(found.volume / exact - 1.0) < 4.0 * found.volume_sd / found.volume
    assert (np.linalg.norm(found.points - centre, axis=1) < 0.01).all()
