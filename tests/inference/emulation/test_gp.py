"""The Gaussian process against formulas written out in full, and the emulators built on it."""

import numpy as np
import pytest

from lacli.base.errors import InputError
from lacli.contracts.tables.table import RunTable
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.emulation import gp
from lacli.inference.emulation.emulator import fit_emulator, fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet, load_emulators, save_emulators
from lacli.inference.emulation.function_draws import _draw, draw_functions
from lacli.inference.emulation.scales import OutputScale
from lacli.inference.emulation.validation import cross_validate, score
from lacli.inference.matching.matching import Region
from lacli.inference.sampling.likelihood import Density


def data(n=40, d=3, seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (n, d))
    return u, np.sin(2 * u[:, 0]) + u[:, 1] + noise * rng.standard_normal(n)


def kernel(theta, a, b):
    d = a.shape[1]
    return np.exp(theta[d]) * np.exp(-0.5 * (((a[:, None] - b[None]) / np.exp(theta[:d])) ** 2).sum(-1))


def test_gradient_against_central_differences():
    u, y = data()
    noise = np.linspace(0.0, 0.01, len(y))
    for theta in (np.log([1.0, 2.0, 0.5, 1.5, 1e-2]), np.log([0.3, 20.0, 3.0, 0.2, 1e-4])):
        _, gradient = gp.negative_log_likelihood(theta, u, y, noise)
        h = 1e-5
        for i, e in enumerate(np.eye(5)):
            up, down = (gp.negative_log_likelihood(theta + s * h * e, u, y, noise)[0] for s in (1, -1))
            assert gradient[i] == pytest.approx((up - down) / (2 * h), rel=1e-5, abs=1e-5)


def test_likelihood_is_the_restricted_one():
    # integral of N(y | H b, K) over b: -1/2 (log|K| + log|H'K^-1 H| + y'Py), constants dropped; differences at two thetas
    u, y = data(25)
    h = np.hstack([np.ones((25, 1)), u])

    def direct(theta):
        k = kernel(theta, u, u) + np.exp(theta[-2] + theta[-1]) * np.eye(25)
        ki = np.linalg.inv(k)
        a = h.T @ ki @ h
        p = ki - ki @ h @ np.linalg.inv(a) @ h.T @ ki
        centre, spread = gp.prior(3)
        return (
            0.5 * (np.linalg.slogdet(k)[1] + np.linalg.slogdet(a)[1] + y @ p @ y) + 0.5 * (((theta - centre) / spread) ** 2).sum()
        )

    for theta in (np.log([1.0, 2.0, 0.5, 1.5, 1e-2]), np.log([0.7, 1.0, 3.0, 0.5, 1e-1])):
        assert gp.negative_log_likelihood(theta, u, y, np.zeros(25))[0] == pytest.approx(direct(theta), rel=1e-9)


def test_prediction_is_generalised_least_squares_kriging():
    u, y = data(30)
    noise = np.full(30, 3e-3)
    theta = np.log([1.0, 2.0, 0.8, 1.5, 1e-2])
    process = gp.condition(theta, u, y, noise)
    new = np.random.default_rng(1).uniform(-1.3, 1.3, (11, 3))
    k = kernel(theta, u, u) + np.diag(np.exp(theta[-2] + theta[-1]) + noise)
    ks, h, hs = kernel(theta, new, u), gp.basis(u), gp.basis(new)
    ki = np.linalg.inv(k)
    cov = np.linalg.inv(h.T @ ki @ h)
    beta = cov @ h.T @ ki @ y
    r = hs - ks @ ki @ h
    mean, variance = process.predict(new)
    assert mean == pytest.approx(hs @ beta + ks @ ki @ (y - h @ beta), rel=1e-9)
    expected = np.exp(theta[-2]) * (1 + np.exp(theta[-1])) - np.diag(ks @ ki @ ks.T) + np.diag(r @ cov @ r.T)
    assert variance == pytest.approx(expected, rel=1e-8)
    # leave-one-out: the same formulas without the run
    errors, variances = process.leave_one_out()
    keep = np.arange(30) != 4
    m, v = gp.condition(theta, u[keep], y[keep], noise[keep]).predict(u[4:5])
    assert errors[4] == pytest.approx(y[4] - m[0], rel=1e-7)
    assert variances[4] == pytest.approx(v[0] + noise[4], rel=1e-7)


def test_the_share_within_two_standard_deviations_by_runs_left_out():
    x = np.random.default_rng(3).random((30, 2))
    emulator = fit_emulator(x, np.exp(3.0 * x[:, 0]) + np.sin(6.0 * x[:, 1]))
    process, inside = emulator.process, []
    for i in range(30):
        keep = np.arange(30) != i
        rest = gp.condition(process.theta, process.u[keep], process.y[keep], process.noise[keep])
        mean, variance = rest.predict(process.u[i : i + 1])
        scaled = emulator.shift + emulator.scale * np.array([mean[0], process.y[i]])
        m, v = emulator.output_scale.moments(scaled[:1], emulator.inflation * emulator.scale**2 * (variance + process.noise[i]))
        inside.append(abs(emulator.output_scale.backward(scaled[1:])[0] - m[0]) < 2.0 * np.sqrt(v[0]))
    assert emulator.left_out_ise() == pytest.approx(np.mean(inside))
    assert 0.8 < emulator.left_out_ise() <= 1.0


def test_a_linear_function_is_learnt_exactly_and_beyond_the_runs():
    rng = np.random.default_rng(0)
    x = rng.random((20, 3))
    emulator = fit_emulator(x, x @ [1.0, -2.0, 3.0] - 5.0)
    far = 3.0 * np.ones((1, 3))
    assert emulator.predict(far)[0][0] == pytest.approx(1.0, abs=1e-2)  # 3 (1 - 2 + 3) - 5 = 1


def test_a_power_law_is_put_on_logarithmic_scales():
    rng = np.random.default_rng(1)
    x = np.exp(rng.uniform(np.log(0.1), np.log(10.0), (60, 2)))
    emulator = fit_emulator(x, 3.0 * x[:, 0] ** 1.5 / x[:, 1])
    assert emulator.output_scale == OutputScale(log=True) and emulator.log_inputs.all()
    mean, variance = emulator.predict(np.array([[2.0, 0.5]]))
    assert mean[0] == pytest.approx(3.0 * 2.0**1.5 / 0.5, rel=1e-3)
    assert 0 < variance[0] < 1e-2


def long_tailed(n, seed):
    x = np.random.default_rng(seed).random((n, 3))
    return x, np.exp(3.0 * (np.sin(2 * x[:, 0]) + x[:, 1] * x[:, 2])) - 3.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_long_tail_is_put_on_a_shifted_logarithm(sign):
    x, y = long_tailed(60, 0)
    emulator = fit_emulator(x, sign * y, starts=1)
    scale = emulator.output_scale
    assert scale.log and scale.sign == sign and (sign * scale.sign * y + scale.offset > 0).all()
    new, truth = long_tailed(400, 1)
    mean, variance = emulator.predict(new)
    error = sign * truth - mean
    assert 1 - (error**2).mean() / truth.var() > 0.98
    assert (np.abs(error) < 2 * np.sqrt(variance)).mean() > 0.9
    # batched, screened and drawn values are on the same scale
    together = EmulatorSet(("a", "b", "c"), (emulator,))
    m, v = together.predict(new[:50])
    assert m[:, 0] == pytest.approx(mean[:50], rel=1e-8, abs=1e-8) and v[:, 0] == pytest.approx(variance[:50], rel=1e-6)
    m0, m1, v0, v1 = together.screen(0, new)
    slack = 1e-9 * y.std()
    assert (m0 <= mean + slack).all() and (m1 >= mean - slack).all() and (v0 <= v1).all()
    assert np.median(draw_functions(emulator, new[:50], 2000, 0).mean(1) - mean[:50]) == pytest.approx(0, abs=0.05 * y.std())


def test_a_plain_output_stays_on_its_own_scale():
    x, _ = long_tailed(60, 0)
    y = np.sin(2 * x[:, 0]) + x[:, 1] * x[:, 2] - 1.0
    assert fit_emulator(x, y, starts=1).output_scale == OutputScale()


def test_moments_of_a_shifted_log_normal_against_quadrature():
    for scale in (OutputScale(True, 2.0, 1.0), OutputScale(True, 2.0, -1.0)):
        z, w = np.polynomial.hermite_e.hermegauss(60)
        y = scale.backward(0.3 + 0.5 * z)
        mean = (w * y).sum() / w.sum()
        m, v = scale.moments(np.array([0.3]), np.array([0.25]))
        assert m[0] == pytest.approx(mean) and v[0] == pytest.approx((w * (y - mean) ** 2).sum() / w.sum())
        assert scale.forward(y) == pytest.approx(0.3 + 0.5 * z)
        slope = (scale.forward(y + 1e-6) - scale.forward(y - 1e-6)) / 2e-6
        assert scale.log_slope(y) == pytest.approx(np.log(np.abs(slope)), abs=1e-4)


def test_known_noise_is_not_taken_for_signal():
    u, clean = data(60, seed=3)
    rng = np.random.default_rng(4)
    sd = np.where(np.arange(60) % 2, 0.5, 0.0)
    y = clean + sd * rng.standard_normal(60)
    new, truth = data(200, seed=5)
    blind = fit_emulator(u, y).predict(new)[0]
    told = fit_emulator(u, y, error_sd=sd).predict(new)[0]
    assert np.mean((told - truth) ** 2) < 0.25 * np.mean((blind - truth) ** 2)


def test_the_same_seed_gives_the_same_bits():
    u, y = data(30, noise=0.05)
    one, two = (fit_emulator(u, y, seed=3) for _ in range(2))
    assert np.array_equal(one.process.theta, two.process.theta) and one.inflation == two.inflation
    assert np.array_equal(one.process.inverse_factor, two.process.inverse_factor)


@pytest.fixture(scope="module")
def emulators():
    rng = np.random.default_rng(7)
    x = np.c_[rng.uniform(0.2, 6.0, 70), rng.uniform(-1, 1, 70), rng.uniform(5, 9, 70)]
    y = np.c_[np.log(x[:, 0]) + x[:, 1] ** 2, np.exp(0.4 * x[:, 0] * x[:, 1]), np.cos(x[:, 2])]
    table = RunTable(("a", "b", "c"), ("p", "q", "r"), x, y, np.zeros_like(y), np.empty((0, 3)))
    return EmulatorSet(table.inputs, tuple(fit_emulators(table)))


def points(count):
    rng = np.random.default_rng(8)
    return np.c_[rng.uniform(0.2, 6.0, count), rng.uniform(-1, 1, count), rng.uniform(5, 9, count)]


@pytest.mark.parametrize("count", [1, 7, 1300])
def test_batched_prediction_equals_each_emulator(emulators, count):
    x = points(count)
    mean, variance = emulators.predict(x)
    for j, e in enumerate(emulators.emulators):
        m, v = e.predict(x)
        assert mean[:, j] == pytest.approx(m, rel=1e-8, abs=1e-9)
        assert variance[:, j] == pytest.approx(v, rel=1e-6)
        m, v = emulators.predict_one(j, x)
        assert m == pytest.approx(mean[:, j], rel=1e-8, abs=1e-9) and v == pytest.approx(variance[:, j], rel=1e-6)


def test_screen_bounds_hold_everywhere(emulators):
    x = points(3000)
    mean, variance = emulators.predict(x)
    slack = 1 + 1e-9
    for j in range(3):
        m0, m1, v0, v1 = emulators.screen(j, x)
        assert (m0 <= mean[:, j] + 1e-9 * np.abs(mean[:, j])).all() and (m1 >= mean[:, j] - 1e-9 * np.abs(mean[:, j])).all()
        assert (v0 <= variance[:, j] * slack).all() and (v1 * slack >= variance[:, j]).all()


def test_saved_emulators_predict_the_same_bits(emulators, tmp_path):
    path = tmp_path / "e.npz"
    save_emulators(path, emulators)
    back = load_emulators(path)
    x = points(300)
    assert all(np.array_equal(a, b) for a, b in zip(emulators.predict(x), back.predict(x), strict=True))
    assert back.inputs == emulators.inputs and back.outputs == emulators.outputs
    assert np.allclose(np.sort(back.training_inputs(), 0), np.sort(emulators.training_inputs(), 0))
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match="damaged"):
        load_emulators(path)
    with pytest.raises(InputError, match="no such"):
        load_emulators(tmp_path / "absent.npz")


def test_log_likelihood_of_a_few_walkers_is_that_of_each_emulator(emulators):
    # 18 points take the path of one product over all outputs; the formula written out with each emulator's own prediction
    x = points(18)
    targets = Targets(("p", "q", "r"), np.array([0.5, 1.0, 0.2]), np.array([0.1, 0.2, 0.1]))
    expected = np.zeros(18)
    for e, mu, sd in zip(emulators.emulators, targets.mean, targets.sd, strict=True):
        m, v = e.predict(x)
        expected += -0.5 * ((m - mu) ** 2 / (v + sd**2) + np.log(2 * np.pi * (v + sd**2)))
    box = make_box(("a", "b", "c"), [0.2, -1, 5], [6.0, 1, 9])
    assert Density(emulators, targets, Region(box))(x) == pytest.approx(expected, rel=1e-9)


def test_function_draws_have_the_emulators_moments(emulators):
    e = emulators.emulators[2]  # linear output scale
    x = points(60)
    # at the fitted hyperparameters; draws of these, too, spread at least as far
    draws = e.output_scale.backward(e.shift + e.scale * _draw(e.process, e.to_u(x), 3000, e.inflation, np.random.default_rng(1)))
    mean, variance = e.predict(x)
    variance -= e.inflation * e.scale**2 * e.process.nugget
    z = (draws.mean(1) - mean) / np.sqrt(variance / 3000)
    # random features approximate the prior: moments agree to their accuracy
    assert np.abs(z).mean() < 3.0
    assert np.median(draws.var(1) / variance) == pytest.approx(1.0, abs=0.15)
    assert np.median(draw_functions(e, x, 1000, seed=1).var(1) / draws.var(1)) > 0.9


def test_scores_by_hand():
    # errors 0, 1, -3 with sd 1: RSS 10, TSS 2 -> R2 = -4; |error| < 2 in two of three, though -3 < 2 without the modulus
    r2, ise, nlpd = score(np.array([0.0, 1.0, 2.0]), np.array([0.0, 0.0, 5.0]), np.ones(3))
    assert r2 == pytest.approx(-4.0) and ise == pytest.approx(2 / 3)
    # standardised by the sd of y (variance 2/3): log term 1/2 log(2 pi 3/2), quadratic term 1/2 mean(0, 1, 9)
    assert nlpd == pytest.approx(0.5 * np.log(3 * np.pi) + 10 / 6)


def test_cross_validation_covers_what_it_claims():
    rng = np.random.default_rng(11)
    x = rng.random((90, 3))
    y = np.sin(4 * x[:, :1]) + x[:, 1:2] * x[:, 2:] + 0.05 * rng.standard_normal((90, 1))
    table = RunTable(("a", "b", "c"), ("y",), x, y, np.zeros_like(y), np.empty((0, 3)))
    s = cross_validate(table, starts=1)[0]
    # binomial: 0.955 of 90, sd 0.022
    assert 0.89 <= s.ise <= 1.0
    assert s.r2 > 0.95 and s.train_cpu_s > 0
