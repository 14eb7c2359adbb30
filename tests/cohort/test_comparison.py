"""Model comparison: against evidences known in closed form, and arms whose truth is known."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm, truncnorm

from lacli.base.errors import UsageError
from lacli.cohort.comparison import GLOBAL, POOLED, REGIONAL, Model, compare, reduced, tied_regions
from lacli.cohort.models import pooling
from lacli.cohort.models.evidence import evidence
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.priors import Prior
from lacli.contracts.tables.table import RunTable
from lacli.contracts.targets import Targets
from lacli.inference.box import Box, make_box
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet
from lacli.inference.sampling.likelihood import pointwise_log_likelihood

NAMES = tuple(f"alpha_{name}" for name in BODY_REGIONS)
OUTPUTS = tuple(f"d_{name}_mm" for name in BODY_REGIONS)
GAIN = 2.0


@pytest.fixture(scope="module")
def model() -> Model:
    """Displacements that fall with each region's stiffness, 2 mm a unit, emulated from 60 runs."""
    box = make_box(NAMES, [0.5] * 5, [4.0] * 5)
    x = box.uniform(60, np.random.default_rng(0))
    y = 10 - GAIN * x
    none = np.zeros((60, 5))
    table = RunTable(NAMES, OUTPUTS, x, y, none, np.empty((0, 5)))
    return Model(REGIONAL, EmulatorSet(NAMES, tuple(fit_emulators(table, starts=1, may_log=np.zeros(5, bool)))), box)


def _targets(alpha: np.ndarray, sd: float, seed: int = 1) -> Targets:
    noise = np.random.default_rng(seed).normal(0, sd, 5)
    return Targets(OUTPUTS, 10 - GAIN * alpha + noise, np.full(5, sd))


def test_the_evidence_of_a_gaussian_in_a_box() -> None:
    # prior uniform on [-5, 5]^3: Z = the Gaussian's mass inside (all) / 10^3
    box = Box(("a", "b", "c"), np.full(3, -5.0), np.full(3, 5.0))
    found = evidence(lambda x: multivariate_normal.logpdf(x, [1, 0, -1], np.diag([0.04, 0.01, 0.09])), box, 400)
    assert found.log_z == pytest.approx(-3 * math.log(10), abs=max(4 * found.se, 0.1))
    assert 0 < found.se < 0.2
    assert found.draws.mean(axis=0) == pytest.approx([1, 0, -1], abs=0.05)
    assert found.draws.std(axis=0) == pytest.approx([0.2, 0.1, 0.3], rel=0.15)


def test_the_standard_error_is_that_of_the_repetitions() -> None:
    box = Box(("a", "b", "c"), np.full(3, -5.0), np.full(3, 5.0))
    asked = -3 * math.log(10)
    found = [
        evidence(lambda x: multivariate_normal.logpdf(x, [1, 0, -1], np.diag([0.04, 0.01, 0.09])), box, 400, seed=seed)
        for seed in range(1, 5)
    ]
    error, stated = np.array([one.log_z - asked for one in found]), np.array([one.se for one in found])
    assert np.sqrt((error**2).mean()) == pytest.approx(np.sqrt((stated**2).mean()), rel=0.5)
    # four repetitions that happen to agree would say next to nothing
    assert stated.min() > 0.5 * np.sqrt((stated**2).mean())


def test_the_evidence_where_half_of_the_mass_is_outside() -> None:
    box = Box(("a",), np.array([0.0]), np.array([2.0]))
    found = evidence(lambda x: norm.logpdf(x[:, 0], 0.0, 0.1), box, 400)
    assert found.log_z == pytest.approx(math.log(0.5 / 2), abs=max(4 * found.se, 0.1))


def _normal_log_evidence(y: np.ndarray, sd: float) -> float:
    """Of logarithms y (k,) seen with this sd, in closed form but for level and spread, which are summed over midpoints."""
    low, high = math.log(0.5), math.log(4.0)
    level = np.log(0.5 + 3.5 * (np.arange(700) + 0.5) / 700)[:, None]
    spread = pooling.WIDEST * ((np.arange(800) + 0.5) / 800)[None]
    # normal times normal is normal, of the mean and the sd that follow; the box cuts both
    both = np.hypot(sd, spread)
    found = -len(y) * np.log(norm.cdf((high - level) / spread) - norm.cdf((low - level) / spread))
    for one in y:
        mean, width = (level * sd**2 + one * spread**2) / both**2, sd * spread / both
        found += norm.logpdf(one, level, both) + np.log(norm.cdf((high - mean) / width) - norm.cdf((low - mean) / width))
    return float(logsumexp(found) - math.log(found.size))


def test_the_evidence_of_two_groups_that_do_not_spread() -> None:
    """Places that tell nothing, levels that are sharp, spreads against their end: one step for all of them moves none well."""
    names = [f"{part}_{k}" for part in "ab" for k in range(5)]
    box = Box(tuple(names), np.full(10, 0.5), np.full(10, 4.0))
    wide, lift = pooling.pooled(box, (names[:5], names[5:]), [(0.5, 4.0)] * 2)
    sd = 0.03
    y = math.log(1.3) + sd * np.random.default_rng(1).normal(size=10)
    found = evidence(lambda x: norm.logpdf(np.log(lift(x)), y, sd).sum(axis=1), wide, 200, repeats=24)
    asked = _normal_log_evidence(y[:5], sd) + _normal_log_evidence(y[5:], sd)
    assert found.log_z == pytest.approx(asked, abs=0.25)


def test_regional_stiffness_is_found_where_there_is_contrast(model: Model) -> None:
    truth = np.array([0.8, 1.5, 2.2, 3.0, 1.2])
    found = compare([model, Model(GLOBAL, model.emulators, model.box, tied_regions(NAMES))], _targets(truth, 0.2), particles=300)
    regional, one = found.fits
    assert (regional.free, one.free) == (5, 1)
    assert found.contrasts[0].verdict == "regional is strongly preferred"
    # exact: each region's likelihood, a Gaussian of sd .2 mm / 2 mm a unit in alpha, over a prior of width 3.5 (and 2 mm a unit)
    assert regional.log_evidence == pytest.approx(5 * math.log(1 / (GAIN * 3.5)), abs=0.4)
    assert regional.rmse_mean_mm == pytest.approx(0.2, abs=0.08)
    # the best single alpha is the mean, 1.74: rms deviation .766 alpha, 1.53 mm
    assert one.rmse_mm == pytest.approx(1.53, abs=0.2)
    assert regional.elpd > one.elpd + 2 * one.elpd_se


def test_priors_are_seen_by_every_model(model: Model) -> None:
    """What is measured of an input beside the targets counts as the calibration has it, in closed form for normal ones."""
    one = Model(GLOBAL, model.emulators, model.box, tied_regions(NAMES))
    plain = _targets(np.full(5, 2.0), 0.5)
    known = dataclasses.replace(
        plain, priors=(Prior("alpha_roof", "normal", 2.6, 0.1), Prior("alpha_septum", "uniform", *[math.nan] * 2, 1.0, 4.0))
    )
    before, after = (compare([model, one], targets, particles=300) for targets in (plain, known))
    seen = (10 - plain.mean) / GAIN
    sd = 0.5 / GAIN

    def told(at: float, width: float) -> float:
        """log of the mean of exp(-r^2 / 2) over a normal of this mean and sd."""
        both = width**2 + 0.1**2
        return math.log(0.1 / math.sqrt(both)) - (at - 2.6) ** 2 / (2 * both)

    # a septum that may not be below 1 has a prior of width 3 in place of 3.5, where one stiffness is all of them
    asked = told(seen[NAMES.index("alpha_roof")], sd), told(float(seen.mean()), sd / math.sqrt(5))
    for k, name in enumerate((REGIONAL, GLOBAL)):
        old, new = before.fits[k], after.fits[k]
        se = math.hypot(old.log_evidence_se, new.log_evidence_se)
        wanted = asked[k] + math.log(3.5 / 3.0)
        assert (new.name, new.log_evidence - old.log_evidence) == (name, pytest.approx(wanted, abs=max(4 * se, 0.1)))
        assert se < 0.2


def test_no_contrast_is_claimed_where_there_is_none(model: Model) -> None:
    found = compare(
        [model, Model(GLOBAL, model.emulators, model.box, tied_regions(NAMES))], _targets(np.full(5, 2.0), 0.5), particles=300
    )
    assert "regional" not in found.contrasts[0].verdict
    assert found.contrasts[0].difference < 0
    assert found.fits[1].p_loo < found.fits[0].p_loo + 0.5


def test_a_model_that_only_extrapolates_is_told_and_does_not_end_the_others(model: Model) -> None:
    """The box reaches to 8, runs to 4: targets of stiffness 6 leave no draw of the regional model where a run has been."""
    wide = dataclasses.replace(model, box=make_box(NAMES, [0.5] * 5, [8.0] * 5))
    one = Model(GLOBAL, model.emulators, model.box, tied_regions(NAMES))
    found = compare([wide, one], _targets(np.full(5, 6.0), 0.2), particles=100)
    assert [fit.name for fit in found.fits] == [REGIONAL, GLOBAL]
    said = [words for words in found.warnings if "extrapolation" in words]
    assert len(said) == 1 and said[0].startswith("regional: its evidence is by extrapolation")
    assert "100.0% of its posterior is where no run has been" in said[0] and "alpha_roof: runs" in said[0]


def test_some_inputs_are_tied(model: Model) -> None:
    box, lift = reduced(Model("front", model.emulators, model.box, (("alpha_anterior", "alpha_roof"),)))
    assert box.names == ("alpha_anterior", "alpha_posterior", "alpha_septum", "alpha_lateral")
    assert lift(np.array([[1.0, 2.0, 3.0, 4.0]])).tolist() == [[1.0, 2.0, 3.0, 4.0, 1.0]]
    with pytest.raises(UsageError, match="alpha_ruf is no input"):
        reduced(Model("x", model.emulators, model.box, (("alpha_anterior", "alpha_ruf"),)))
    with pytest.raises(UsageError, match="tied twice"):
        reduced(Model("x", model.emulators, model.box, (NAMES[:2], NAMES[1:3])))
    apart = make_box(NAMES, [0.5, 3.0, 0.5, 0.5, 0.5], [2.0, 4.0, 4.0, 4.0, 4.0])
    with pytest.raises(UsageError, match="nothing in common"):
        reduced(Model("x", model.emulators, apart, (NAMES[:2],)))
    with pytest.raises(UsageError, match="no global model"):
        tied_regions(["alpha_roof", "esp_mmhg"])


def test_pointwise_densities_with_and_without_correlation() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(3, 3))
    covariance = a @ a.T + np.eye(3)
    target, mean, variance = rng.normal(size=3), rng.normal(size=(2, 3)), np.full((2, 3), 0.1)
    targets = Targets(("a", "b", "c"), target, np.sqrt(np.diag(covariance)), covariance)
    found = pointwise_log_likelihood(mean, variance, targets)
    s = covariance + 0.1 * np.eye(3)
    # p(y_0 | y_1, y_2) = p(y) / p(y_1, y_2)
    joint = multivariate_normal.logpdf(target, mean[0], s) - multivariate_normal.logpdf(target[1:], mean[0, 1:], s[1:, 1:])
    assert found[0, 0] == pytest.approx(joint)
    diagonal = Targets(("a", "b", "c"), target, np.ones(3), np.eye(3))
    assert pointwise_log_likelihood(mean, variance, diagonal) == pytest.approx(
        pointwise_log_likelihood(mean, variance, Targets(("a", "b", "c"), target, np.ones(3)))
    )


def _pooled_log_evidence(alpha: np.ndarray, sd: float) -> float:
    """By quadrature: regions' likelihoods are normal in alpha with this sd; level 0.5 to 4 and spread 0 to 1, both uniform."""
    grid = np.linspace(0.5, 4.0, 700)  # of each region's alpha
    step = grid[1] - grid[0]
    likelihood = norm.pdf(alpha[:, None], grid, sd)
    total = []
    for level in np.linspace(0.5, 4.0, 71):
        for spread in np.linspace(0.0125, 0.9875, 40):
            ends = np.log(np.array([0.5, 4.0]) / level) / spread
            prior = truncnorm.pdf(np.log(grid), *ends, loc=np.log(level), scale=spread) / grid
            prior /= prior.sum() * step
            total.append(np.prod((likelihood * prior).sum(axis=1) * step))
    return float(np.log(np.mean(total)))


def test_regions_about_a_level_have_their_evidence(model: Model) -> None:
    pooled = Model(POOLED, model.emulators, model.box, tied_regions(NAMES), spread=True)
    one = Model(GLOBAL, model.emulators, model.box, tied_regions(NAMES))
    truth = np.array([1.0, 1.2, 1.5, 2.0, 1.4])  # a spread of the logarithms of .25
    targets = _targets(truth, 0.3)
    found = compare([model, one, pooled], targets, particles=400)
    fit = found.fits[2]
    # as densities of the targets, in mm; their sd is .15 in alpha
    asked = _pooled_log_evidence((10 - targets.mean) / GAIN, 0.3 / GAIN) - 5 * math.log(GAIN)
    assert fit.log_evidence == pytest.approx(asked, abs=max(4 * fit.log_evidence_se, 0.3))
    assert fit.free == 7  # level, spread, five places
    assert fit.log_evidence > found.fits[0].log_evidence + 1, "a uniform prior pays for more than moderate differences"
    assert (found.contrasts[-1].model, found.contrasts[-1].against) == (POOLED, GLOBAL)


def test_regions_about_a_level_are_the_global_model_where_they_do_not_spread(model: Model) -> None:
    one = Model(GLOBAL, model.emulators, model.box, tied_regions(NAMES))
    pooled = Model(POOLED, model.emulators, model.box, tied_regions(NAMES), spread=True)
    box, lift = reduced(pooled)
    assert box.names[:3] == ("level.alpha_anterior", "spread.alpha_anterior", "place.alpha_anterior")
    assert lift(np.array([[1.7, 0.0, 0.1, 0.3, 0.5, 0.7, 0.9]])) == pytest.approx(np.full((1, 5), 1.7), rel=1e-4)
    # the ends of the places are those of the box; the middle is the level where the box goes as far up as down
    ends = lift(np.array([[math.sqrt(2.0), 0.8, 0.0, 1.0, 0.5, 0.0, 1.0]]))
    assert ends == pytest.approx(np.array([[0.5, 4.0, math.sqrt(2.0), 0.5, 4.0]]))
    found = compare([model, one, pooled], _targets(np.full(5, 2.0), 0.5), particles=300)
    assert "pooled" not in found.contrasts[-1].verdict
    assert found.fits[0].log_evidence < found.fits[2].log_evidence < found.fits[1].log_evidence + 0.5


def test_pressures_keep_their_order_beside_regions_about_a_level() -> None:
    box = make_box(("edp_mmhg", "alpha_roof", "esp_mmhg", "alpha_septum"), [2, 0.5, 5, 0.5], [12, 4, 30, 4])
    wide, lift = pooling.pooled(box, (("alpha_roof", "alpha_septum"),), [(0.5, 4.0)])
    assert wide.names[:2] == ("edp_mmhg", "esp_mmhg") and wide.ordered == ((0, 1),)
    assert lift(np.array([[6.0, 20.0, 1.5, 0.0, 0.5, 0.5]])) == pytest.approx(np.array([[6.0, 1.5, 20.0, 1.5]]), rel=1e-4)
