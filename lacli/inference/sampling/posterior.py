"""Sampling the posterior: several independent ensembles, stopped by R-hat and effective sample size, continued at will."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import emcee
import numpy as np
from scipy.optimize import minimize
from scipy.stats import qmc

from lacli.base import quiet
from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError, LacliError, UsageError
from lacli.base.schema import Array, array_file, unfit, write_arrays
from lacli.base.threads import single_threaded
from lacli.contracts.identity import Identity, conflict, identify, parse_identity
from lacli.contracts.priors import Prior, prior_sd
from lacli.inference.box import Box
from lacli.inference.sampling.likelihood import Density
from lacli.inference.sampling.mixture import fit_mixture
from lacli.inference.sampling.moves import EnsemblesMove
from lacli.inference.surrogate import fit_surrogate

_FORMAT = 2
_WALK = 3  # which moves the walkers make
STOPPING = frozenset({"rhat", "ess", "max_steps"})  # settings that say when a chain is long enough, not where it goes
# an input whose sd the targets shrink by less than this has stayed as it was known before
LEAST_CONTRACTION = 0.2
# before anything is kept: steps of plain moves; of a walk at this temperature, whose states reach further along the arms of a
# curved density, and teach the chain's proposals; of a walk back at temperature 1
_TUNING, _LEARNING, _HOT, _SETTLING = 200, 100, 2.0, 50
_ROUND = 50  # steps between saves
# a stand-in whose log likelihood is off by more than this is accepted too seldom to pay
_SURROGATE_ERROR = 2.0
_SURROGATE_POINTS = 1600
# of the mixture that some steps jump to; as wide as hot states and a little more, in variance: walls let no heat through
_MIXTURE_POINTS, _COMPONENTS, _WIDER = 7200, 48, 1.4
# R-hat and ESS are not known before they are looked at first
_SCHEMA = {
    "names": Array("text", ("d",), distinct=True),
    "samples": Array(shape=("steps", "ensembles", "walkers", "d")),
    "log_prob": Array(shape=("steps", "ensembles", "walkers")),
    "acceptance": Array(least=0.0, most=1.0),
    "rhat": Array(shape=("d",), finite=False),
    "ess": Array(shape=("d",), finite=False),
    "flags": Array("bool", (2,)),
    "tuning_points": Array(shape=("points", "d")),
    "generator": Array("int", (624,), least=0, most=2**32 - 1),
    "generator_rest": Array(shape=(3,)),
    "key": Array("text"),
}


@dataclass(frozen=True)
class Settings:
    """Chains of a posterior: ``ensembles`` independent groups of ``walkers`` (0: four per input); stop at rhat and ess, or
    at max_steps."""

    ensembles: int = 4
    walkers: int = 0
    rhat: float = 1.01
    ess: float = 5000.0
    max_steps: int = 20_000
    seed: int = 0


@dataclass(frozen=True)
class Chain:
    """samples (steps, ensembles, walkers, d) after tuning; log_prob (steps, ensembles, walkers); acceptance share;
    rhat, ess (d,): over the independent ensembles, and the effective number of samples; converged: both asked for are met;
    random_state and coefficients of the stand-in: what a continuation needs; key: its identity, as text."""

    names: tuple[str, ...]
    samples: FloatArray
    log_prob: FloatArray
    acceptance: float
    rhat: FloatArray
    ess: FloatArray
    converged: bool
    random_state: tuple
    tuning_points: FloatArray
    uses_surrogate: bool
    key: str

    @property
    def steps(self) -> int:
        """Steps kept so far."""
        return len(self.samples)

    def flat(self) -> FloatArray:
        """All samples after the first tenth, (m, d)."""
        return self.samples[self.steps // 10 :].reshape(-1, self.samples.shape[-1])

    def flat_log_prob(self) -> FloatArray:
        """log posterior of ``flat`` (m,)."""
        return self.log_prob[self.steps // 10 :].ravel()


@single_threaded
def sample_posterior(
    density: Density,
    settings: Settings,
    start: FloatArray | None = None,
    previous: Chain | None = None,
    keep: Callable[[Chain], None] | None = None,
) -> Chain:
    """Sample until R-hat < settings.rhat and ESS >= settings.ess for every input, or the cap; the result says which.

    start (m, d): points of the region, spread wider than the posterior (an NROY sample); found here if None. A
    ``previous`` chain is continued with the same random numbers an uninterrupted run would have used. ``keep`` is
    called at every save point.
    """
    settings = _with_walkers(settings, density)
    if settings.walkers < 2 * density.d + 2 or settings.walkers % 2:
        raise LacliError(
            f"posterior: {settings.walkers} walkers for {density.d} inputs; an even number above {2 * density.d} is needed."
        )
    identity = chain_identity(density, settings)
    if previous is not None and (words := conflict(parse_identity(previous.key), identity, "a chain")):
        raise UsageError(f"the file to continue {words}. Sample into another one.")
    chain = previous if previous is not None and previous.steps else _tune(density, settings, start, identity.text())
    move = _move(density, settings, chain.tuning_points, _WIDER)
    chain = replace(chain, uses_surrogate=move.surrogate is not None)
    count = settings.ensembles * settings.walkers
    sampler = emcee.EnsembleSampler(count, density.d, density, moves=move, vectorize=True)
    if chain.steps:
        state = emcee.State(chain.samples[-1].reshape(count, -1), chain.log_prob[-1].ravel(), random_state=chain.random_state)
        _check_continuation(density, settings, chain)
        checked = _check_at(chain.steps) <= chain.steps or chain.steps >= settings.max_steps
        if checked and _satisfied(chain, settings):
            return replace(chain, converged=True)
        chain = replace(chain, converged=False)  # it may have been, by what was asked for before
    else:
        last = chain.tuning_points[-count:]
        state = emcee.State(last, density(last), random_state=chain.random_state)
    while not chain.converged and chain.steps < settings.max_steps:
        steps = min(_ROUND, settings.max_steps - chain.steps)
        state = sampler.run_mcmc(state, steps, skip_initial_state_check=True)
        shape = (steps, settings.ensembles, settings.walkers)
        total = chain.steps + steps
        chain = replace(
            chain,
            samples=np.concatenate([chain.samples, sampler.get_chain().reshape(*shape, density.d)]),
            log_prob=np.concatenate([chain.log_prob, sampler.get_log_prob().reshape(shape)]),
            acceptance=(chain.acceptance * chain.steps + float(np.mean(sampler.acceptance_fraction)) * steps) / total,
            random_state=state.random_state,
        )
        sampler.reset()
        if total == _check_at(total) or total >= settings.max_steps:
            chain = _checked(chain, settings)
        if keep is not None:
            keep(chain)
    return chain


def _check_continuation(density: Density, settings: Settings, chain: Chain) -> None:
    """Raises InputError where the last state is none that this walk can have arrived at."""
    shape = (settings.ensembles, settings.walkers, density.d)
    if chain.samples.shape[1:] != shape or len(chain.tuning_points) < settings.ensembles * settings.walkers:
        raise InputError(f"the chain to continue has states of shape {chain.samples.shape[1:]}, {shape} is expected; remove it.")
    now = density(chain.samples[-1].reshape(-1, density.d))
    # to rounding: another machine sums in another order
    if not np.allclose(now, chain.log_prob[-1].ravel(), rtol=1e-6, atol=1e-6):
        raise InputError("the chain to continue does not have the probabilities it says; it was damaged: remove it.")


def _check_at(steps: int) -> int:
    """The first step number from ``steps`` on at which convergence is looked at: every round, then ever wider apart."""
    at = 2 * _ROUND
    while at < steps:
        at = _ROUND * int(np.ceil(at * 1.25 / _ROUND))
    return at


def _satisfied(chain: Chain, settings: Settings) -> bool:
    return bool((chain.rhat < settings.rhat).all() and (chain.ess >= settings.ess).all())


def _checked(chain: Chain, settings: Settings) -> Chain:
    rhat, ess = diagnostics(chain.samples[chain.steps // 10 :])
    chain = replace(chain, rhat=rhat, ess=ess)
    return replace(chain, converged=_satisfied(chain, settings))


def diagnostics(samples: FloatArray) -> tuple[FloatArray, FloatArray]:
    """R-hat (d,) and ESS (d,) of samples (steps, ensembles, walkers, d).

    R-hat compares the independent ensembles (each one's walkers strung together in time; rank-normalised, split in
    halves): over the walkers of one ensemble, which know of each other, it would mean nothing. ESS (bulk) takes each
    walker as a chain.
    """
    arviz = quiet.arviz()
    steps, ensembles, _, d = samples.shape
    rhat, ess = np.empty(d), np.empty(d)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for i in range(d):
            by_ensemble = samples[..., i].transpose(1, 0, 2).reshape(ensembles, -1)
            rhat[i] = arviz.rhat(by_ensemble) if ensembles > 1 else np.nan
            ess[i] = arviz.ess(samples[..., i].reshape(steps, -1).T.copy())
    return rhat, ess


def _tune(density: Density, settings: Settings, start: FloatArray | None, key: str) -> Chain:
    """Starting walkers, plain steps, and a hotter walk with proposals learnt from these; keeps its states, from which the chain's
    proposals are learnt, and the walkers at the end."""
    rng = np.random.default_rng(settings.seed)
    count, d = settings.ensembles * settings.walkers, density.d
    state = emcee.State(starting_walkers(density, count, rng, start))
    state.random_state = np.random.RandomState(settings.seed).get_state()

    def walk(move: EnsemblesMove, steps: int, most: int, of: Callable[[FloatArray], FloatArray] = density) -> FloatArray:
        """Go on from ``state``; some ``most`` of the states of the last half (m, d)."""
        nonlocal state
        sampler = emcee.EnsembleSampler(count, d, of, moves=move, vectorize=True)
        begin = emcee.State(state.coords, random_state=state.random_state)  # its density is not this one
        state = sampler.run_mcmc(begin, steps, skip_initial_state_check=True)
        visited = sampler.get_chain()[steps // 2 :].reshape(-1, d)
        return visited[:: max(1, len(visited) // most)]

    plain = EnsemblesMove(settings.ensembles, density.region.box.upper - density.region.box.lower)
    move = _move(density, settings, walk(plain, _TUNING, _SURROGATE_POINTS), _HOT)
    told = walk(move.tempered(_HOT), _LEARNING, _MIXTURE_POINTS, lambda x: density(x) / _HOT)
    walk(move, _SETTLING, 1)
    empty = np.empty((0, settings.ensembles, settings.walkers))
    nothing = np.full(d, np.nan)
    return Chain(
        density.region.box.names,
        np.empty((*empty.shape, d)),
        empty,
        0.0,
        nothing,
        nothing,
        False,
        state.random_state,
        np.vstack([told, state.coords]),
        False,
        key,
    )


def _move(density: Density, settings: Settings, points: FloatArray, widened: float) -> EnsemblesMove:
    """With proposals learnt from points (m, d); jumps are to a mixture so many times as wide as they, in variance."""
    width = density.region.box.upper - density.region.box.lower
    surrogate, error = fit_surrogate(density, points[:: max(1, len(points) // _SURROGATE_POINTS)])
    mixture = fit_mixture(points, width, most=_COMPONENTS, widened=widened)
    return EnsemblesMove(settings.ensembles, width, surrogate if error < _SURROGATE_ERROR else None, mixture=mixture)


def starting_walkers(density: Density, count: int, rng: np.random.Generator, start: FloatArray | None) -> FloatArray:
    """Points (count, d) spread wider than the posterior: drawn from ``start`` (or a Sobol' sequence of the box) with
    tempered likelihood weights, hot enough that many points share the weight."""
    if start is None:
        box = density.region.box
        start = box.from_unit(qmc.Sobol(box.d, rng=rng).random(1 << 14))
    value = density(start)
    inside = np.flatnonzero(np.isfinite(value))
    if len(inside) < count:
        if len(density.region.waves):
            sample = density.region.sample(max(4 * count, 2000), seed=int(rng.integers(1 << 31)))
            start, value = sample.points, density(sample.points)
            inside = np.flatnonzero(np.isfinite(value))
        if len(inside) < count:
            raise LacliError("posterior: too few points of positive probability to start from; the region is too small or empty.")
    start, value = start[inside], value[inside]
    temperature = 1.0
    while True:
        weight = np.exp((value - value.max()) / temperature)
        weight /= weight.sum()
        if 1.0 / (weight**2).sum() > min(4 * count, 0.5 * len(value)):
            break
        temperature *= 1.5
    return start[rng.choice(len(start), count, replace=False, p=weight)]


@single_threaded
def maximum(density: Density, chain: Chain, tries: int = 5) -> tuple[FloatArray, float]:
    """The most probable point (d,) and its log posterior, climbed to from the best samples."""
    x, value = chain.flat(), chain.flat_log_prob()
    box = density.region.box
    order = np.argsort(-value)
    best_x, best = x[order[0]], float(value[order[0]])
    width = box.upper - box.lower

    def slope(u: FloatArray) -> tuple[float, FloatArray]:
        h = 1e-5
        steps = np.clip(u + h * np.vstack([np.zeros(box.d), np.eye(box.d), -np.eye(box.d)]), 0.0, 1.0)
        points = box.from_unit(steps)
        log_l = np.maximum(density.log_likelihood(points) + density.log_prior(points), -1e30)  # a prior's end is a wall
        span = steps[1 : 1 + box.d].diagonal() - steps[1 + box.d :].diagonal()
        return -float(log_l[0]), -(log_l[1 : 1 + box.d] - log_l[1 + box.d :]) / span

    for i in order[:: max(1, len(order) // (20 * tries))][:tries]:
        u0 = box.to_unit(x[i])
        climbed = minimize(slope, u0, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * box.d, options={"maxiter": 200})
        # where the climb leaves the region, the best point on the way from the sample that is still in it
        way = box.lower + width * (u0 + np.linspace(0.0, 1.0, 64)[:, None] * (climbed.x - u0))
        values = density(np.clip(way, box.lower, box.upper))
        if values.max() > best:
            best_x, best = way[int(values.argmax())], float(values.max())
    return np.clip(best_x, box.lower, box.upper), best


def summary(chain: Chain, most_probable: FloatArray, box: Box, priors: Sequence[Prior] | None) -> list[dict[str, float | str]]:
    """For each input: mean, sd, median, central 95 % interval, the most probable value, R-hat, ESS; prior_sd, and contraction
    1 - sd / prior_sd: near 0 where the targets told nothing."""
    flat = chain.flat()
    before = prior_sd(priors, box.names, box.lower, box.upper)
    low, median, high = np.quantile(flat, [0.025, 0.5, 0.975], axis=0)
    return [
        {
            "input": name, "mean": float(flat[:, i].mean()), "sd": float(flat[:, i].std(ddof=1)), "median": float(median[i]),
            "low95": float(low[i]), "high95": float(high[i]), "map": float(most_probable[i]),
            "rhat": float(chain.rhat[i]), "ess": float(chain.ess[i]),
            "prior_sd": float(before[i]), "contraction": 1.0 - float(flat[:, i].std(ddof=1) / before[i]),
        }
        for i, name in enumerate(chain.names)
    ]  # fmt: skip


def learnt(row: dict[str, float | str]) -> str:
    """What the targets told of an input, by its row of ``summary``, in words: by how much its sd is below the prior's."""
    share = float(row["contraction"])
    return f"{share:.0%}" if share >= LEAST_CONTRACTION else "as the prior"


def chain_identity(density: Density, settings: Settings) -> Identity:
    """Everything the random walk depends on; stopping rules are left out, so that a longer run continues."""
    walk = {f.name: getattr(_with_walkers(settings, density), f.name) for f in fields(settings) if f.name not in STOPPING}
    return identify("chain", density=density, format=_FORMAT, walk=_WALK, **walk)


def _with_walkers(settings: Settings, density: Density) -> Settings:
    return settings if settings.walkers else replace(settings, walkers=4 * density.d)


def save_chain(path: Path, chain: Chain) -> None:
    """Write the chain to an .npz file, whole or not at all."""
    name, keys, position, has_gauss, gauss = chain.random_state
    assert name == "MT19937"
    arrays = {
        "format": _FORMAT, "names": np.array(chain.names), "samples": chain.samples, "log_prob": chain.log_prob,
        "acceptance": np.array(chain.acceptance), "rhat": chain.rhat, "ess": chain.ess, "key": chain.key,
        "flags": np.array([chain.converged, chain.uses_surrogate]), "tuning_points": chain.tuning_points,
        "generator": keys, "generator_rest": np.array([position, has_gauss, gauss], float),
    }  # fmt: skip
    write_arrays(path, arrays, compressed=False)


def load_chain(path: Path) -> Chain:
    """Read what ``save_chain`` wrote; InputError if it cannot be."""
    with array_file(path, "a chain", "Remove it to sample anew.", sealed=True) as file:
        if int(file.read({"format": Array("int")})["format"]) != _FORMAT:
            raise InputError(f"{path}: a chain of another format; remove it to sample anew.")
        a = file.read(_SCHEMA)
        if len(a["samples"]) < 1 or min(a["samples"].shape) < 1:
            raise unfit("it holds no sample")
        if not (0 <= a["generator_rest"][0] <= 624 and a["generator_rest"][1] in (0, 1)):
            raise unfit("the state of its random numbers is none")
    rest = a["generator_rest"]
    state = ("MT19937", a["generator"].astype(np.uint32), int(rest[0]), int(rest[1]), float(rest[2]))
    return Chain(
        tuple(a["names"].tolist()), a["samples"], a["log_prob"], float(a["acceptance"]), a["rhat"], a["ess"],
        bool(a["flags"][0]), state, a["tuning_points"], bool(a["flags"][1]), str(a["key"]),
    )  # fmt: skip
