"""The ensemble move: several independent ensembles in one, differences of walkers, jumps, long cheap detours before a dear
step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from emcee.moves import Move
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray
from lacli.inference.sampling.mixture import Mixture

_JITTER = 1e-5
_JUMPS = 0.1  # share of the steps that are jumps
_PLAIN = 0.15  # share of the steps without a detour: a walker where the surrogate is far too low would never leave by one


class EnsemblesMove(Move):
    """Differential-evolution steps (ter Braak 2006) within each of ``ensembles`` groups of walkers that never mix.

    Half of a group moves, by differences of two walkers of its other half. With a ``surrogate`` (an approximate log
    density), each walker first makes ``detour`` such steps under the surrogate; where it arrives is then accepted with
    probability min(1, pi(y) s(x) / (pi(x) s(y))) (surrogate transition, Liu 2001, section 9.4.3): the target is exactly
    pi, and each evaluation of pi is spent on a nearly independent point. With a ``mixture`` (fixed), some steps are jumps
    to a point of it, accepted by Metropolis and Hastings's rule: a walker in a separate part of the density, where no
    difference of others reaches, still exchanges with the rest. Some steps make no detour, so that a walker where the surrogate
    is wrong goes on. ``scale`` (d,): the box's size, for the jitter.
    """

    def __init__(
        self,
        ensembles: int,
        scale: FloatArray,
        surrogate: Callable[[FloatArray], FloatArray] | None = None,
        detour: int = 40,
        mixture: Mixture | None = None,
    ) -> None:
        self.ensembles, self.scale, self.surrogate, self.detour = ensembles, scale, surrogate, detour
        self.mixture = mixture

    def tempered(self, heat: float) -> EnsemblesMove:
        """The same moves for the density to the power 1 / heat."""
        cold = self.surrogate
        hot = None if cold is None else lambda x: cold(x) / heat
        return EnsemblesMove(self.ensembles, self.scale, hot, self.detour, self.mixture)

    def propose(self, model: Any, state: Any) -> tuple[Any, NDArray[np.bool_]]:
        """One step of all walkers; called by emcee, which hands over its random generator and density."""
        rng = model.random
        count = len(state.coords)
        walkers = count // self.ensembles
        order = np.argsort(rng.random_sample((self.ensembles, walkers)), axis=1) + walkers * np.arange(self.ensembles)[:, None]
        half = walkers // 2
        accepted = np.zeros(count, bool)
        for mine, other in ((order[:, :half], order[:, half:]), (order[:, half:], order[:, :half])):
            rows = mine.ravel()
            x = state.coords[rows]
            if self.surrogate is None or rng.random_sample() < _PLAIN:
                y, correction = x + self._steps(rng, state.coords, other, mine.shape[1], 1)[0], np.zeros(len(x))
                if self.mixture is not None and rng.random_sample() < _JUMPS:
                    y, correction = self._jump(rng, x, self.mixture)
            else:
                y, correction = self._detour(rng, x, self._steps(rng, state.coords, other, mine.shape[1], self.detour))
            log_prob, _ = model.compute_log_prob_fn(y)
            with np.errstate(invalid="ignore"):
                ratio = log_prob - state.log_prob[rows] + correction
            good = np.log(rng.random_sample(len(rows))) < ratio
            to = rows[good]
            state.coords[to] = y[good]
            state.log_prob[to] = log_prob[good]
            accepted[to] = True
        return state, accepted

    def _steps(self, rng: Any, coords: FloatArray, other: NDArray[np.int64], mine: int, count: int) -> FloatArray:
        """``count`` steps (count, ensembles * mine, d) for walkers whose other half is ``other`` (ensembles, k)."""
        groups, k = other.shape
        d = coords.shape[1]
        shape = (count, groups, mine)
        first = rng.randint(k, size=shape)
        second = (first + rng.randint(1, k, size=shape)) % k
        group = np.arange(groups)[None, :, None]
        gamma = 2.38 / np.sqrt(2 * d) * 10.0 ** rng.uniform(-0.5, 0.15, shape)
        gamma[rng.random_sample(shape) < 0.1] = 1.0  # from one mode to another
        difference = coords[other[group, first]] - coords[other[group, second]]
        steps = gamma[..., None] * difference + _JITTER * self.scale * rng.standard_normal((*shape, d))
        return steps.reshape(count, groups * mine, d)

    def _detour(self, rng: Any, x: FloatArray, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """End points (m, d) of chains under the surrogate and the correction log s(x) - log s(y) (m,)."""
        assert self.surrogate is not None
        y = x.copy()
        start = self.surrogate(x)
        value = start.copy()
        thresholds = np.log(rng.random_sample(steps.shape[:2]))
        # each step's kind is drawn anew, so that the chain of them is the same forth and back, as the correction needs
        jumps = rng.random_sample(len(steps)) < (_JUMPS if self.mixture is not None else 0.0)
        for step, threshold, jump in zip(steps, thresholds, jumps, strict=True):
            new, factor = self._jump(rng, y, self.mixture) if jump and self.mixture is not None else (y + step, 0.0)
            new_value = self.surrogate(new)
            good = threshold < new_value - value + factor
            y[good] = new[good]
            value[good] = new_value[good]
        return y, start - value

    def _jump(self, rng: Any, x: FloatArray, mixture: Mixture) -> tuple[FloatArray, FloatArray]:
        """Points (m, d) of the mixture for walkers at x, and log q(x) - log q(y) (m,)."""
        y = mixture.sample(rng, len(x))
        return y, mixture.log_density(x) - mixture.log_density(y)
