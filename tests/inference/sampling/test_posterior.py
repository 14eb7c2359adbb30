"""Posteriors with closed form: mean within three Monte Carlo errors, sd within 3 %."""

from dataclasses import replace

import h5netcdf
import numpy as np
import pytest
from exact import ExactEmulators
from scipy import stats

from lacli.base.errors import InputError, UsageError
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.matching.matching import Region, Wave
from lacli.inference.sampling import posterior as mcmc
from lacli.inference.sampling.arviz_file import write_inference_data
from lacli.inference.sampling.likelihood import Density, gaussian_log_likelihood
from lacli.inference.sampling.mixture import fit_mixture

# an ESS of 10,000 makes the sd's own Monte Carlo error 1 / sqrt(20,000) = 0.7 %
SETTINGS = mcmc.Settings(ess=10_000.0, seed=1)


def box(d, half):
    return make_box([f"x{i}" for i in range(d)], [-half] * d, [half] * d)


def targets(mean, sd):
    return Targets(tuple(f"y{j}" for j in range(len(mean))), np.array(mean, float), np.array(sd, float))


def check(density, mean, sd, settings=SETTINGS):
    chain = mcmc.sample_posterior(density, settings)
    assert chain.converged and (chain.rhat < 1.01).all()
    flat = chain.flat()
    error = np.asarray(sd) / np.sqrt(chain.ess)
    assert (np.abs(flat.mean(0) - mean) < 3 * error).all(), (flat.mean(0), mean, error)
    assert flat.std(0) == pytest.approx(sd, rel=0.03)
    return chain


def moments(density, low, high):
    """Mean and sd of a density on an interval by quadrature."""
    s = np.linspace(low, high, 200_001)
    w = density(s)
    w /= w.sum()
    mean = (w * s).sum()
    return mean, np.sqrt((w * (s - mean) ** 2).sum())


def test_log_likelihood_by_hand():
    value = gaussian_log_likelihood(np.array([[1.0, 2.0]]), np.array([[3.0, 0.0]]), targets([0.0, 4.0], [1.0, 2.0]))
    # total variances 4 and 4: -1/2 (1/4 + 4/4 + 2 log(2 pi 4))
    assert value[0] == pytest.approx(-0.5 * (1.25 + 2 * np.log(8 * np.pi)))


def test_linear_gaussian():
    a = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -1.0], [0.3, 0.0, 2.0], [1.0, 1.0, 1.0]])
    t = targets([1.0, -0.5, 0.2, 0.4], [0.3, 0.2, 0.5, 0.4])
    precision = a.T @ np.diag(1 / t.sd**2) @ a
    covariance = np.linalg.inv(precision)
    mean = covariance @ a.T @ (t.mean / t.sd**2)
    density = Density(ExactEmulators(3, 4, lambda x: x @ a.T), t, Region(box(3, 20.0)))
    chain = check(density, mean, np.sqrt(np.diag(covariance)))
    assert np.cov(chain.flat().T) == pytest.approx(covariance, abs=0.05 * np.diag(covariance).max())
    best, _ = mcmc.maximum(density, chain)
    assert best == pytest.approx(mean, abs=1e-3)


def test_truncated_by_the_box():
    # independent: N(0.8, 0.5^2) and N(-2, 1) on [-1, 1]
    density = Density(ExactEmulators(2, 2, lambda x: x), targets([0.8, -2.0], [0.5, 1.0]), Region(box(2, 1.0)))
    one = stats.truncnorm((-1 - 0.8) / 0.5, (1 - 0.8) / 0.5, 0.8, 0.5)
    two = stats.truncnorm(1.0, 3.0, -2.0, 1.0)
    chain = check(density, [one.mean(), two.mean()], [one.std(), two.std()])
    best, _ = mcmc.maximum(density, chain)
    assert best == pytest.approx([0.8, -1.0], abs=1e-3)


def test_varying_emulator_variance():
    def variance(x):
        return 0.05 + 2.0 * np.clip(x + 1, 0, None) ** 2

    density = Density(ExactEmulators(2, 2, lambda x: x, variance), targets([0.0, 0.3], [0.2, 0.2]), Region(box(2, 3.0)))

    def marginal(mu, with_log=True):
        def value(s):
            v = 0.04 + variance(s)
            return np.exp(-0.5 * (s - mu) ** 2 / v - (0.5 * np.log(v) if with_log else 0.0))

        return moments(value, -3.0, 3.0)

    mean, sd = np.array([marginal(0.0), marginal(0.3)]).T
    check(density, mean, sd)
    # the test sees the log term: without it the mean would be far off
    assert abs(marginal(0.0, False)[0] - mean[0]) > 0.25 * sd[0]


def test_thin_band_of_what_is_not_ruled_out():
    # y = x0 + x1 with sd 1, ruled out beyond |y - 0.3| = 0.02: s = x0 + x1 is nearly uniform on the band, x0 - x1 free
    emulators = ExactEmulators(2, 1, lambda x: x.sum(1, keepdims=True))
    t = targets([0.3], [1.0])
    region = Region(box(2, 1.0)).add(Wave(emulators, t, 0.02))
    mean, sd = moments(lambda s: np.exp(-0.5 * (s - 0.3) ** 2) * (2 - np.abs(s)), 0.28, 0.32)
    # x0 given s is uniform on [s - 1, 1]: mean s / 2, variance (2 - s)^2 / 12
    x_sd = np.sqrt((2 - 0.3) ** 2 / 12)
    chain = check(Density(emulators, t, region), [0.15, 0.15], [x_sd, x_sd])
    s = chain.flat().sum(1)
    assert (np.abs(s - 0.3) < 0.02).all()
    assert s.mean() == pytest.approx(mean, abs=3 * sd / np.sqrt(5000)) and s.std() == pytest.approx(sd, rel=0.03)


def test_two_modes_keep_their_shares():
    # y = x^2, target 1 +- 0.1: two equal modes at -1 and 1
    density = Density(
        ExactEmulators(2, 2, lambda x: np.c_[x[:, 0] ** 2, x[:, 1]]), targets([1.0, 0.0], [0.1, 0.5]), Region(box(2, 3.0))
    )
    chain = mcmc.sample_posterior(density, replace(SETTINGS, walkers=40))
    assert (chain.flat()[:, 0] > 0).mean() == pytest.approx(0.5, abs=0.08)


def banana():
    return Density(
        ExactEmulators(2, 2, lambda x: np.c_[x[:, 0], x[:, 1] - x[:, 0] ** 2]),
        targets([0.0, 0.0], [0.7, 0.1]),
        Region(box(2, 3.0)),
    )


def test_a_longer_run_continues_a_shorter_one(tmp_path):
    whole = mcmc.sample_posterior(banana(), mcmc.Settings(ess=1e9, max_steps=300, seed=3))
    part = mcmc.sample_posterior(banana(), mcmc.Settings(ess=1e9, max_steps=150, seed=3))
    mcmc.save_chain(tmp_path / "c.npz", part)
    back = mcmc.load_chain(tmp_path / "c.npz")
    continued = mcmc.sample_posterior(banana(), mcmc.Settings(ess=1e9, max_steps=300, seed=3), previous=back)
    assert np.array_equal(continued.samples, whole.samples) and np.array_equal(continued.log_prob, whole.log_prob)
    assert not whole.converged  # the cap is said plainly
    with pytest.raises(UsageError, match=r"holds a chain made from something else: .*"):
        mcmc.sample_posterior(banana(), mcmc.Settings(seed=4), previous=back)
    (tmp_path / "c.npz").write_bytes(b"no chain")
    with pytest.raises(InputError, match="damaged"):
        mcmc.load_chain(tmp_path / "c.npz")


def test_a_chain_that_met_less_goes_on_when_more_is_asked(tmp_path):
    few, many = mcmc.Settings(ess=300, walkers=30, seed=5), mcmc.Settings(ess=12000, walkers=30, seed=5)
    part = mcmc.sample_posterior(banana(), few)
    assert part.converged and (part.ess < 12000).any()
    mcmc.save_chain(tmp_path / "c.npz", part)
    whole = mcmc.sample_posterior(banana(), many, previous=mcmc.load_chain(tmp_path / "c.npz"))
    assert whole.converged and (whole.ess >= 12000).all() and whole.steps > part.steps
    assert np.array_equal(whole.samples, mcmc.sample_posterior(banana(), many).samples)
    # and where the cap is reached before, it is said
    short = mcmc.sample_posterior(banana(), replace(many, max_steps=part.steps), previous=part)
    assert not short.converged and short.steps == part.steps
    again = mcmc.sample_posterior(banana(), replace(few, max_steps=part.steps), previous=part)
    assert again.converged and again.steps == part.steps


def test_the_region_sampled_is_the_one_matched():
    """Correlated errors: two targets, each one sd off the other way, are ruled out by their difference alone."""
    rho, sd = 0.98, np.array([0.2, 0.4])
    covariance = np.array([[1.0, rho], [rho, 1.0]]) * np.outer(sd, sd)
    held = Targets(("y0", "y1"), np.zeros(2), sd, covariance)
    wave = Wave(ExactEmulators(2, 2, lambda x: x), held, 3.0)
    density = Density(wave.emulators, held, Region(box(2, 3.0), (wave,)))
    # (1, -1) / sqrt 2 of the whitened pair: variance 1 - rho, so sqrt 2 / sqrt .02 = 10 standard deviations
    x = np.array([[0.2, -0.4], [0.2, 0.4]])
    assert density.region.contains(x).tolist() == [False, True]
    assert np.isfinite(density(x)).tolist() == [False, True]


def test_a_chain_killed_at_any_save_ends_the_same(tmp_path):
    settings = mcmc.Settings(ess=2500, walkers=30, seed=5)
    whole = mcmc.sample_posterior(banana(), settings)
    seen = []

    class Killed(Exception):
        pass

    def keep(chain):
        mcmc.save_chain(tmp_path / "c.npz", chain)
        seen.append(chain.steps)
        raise Killed

    chain = None
    for _ in range(1000):
        try:
            previous = mcmc.load_chain(tmp_path / "c.npz") if seen else None
            chain = mcmc.sample_posterior(banana(), settings, previous=previous, keep=keep)
            break
        except Killed:
            continue
    assert chain is not None and len(seen) > 1
    assert np.array_equal(chain.samples, whole.samples) and np.array_equal(chain.ess, whole.ess) and chain.converged


def test_diagnostics_know_ensembles_that_disagree():
    rng = np.random.default_rng(0)
    samples = rng.standard_normal((200, 4, 10, 2))
    rhat, ess = mcmc.diagnostics(samples)
    assert (rhat < 1.005).all() and ess == pytest.approx(8000, rel=0.2)
    samples[:, 2, :, 0] += 1.0
    assert mcmc.diagnostics(samples)[0][0] > 1.05
    slow = np.repeat(samples[:20], 10, axis=0)  # each state ten times: a tenth of the samples counts
    assert mcmc.diagnostics(slow)[1][1] == pytest.approx(800, rel=0.35)


def test_arviz_reads_the_file(tmp_path):
    import warnings

    chain = mcmc.sample_posterior(banana(), mcmc.Settings(ess=1e9, max_steps=100, seed=3))
    write_inference_data(tmp_path / "p.nc", chain)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import arviz

        data = arviz.from_netcdf(str(tmp_path / "p.nc"), engine="h5netcdf")
        assert set(data.posterior.data_vars) == {"x0", "x1"}
        assert data.posterior["x0"].shape == (4 * 8, 90)
        for group in (data.posterior, data.sample_stats):
            assert group["ensemble"].values.tolist() == np.repeat(np.arange(4), 8).tolist()
        third = data.posterior["x0"].values[data.posterior["ensemble"].values == 2]
        assert np.array_equal(third, chain.samples[10:, 2, :, 0].T)
        assert float(data.posterior["x1"].mean()) == pytest.approx(chain.flat()[:, 1].mean())
        data.close()


def test_a_unit_with_a_slash_goes_into_the_file(tmp_path):
    chain = mcmc.sample_posterior(banana(), mcmc.Settings(ess=1e9, max_steps=100, seed=3))
    write_inference_data(tmp_path / "p.nc", replace(chain, names=("rate [/s]", "k [kPa/mm]")))
    with h5netcdf.File(tmp_path / "p.nc") as file:
        assert {"rate [ per s]", "k [kPa per mm]"} < set(file["posterior"].variables)


def test_separate_parts_exchange_walkers():
    # two modes 40 sd apart with masses 0.95 and 0.05: differences of walkers seldom reach from one to the other
    t = targets([0.0, 0.0], [1.0, 1.0])
    small = 0.05 / 0.95

    def mean(x):
        # -1/2 m1^2 = log of the mixture (up to a constant); the second output is a plain normal
        log = np.logaddexp(-0.5 * ((x[:, 0] + 2.0) / 0.1) ** 2, np.log(small) - 0.5 * ((x[:, 0] - 2.0) / 0.1) ** 2)
        return np.c_[np.sqrt(np.maximum(-2.0 * (log - np.log1p(small)), 0.0)), x[:, 1]]

    chain = mcmc.sample_posterior(Density(ExactEmulators(2, 2, mean), t, Region(box(2, 6.0))), replace(SETTINGS, ess=2000.0))
    assert chain.converged
    share = (chain.flat()[:, 0] > 0).mean()
    # binomial with the effective number of samples
    assert share == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / chain.ess[0]))
    crossings = np.diff(np.sign(chain.samples[..., 0]), axis=0) != 0
    assert crossings.any(0).mean() > 0.5  # most walkers have seen both


def test_mixture_density_against_scipy():
    rng = np.random.default_rng(0)
    x = np.r_[rng.normal(0, 1, (200, 2)), rng.normal(8, 0.5, (100, 2))]
    fitted = fit_mixture(x, np.array([1.0, 3.0]))
    by_hand = sum(
        w * stats.multivariate_normal(m, f @ f.T).pdf(x)
        for w, m, f in zip(fitted.weights, fitted.means, fitted.factors, strict=True)
    )
    assert fitted.log_density(x) == pytest.approx(np.log(by_hand))
    drawn = fitted.sample(np.random.RandomState(1), 20_000)
    assert (drawn[:, 0] > 5).mean() == pytest.approx(1 / 3, abs=0.02)
    # one component: twice the variance of its points
    one = fit_mixture(x[:100], np.ones(2))
    assert one.factors[0] @ one.factors[0].T == pytest.approx(2 * np.cov(x[:100].T, bias=True), abs=1e-6)
