"""Figures of the inference, asked against measured: ``python benchmarks/inference.py [name ...]``.

Names: accuracy, training, prediction, sobol, wave, region, likelihood, comparison, mcmc, coverage. Without a name: all but
coverage (minutes). Times are CPU seconds of one thread. accuracy, training, prediction and likelihood need
``../shared/data/emulation_cardiac5`` (176 runs of a four-chamber heart; Strocchi et al. 2023).
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")  # before numpy is loaded

import functools
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.stats import qmc

from lacli.calibration.sequential.draw.likelihood import Decorrelated
from lacli.calibration.sequential.emulator import fit
from lacli.calibration.sequential.outputs import Features
from lacli.calibration.sequential.scale import Scale
from lacli.cohort.comparison import Model, compare
from lacli.contracts.tables.table import RunTable, read_runs
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.design import design
from lacli.inference.emulation.emulator import fit_emulator, fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet
from lacli.inference.emulation.validation import cross_validate
from lacli.inference.matching.matching import Region, Wave, sweep
from lacli.inference.sampling.likelihood import Density, gaussian_log_likelihood
from lacli.inference.sampling.posterior import Settings, diagnostics, sample_posterior
from lacli.inference.sensitivity import emulator_indices, function_indices, saltelli_sample, sobol_indices

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "emulation_cardiac5"


def line(what: str, asked: str, measured: str, good: bool | None = None) -> None:
    """Print one row: asked against measured."""
    verdict = "" if good is None else ("ok  " if good else "MISS")
    print(f"{verdict:5}{what:62} asked {asked:28} measured {measured}", flush=True)


def cpu(work: Callable[[], object], repeats: int = 3) -> float:
    """Least CPU seconds of some repeats."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


def cardiac() -> RunTable:
    return read_runs(DATA / "parameters.csv", DATA / "outputs.csv")


def accuracy() -> None:
    table = cardiac()
    for seed in (0, 1, 2):
        scores = cross_validate(table, seed=seed)
        r2 = np.array([s.r2 for s in scores])
        ise = np.array([s.ise for s in scores])
        nlpd = float(np.mean([s.nlpd for s in scores]))
        where = f"(folds of seed {seed})"
        line(
            f"five-fold R2, mean and worst {where}",
            ">= 0.985, 0.975",
            f"{r2.mean():.4f}, {r2.min():.4f}",
            r2.mean() >= 0.985 and r2.min() >= 0.975,
        )
        line(
            f"ISE of every output {where}",
            "0.93 - 0.98",
            " ".join(f"{v:.3f}" for v in ise),
            bool(((ise >= 0.93) & (ise <= 0.98)).all()),
        )
        line(f"NLPD, mean {where}", "<= -0.87", f"{nlpd:.2f}", nlpd <= -0.87)


def training() -> None:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    table = cardiac()
    u = 2 * (table.x - table.x.min(0)) / np.ptp(table.x, axis=0) - 1
    ours, theirs, same = [], [], True
    for j in range(len(table.outputs)):
        y = table.y[:, j]
        begin = time.process_time()
        one = fit_emulator(table.x, y)
        ours.append(time.process_time() - begin)
        two = fit_emulator(table.x, y)
        same &= np.array_equal(one.process.theta, two.process.theta) and one.inflation == two.inflation
        kernel = ConstantKernel(1.0) * RBF(np.full(9, 2.0), (0.05, 100.0)) + WhiteKernel(1e-3, (1e-8, 1e2))
        begin = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            GaussianProcessRegressor(kernel, n_restarts_optimizer=2, normalize_y=True, random_state=0).fit(u, y)
        theirs.append(time.process_time() - begin)
    a, b = float(np.mean(ours)), float(np.mean(theirs))
    line(
        "training, CPU s per emulator, n = 176 (scales, 3 starts, calibration)",
        "<= scikit-learn (3 starts)",
        f"{a:.2f} against {b:.2f} ({b / a:.1f} x)",
        a <= b,
    )
    line("repeat identical", "bit for bit", str(same), same)


def prediction() -> None:
    table = cardiac()
    emulators = EmulatorSet(table.inputs, tuple(fit_emulators(table)))
    low, high = emulators.range()
    x = np.random.default_rng(0).uniform(low, high, (100_000, 9))
    t = cpu(lambda: emulators.predict(x)) / len(table.outputs)
    line("100,000 points, mean and sd, per emulator", "<= 0.25 s", f"{t:.3f} s", t <= 0.25)
    t = cpu(lambda: emulator_indices(emulators, low, high, 1024, draws=0))
    line("Sobol' through 6 emulators, N = 1024, 9 inputs, 100 bootstraps", "<= 0.5 s", f"{t:.3f} s", t <= 0.5)
    t = cpu(lambda: emulator_indices(emulators, low, high, 1024))
    line("  the same with the emulators' uncertainty (32 draws)", "-", f"{t:.3f} s")


def sobol() -> None:
    from SALib.analyze import sobol as salib

    def ishigami(x: np.ndarray) -> np.ndarray:
        return (np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0]))[:, None]

    pi = np.pi
    v = np.array([0.5 * (1 + 0.1 * pi**4 / 5) ** 2, 49 / 8, 8 * 0.01 * pi**8 / 225])
    s = function_indices(ishigami, np.full(3, -pi), np.full(3, pi), 2**15)
    off = max(
        np.abs(s.s1[0] - [v[0] / v.sum(), v[1] / v.sum(), 0]).max(),
        np.abs(s.st[0] - [(v[0] + v[2]) / v.sum(), v[1] / v.sum(), v[2] / v.sum()]).max(),
    )
    line("Ishigami, all indices, N = 32768", "within 0.01", f"{off:.5f}", off < 0.01)
    a = np.array([0.0, 0.5, 3.0, 9.0, 99.0, 99.0])
    s = function_indices(lambda x: np.prod((np.abs(4 * x - 2) + a) / (1 + a), axis=1)[:, None], np.zeros(6), np.ones(6), 2**15)
    vi = 1 / (3 * (1 + a) ** 2)
    total = np.prod(1 + vi) - 1
    off = max(np.abs(s.s1[0] - vi / total).max(), np.abs(s.st[0] - vi * np.prod(1 + vi) / (1 + vi) / total).max())
    line("Sobol' G, all indices, N = 32768", "within 0.01", f"{off:.5f}", off < 0.01)
    points = saltelli_sample(np.full(3, -pi), np.full(3, pi), 1024, 5)
    y = np.stack([ishigami(block) for block in points])
    ours = sobol_indices(y, seed=9)
    theirs = salib.analyze({"num_vars": 3, "names": list("abc"), "bounds": [[-pi, pi]] * 3}, y[..., 0].T.ravel(), seed=9)
    off = max(
        np.nanmax(np.abs(theirs[k] - getattr(ours, k.lower())[0])) for k in ("S1", "ST", "S2", "S1_conf", "ST_conf", "S2_conf")
    )
    line("equal to SALib, indices and intervals", "1e-12", f"{off:.1e}", off < 1e-12)


def toy(n: int, seed: int = 0) -> tuple[EmulatorSet, np.ndarray, Region]:
    """Seven mildly bent outputs of nine inputs; emulators from n runs; the outputs at a truth."""
    d, p = 9, 7
    rng = np.random.default_rng(seed)
    box = make_box([f"x{i}" for i in range(d)], [0] * d, [1] * d)
    w, b = rng.standard_normal((d, p)), rng.standard_normal((d, p))

    def f(x: np.ndarray) -> np.ndarray:
        return x @ w + 0.5 * np.sin(x @ b)

    x = design(box, n)
    table = RunTable(box.names, tuple(f"y{j}" for j in range(p)), x, f(x), np.zeros((n, p)), np.empty((0, d)))
    return EmulatorSet(box.names, tuple(fit_emulators(table, starts=1))), f(np.full((1, d), 0.45))[0], Region(box)


def wave() -> None:
    emulators, truth, region = toy(200)
    for sd in (0.5, 0.12):
        w = Wave(emulators, Targets(emulators.outputs, truth, np.full(7, sd)), 3.0)
        w.below(region.box.uniform(100, np.random.default_rng(0)), 1.0)
        swept = sweep(region.add(w))
        t = cpu(functools.partial(region.add(w).below, swept.points, 1.0))
        line(f"one wave: 100,000 points, 7 outputs, n = 200 ({swept.share:.2g} left)", "<= 1 s", f"{t:.3f} s", t <= 1.0)


def region() -> None:
    emulators, truth, box = toy(200)
    for sd, limit in ((0.135, 5.0), (0.043, 60.0)):
        r = box.add(Wave(emulators, Targets(emulators.outputs, truth, np.full(7, sd)), 3.0))
        begin = time.process_time()
        s = r.sample(10_000)
        t = time.process_time() - begin
        line(
            f"10,000 points of a region of {s.volume:.1e} ± {s.volume_sd:.0e} of a 9-box",
            f"<= {limit:g} s",
            f"{t:.1f} s (correlation {s.correlation:.2f})",
            t <= limit,
        )


def likelihood() -> None:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    table = cardiac()
    emulators = EmulatorSet(table.inputs, tuple(fit_emulators(table, starts=1)))
    low, high = emulators.range()
    box = make_box(table.inputs, low.tolist(), high.tolist())
    density = Density(emulators, Targets(table.outputs, table.y.mean(0), 0.2 * table.y.std(0)), Region(box))
    x = box.uniform(18, np.random.default_rng(0))
    fitted = []
    for e in emulators.emulators:
        kernel = ConstantKernel(e.process.s2) * RBF(e.process.lengths) + WhiteKernel(e.process.nugget)
        fitted.append(GaussianProcessRegressor(kernel, optimizer=None).fit(e.process.u, e.process.y))
    mu, sd = density.targets.mean, density.targets.sd

    def one_at_a_time() -> None:
        for point in x:
            total = 0.0
            for j, g in enumerate(fitted):
                m, s = g.predict(point[None], return_std=True)
                total += float(-0.5 * (m[0] - mu[j]) ** 2 / (s[0] ** 2 + sd[j] ** 2) - 0.5 * np.log(s[0] ** 2 + sd[j] ** 2))

    slow, fast = np.inf, np.inf
    for _ in range(12):  # in turn, so that other work on the machine slows both
        slow = min(slow, cpu(one_at_a_time, 1))
        fast = min(fast, cpu(lambda: [density(x) for _ in range(50)], 1) / 50)
    line(
        "log-likelihood of 18 walkers, against one at a time by scikit-learn",
        ">= 100 x",
        f"{slow / fast:.0f} x ({fast * 1e3:.2f} ms)",
        slow >= 100 * fast,
    )


def sought(p: int, runs: int = 60) -> Features:
    """The emulator of a sequential calibration, 9 inputs, of p made-up targets whose errors go together by a made-up place."""
    rng = np.random.default_rng(0)
    names = tuple(f"x{i}" for i in range(9))
    slope, size, along, place = rng.normal(size=(p, 9)), rng.normal(size=(p, 6)), rng.normal(size=(6, 9)), rng.normal(size=(p, 3))
    sd = rng.uniform(0.3, 0.6, p)
    near = np.exp(-0.5 * ((place[:, None] - place) ** 2).sum(2))
    covariance = (0.6 * near + 0.4 * np.eye(p)) * np.outer(sd, sd)
    lower = np.linalg.cholesky(covariance)
    z = np.clip(0.5 + 0.12 * rng.standard_normal((runs, 9)), 0.0, 1.0)
    bent = np.tanh(z @ along.T)
    mean = slope @ np.full(9, 0.5) + size @ np.tanh(along @ np.full(9, 0.5)) + lower @ rng.standard_normal(p)
    residual = np.linalg.solve(lower, (z @ slope.T + bent @ size.T - mean).T).T
    jacobian = np.linalg.solve(lower, slope + np.einsum("pk,mk,kd->mpd", size, 1.0 - bent**2, along))
    targets = Targets(tuple(f"f{j}_mm" for j in range(p)), mean, sd, covariance)
    return Features(fit(z, residual, jacobian), Scale.of(make_box(names, [1.0] * 9, [2.0] * 9)), targets, targets.names)


def comparison() -> None:
    features = sought(288)
    held = features.targets.widened(dict.fromkeys(features.outputs, 0.15))
    box = features.scale.box
    x = box.uniform(100, np.random.default_rng(1))
    diagonal = Decorrelated.of(features, held)
    slow = cpu(lambda: gaussian_log_likelihood(*features.predict_truth(x), held)) / len(x)
    fast = cpu(lambda: diagonal(x)) / len(x)
    line(
        "log-likelihood of 288 correlated targets, against a factor a point",
        ">= 10 x",
        f"{slow / fast:.0f} x ({fast * 1e3:.3f} ms for {slow * 1e3:.2f})",
        slow >= 10 * fast,
    )
    t = cpu(lambda: compare([Model("regional", features, box)], held), 1)
    line("a model's evidence and PSIS-LOO, 9 inputs, 288 correlated targets", "<= 100 CPU s", f"{t:.0f} s", t <= 100)


def mcmc() -> None:
    emulators, truth, region = toy(500)
    targets = Targets(emulators.outputs, truth, np.full(7, 0.12))
    diagnostics(np.random.default_rng(0).random((20, 2, 4, 1)))  # load the library outside the timing
    for name, r in (("box", region), ("NROY", region.add(Wave(emulators, targets, 3.0)))):
        begin = time.process_time()
        chain = sample_posterior(Density(emulators, targets, r), Settings())
        t = time.process_time() - begin
        rate = chain.ess.min() / t
        line(
            f"least ESS per CPU s, tuning included, n = 500, 7 outputs, {name} prior",
            ">= 100, R-hat < 1.01",
            f"{rate:.0f} (ESS {chain.ess.min():.0f}, R-hat {chain.rhat.max():.4f}, acceptance {chain.acceptance:.2f})",
            rate >= 100 and bool((chain.rhat < 1.01).all()),
        )


def coverage(count: int = 200) -> None:
    """How often a 95 % interval contains a truth drawn from the prior, data drawn with the targets' noise.

    Emulators are fitted once; each truth has its own wave (threshold 3), region and chain, as ``lacli posterior`` makes
    them. Each interval is compared with that of points of the box weighted by the likelihood, which knows nothing of chains.
    """
    d, p, n = 4, 5, 60
    rng = np.random.default_rng(1)
    box = make_box([f"x{i}" for i in range(d)], [0] * d, [1] * d)
    w, b = rng.standard_normal((d, p)), rng.standard_normal((d, p))

    def f(x: np.ndarray) -> np.ndarray:
        return x @ w + np.sin(2 * x @ b)

    x = design(box, n)
    table = RunTable(box.names, tuple(f"y{j}" for j in range(p)), x, f(x), np.zeros((n, p)), np.empty((0, d)))
    emulators = EmulatorSet(box.names, tuple(fit_emulators(table)))
    points = box.from_unit(qmc.Sobol(d, rng=np.random.default_rng(2)).random(1 << 17))
    mean, variance = emulators.predict(points)
    noise = 0.15 * mean.std(0)
    print(f"     emulator sd / noise: {np.round(np.sqrt(variance.mean(0)) / noise, 2)}")
    begin = time.process_time()
    hits, weighted_hits, off, open_ = np.zeros(d), np.zeros(d), [], 0
    for k in range(count):
        truth = box.uniform(1, rng)
        targets = Targets(emulators.outputs, f(truth)[0] + noise * rng.standard_normal(p), noise)
        region = Region(box, (Wave(emulators, targets, 3.0),))
        inside = (np.abs(mean - targets.mean) < 3.0 * np.sqrt(variance + targets.sd**2)).all(1)
        start = points[inside]
        density = Density(emulators, targets, region)
        chain = sample_posterior(density, Settings(ess=1000.0, max_steps=1000, seed=k), start if len(start) > 500 else None)
        open_ += not chain.converged
        low, high = np.quantile(chain.flat(), [0.025, 0.975], axis=0)
        hits += (truth[0] >= low) & (truth[0] <= high)
        weight = np.exp(gaussian_log_likelihood(mean[inside], variance[inside], targets))
        ends = np.array([weighted_quantile(start[:, i], weight, [0.025, 0.975]) for i in range(d)]).T
        weighted_hits += (truth[0] >= ends[0]) & (truth[0] <= ends[1])
        if weight.sum() ** 2 / (weight**2).sum() > 300:
            off.append(np.abs(np.array([low, high]) - ends).max(0) / (high - low))
    for name, h in (("chains", hits), ("weighted points", weighted_hits)):
        share = h.sum() / (count * d)
        line(
            f"{count} truths, {d} inputs: 95 % intervals that contain them, {name}",
            "92 - 98 %",
            f"{share:.1%}, by input {np.round(h / count, 3)}",
            0.92 <= share <= 0.98,
        )
    print(
        f"     {open_} chains not converged; ends of intervals, chains against weighted points, in widths: median"
        f" {np.median(off):.3f}, worst of {len(off)} truths {np.max(off):.3f}; {time.process_time() - begin:.0f} CPU s"
    )


def weighted_quantile(x: np.ndarray, weight: np.ndarray, levels: list[float]) -> np.ndarray:
    """Quantiles of x (m,) with weights (m,)."""
    order = np.argsort(x)
    return np.interp(levels, (np.cumsum(weight[order]) - 0.5 * weight[order]) / weight.sum(), x[order])


ALL = {f.__name__: f for f in (accuracy, training, prediction, sobol, wave, region, likelihood, comparison, mcmc, coverage)}

if __name__ == "__main__":
    wanted = sys.argv[1:] or [name for name in ALL if name != "coverage"]
    for name in wanted:
        if name not in ALL:
            sys.exit(f"unknown: {name}; there are {', '.join(ALL)}")
        if name in ("accuracy", "training", "prediction", "likelihood") and not DATA.is_dir():
            print(f"     {name}: needs {DATA}")
            continue
        ALL[name]()
