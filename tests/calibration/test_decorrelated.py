"""The likelihood of correlated targets by a diagonal: against dense covariances, the calibration's own, and a closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from membranes import INPUTS, OUTPUTS, box, respond
from scipy.linalg import solve_triangular
from scipy.stats import multivariate_normal

from lacli.calibration.sequential.draw.chain import density
from lacli.calibration.sequential.draw.likelihood import Decorrelated
from lacli.calibration.sequential.emulator import Part, fit
from lacli.calibration.sequential.fidelity.corrected import Corrected
from lacli.calibration.sequential.outputs import Features
from lacli.calibration.sequential.scale import Scale
from lacli.cohort.comparison import Model, compare
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.sampling.likelihood import gaussian_log_likelihood

P = len(OUTPUTS)
DISTANCE = np.abs(np.subtract.outer(np.arange(P), np.arange(P)))
SD = np.linspace(0.1, 0.4, P)
TRUTH = np.array([1.4, 1.5, 8.9])


def _targets() -> Targets:
    covariance = np.outer(SD, SD) * 0.8**DISTANCE
    noise = np.linalg.cholesky(covariance) @ np.random.default_rng(3).standard_normal(P)
    return Targets(OUTPUTS, respond(TRUTH)[0] + noise, SD, covariance)


def _features(targets: Targets, scale: Scale, runs: int = 12) -> Features:
    z = np.random.default_rng(0).random((runs, len(INPUTS)))
    x = scale.to_x(z)
    told = [respond(point) for point in x]
    lower = np.linalg.cholesky(targets.covariance)
    residual = np.array([solve_triangular(lower, y - targets.mean, lower=True) for y, _ in told])
    jacobian = np.array([solve_triangular(lower, dy * at, lower=True) for (_, dy), at in zip(told, scale.slope(x), strict=True)])
    return Features(fit(z, residual, jacobian), scale, targets, targets.names)


@pytest.fixture(scope="module")
def features() -> Features:
    return _features(_targets(), Scale.of(box()))


@pytest.fixture(scope="module")
def corrected(features: Features) -> Features:
    """Of runs that few others correct."""
    rng = np.random.default_rng(5)
    z, slope, bend = rng.random((4, 3)), 0.3 * rng.normal(size=(P, 3)), rng.normal(size=(P, 1)) * np.array([0.9, 0.6, 0.5])
    delta = fit(z, z @ slope.T + np.sin(9 * z) @ bend.T, slope[None] + 9 * np.cos(9 * z)[:, None] * bend[None])
    assert delta.share(np.full((1, 3), 0.5)) * delta.variance.max() > 0.1  # of the targets' variance: it counts
    return replace(features, components=Corrected.of(features.components, delta))


@pytest.fixture(scope="module")
def held() -> Targets:
    """With discretisation errors that go together, all of them larger than stated."""
    errors = dict(zip(OUTPUTS, np.linspace(0.3, 0.05, P).tolist(), strict=True))
    return _targets().widened(errors, 0.5 + 0.5 * np.eye(P)).with_errors_times(1.7)


def _dense(features: Features, held: Targets, x: np.ndarray) -> list[multivariate_normal]:
    """The features' distributions at x (m, d), with the targets' errors, the emulator's and a correction's."""
    z, back, made = features.scale.to_z(x), features.back(), features.components
    share, at, more = made.share(z), features.predict(x)[0], np.zeros((len(x), len(back), len(back)))
    if isinstance(made, Corrected):
        mix = back @ made.mix.T
        more = made.delta.share(z)[:, None, None] * ((mix * made.delta.variance) @ mix.T)
    own = held.covariance + share[:, None, None] * ((back * made.variance) @ back.T)
    return [multivariate_normal(at[k], own[k] + more[k]) for k in range(len(x))]


def _points(count: int = 25) -> np.ndarray:
    return box().uniform(count, np.random.default_rng(1))


@pytest.mark.parametrize("names", [OUTPUTS, OUTPUTS[7:2:-1]])
@pytest.mark.parametrize("of", ["features", "corrected"])
def test_it_is_the_density_with_the_whole_covariance(
    of: str, names: tuple[str, ...], held: Targets, request: pytest.FixtureRequest
) -> None:
    features, held = request.getfixturevalue(of).select(names), held.select(names)
    x = _points()
    asked = np.array([one.logpdf(held.mean) for one in _dense(features, held, x)])
    assert np.ptp(asked) > 50.0  # far from the targets and near them
    assert Decorrelated.of(features, held)(x) == pytest.approx(asked, rel=1e-10, abs=1e-8)


@pytest.mark.parametrize("of", ["features", "corrected"])
@pytest.mark.parametrize("part", ["emulator and correction", "emulator", "correction"])
def test_over_what_the_emulator_may_err_in_the_likelihood_is_its_own(
    of: str, part: Part, held: Targets, request: pytest.FixtureRequest
) -> None:
    """E[L(e)] over the errors e is the L in whose variances they are: the mean of exp(log L(e) - log L) is 1."""
    features = request.getfixturevalue(of)
    x = TRUTH + np.random.default_rng(2).standard_normal((8, 3)) * [0.2, 0.2, 0.4]
    world, rng = Decorrelated.of(features, held).worlds(x, part), np.random.default_rng(4)
    ratios = np.exp([world(rng) for _ in range(6000)])
    se = ratios.std(axis=0) / np.sqrt(len(ratios))
    assert (np.abs(ratios.mean(axis=0) - 1.0) < np.maximum(4.5 * se, 1e-9)).all()  # of one correction there is nothing to draw
    moves = part != "correction" or of == "corrected"
    assert (ratios.std(axis=0) > 1e-3).all() == moves
    assert se.max() < 0.05  # else the mean would say nothing


@pytest.mark.parametrize("of", ["features", "corrected"])
def test_each_target_given_the_others(of: str, held: Targets, request: pytest.FixtureRequest) -> None:
    features = request.getfixturevalue(of)
    x = _points(4)
    found = Decorrelated.of(features, held).pointwise(x)
    for k, one in enumerate(_dense(features, held, x)):
        for j in (0, 5, P - 1):
            others = np.delete(np.arange(P), j)
            marginal = multivariate_normal(one.mean[others], one.cov[np.ix_(others, others)])
            asked = one.logpdf(held.mean) - marginal.logpdf(held.mean[others])
            assert found[k, j] == pytest.approx(asked, rel=1e-8, abs=1e-8)


def test_what_features_on_their_own_miss_is_that_the_emulator_errs_in_them_together(features: Features, held: Targets) -> None:
    """Dense, with each feature's own variance alone: the same where the emulator is exact; else to first order what the
    covariances D of its error make, (r' T^-1 D T^-1 r - tr T^-1 D) / 2, with a rest that falls with their square."""
    x = _points()
    rest = []
    for share in (1e-12, 0.2, 0.1):
        some = replace(features, components=replace(features.components, inflation=share))
        mean, variance = some.predict_truth(x)
        apart = Decorrelated.of(some, held)(x) - gaussian_log_likelihood(mean, variance, held)
        first = np.empty(len(x))
        for k, one in enumerate(_dense(some, held, x)):
            together = one.cov - held.covariance
            together[np.diag_indices(P)] = 0.0
            inverse = np.linalg.inv(held.covariance + np.diag(variance[k]))
            at = inverse @ (held.mean - mean[k])
            first[k] = 0.5 * (at @ together @ at - np.trace(inverse @ together))
        if share == 1e-12:
            assert apart == pytest.approx(np.zeros(len(x)), abs=1e-8)
        else:
            assert np.abs(apart).max() > 10.0 * np.abs(apart - first).max()
        rest.append(apart - first)
    assert np.linalg.norm(rest[1]) == pytest.approx(4.0 * np.linalg.norm(rest[2]), rel=0.2)


def test_held_against_what_the_calibration_was_it_is_its_posterior(features: Features) -> None:
    x = _points()
    own = density(features.components, features.scale)(x)
    here = Decorrelated.of(features, features.targets)(x)
    # the chain's has 2 pi for each of its fewer components, and not the size of the covariance
    assert here - here[0] == pytest.approx(own - own[0], rel=1e-4, abs=1e-3)


def test_the_evidence_of_correlated_targets_in_closed_form() -> None:
    """Features linear in two inputs: prior uniform, the posterior all inside the box."""
    rng = np.random.default_rng(2)
    slope, start = 4.0 * rng.normal(size=(6, 2)), rng.normal(size=6)
    covariance = 0.3**2 * 0.7 ** np.abs(np.subtract.outer(np.arange(6), np.arange(6)))
    lower = np.linalg.cholesky(covariance)
    names = tuple(f"f{j}_mm" for j in range(6))
    mean = start + slope @ [0.4, 0.6] + lower @ rng.standard_normal(6)
    targets = Targets(names, mean, np.full(6, 0.3), covariance)
    z = rng.random((8, 2))
    residual = solve_triangular(lower, (start + z @ slope.T - mean).T, lower=True).T
    jacobian = np.tile(solve_triangular(lower, slope, lower=True), (8, 1, 1))
    space = make_box(("a", "b"), [10.0, 20.0], [12.0, 21.0])
    made = Features(fit(z, residual, jacobian), Scale.of(space), targets, names)
    found = compare([Model("plane", made, space)], targets, particles=300).fits[0]
    precision = slope.T @ np.linalg.solve(covariance, slope)
    at = np.linalg.solve(precision, slope.T @ np.linalg.solve(covariance, mean - start))
    least = mean - start - slope @ at
    asked = -0.5 * (least @ np.linalg.solve(covariance, least) + 6 * math.log(2 * math.pi) + np.linalg.slogdet(covariance)[1])
    asked += math.log(2 * math.pi) - 0.5 * np.linalg.slogdet(precision)[1]
    assert np.sqrt(np.diag(np.linalg.inv(precision))).max() < 0.06  # the box ends six standard deviations away
    assert found.log_evidence == pytest.approx(asked, abs=max(4 * found.log_evidence_se, 0.1))
    assert found.rmse_mm == pytest.approx(np.sqrt((least**2).mean()), rel=0.1)
