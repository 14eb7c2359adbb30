"""Sobol' indices through any vectorised function: first-order, second-order and total effects with their uncertainty.

Estimators as in SALib (first-order and total: Saltelli et al. 2010; second-order: Saltelli 2002), for all outputs and
all bootstrap resamples at once: a resample is a vector of counts, so every resampled mean is one matrix product.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, qmc

from lacli.base.arrays import FloatArray
from lacli.base.threads import single_threaded
from lacli.inference.emulation.emulator_set import AnyEmulators

Function = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Sobol:
    """Indices of p outputs to d inputs, with half-widths of 95 % intervals (``_conf``): from resampling, and, of emulators,
    from what they do not know.

    s1, st (p, d); s2 (p, d, d), upper triangle, NaN elsewhere. s1_emulator_sd, st_emulator_sd (p, d): root mean square
    distance of the indices of functions drawn from the emulators' own distribution, 0 for a known function.
    """

    s1: FloatArray
    s1_conf: FloatArray
    st: FloatArray
    st_conf: FloatArray
    s2: FloatArray
    s2_conf: FloatArray
    s1_emulator_sd: FloatArray
    st_emulator_sd: FloatArray

    def ranking(self) -> FloatArray:
        """Importance of each input (d,): its greatest total effect over the outputs, normalised to sum 1."""
        greatest = np.maximum(self.st, 0.0).max(0)
        return greatest / greatest.sum()


def saltelli_sample(lower: FloatArray, upper: FloatArray, n: int, seed: int) -> FloatArray:
    """Points (2 d + 2, n, d): A; A with column j of B (d blocks); B with column j of A (d blocks); B.

    A, B: the two halves of a scrambled Sobol' sequence of n (a power of two) points in 2 d dimensions.
    """
    d = len(lower)
    base = qmc.Sobol(2 * d, scramble=True, rng=np.random.default_rng(seed)).random(n)
    base = np.tile(lower, 2) + base * np.tile(upper - lower, 2)
    a, b = base[:, :d], base[:, d:]
    blocks = np.empty((2 * d + 2, n, d))
    blocks[: d + 1] = a
    blocks[d + 1 :] = b
    for j in range(d):
        blocks[1 + j, :, j] = b[:, j]
        blocks[1 + d + j, :, j] = a[:, j]
    return blocks


def sobol_indices(y: FloatArray, resamples: int = 100, seed: int = 1) -> Sobol:
    """Indices from a function's values y (2 d + 2, n, p) at ``saltelli_sample``'s points."""
    blocks, n, p = y.shape
    d = (blocks - 2) // 2
    y = y - y.mean((0, 1))
    y /= np.maximum(y.std((0, 1)), np.finfo(float).tiny)
    a, ab, ba, b = y[0], y[1 : 1 + d], y[1 + d : 1 + 2 * d], y[-1]
    upper = np.triu_indices(d, 1)
    # one column for each mean an estimator needs: (n, terms, p)
    terms = np.concatenate(
        [
            b * (ab - a),
            0.5 * (a - ab) ** 2,
            ba[upper[0]] * ab[upper[1]] - a * b,
            np.stack([a, b, a**2, b**2]),
        ]
    ).transpose(1, 0, 2)
    columns = terms.reshape(n, -1)
    s1, st, s2 = _estimates(columns.mean(0).reshape(1, -1, p), d)
    picks = np.random.default_rng(seed).integers(n, size=(n, resamples))
    counts = np.zeros((resamples, n))
    np.add.at(counts, (np.broadcast_to(np.arange(resamples), picks.shape), picks), 1.0)
    r1, rt, r2 = _estimates((counts @ columns / n).reshape(resamples, -1, p), d)
    z = norm.ppf(0.975)
    full, full_conf = np.full((2, p, d, d), np.nan)
    full[:, upper[0], upper[1]] = s2[0].T
    full_conf[:, upper[0], upper[1]] = z * r2.std(0, ddof=1).T
    zero = np.zeros((p, d))
    return Sobol(s1[0].T, z * r1.std(0, ddof=1).T, st[0].T, z * rt.std(0, ddof=1).T, full, full_conf, zero, zero)


def _estimates(means: FloatArray, d: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """First-order (r, d, p), total (r, d, p) and second-order (r, d (d - 1) / 2, p) indices from means (r, terms, p)."""
    ma, mb, maa, mbb = (means[:, i - 4] for i in range(4))
    variance = 0.5 * (maa + mbb) - (0.5 * (ma + mb)) ** 2
    variance = np.where(variance > np.finfo(float).eps, variance, np.inf)[:, None]
    s1, st = means[:, :d] / variance, means[:, d : 2 * d] / variance
    j, k = np.triu_indices(d, 1)
    return s1, st, means[:, 2 * d : -4] / variance - s1[:, j] - s1[:, k]


@single_threaded
def function_indices(
    function: Function, lower: FloatArray, upper: FloatArray, n: int = 1024, resamples: int = 100, seed: int = 1
) -> Sobol:
    """Indices of a function (m, d) -> (m, p) over the box [lower, upper] with inputs uniform and independent."""
    points = saltelli_sample(lower, upper, n, seed)
    blocks, _, d = points.shape
    return sobol_indices(function(points.reshape(-1, d)).reshape(blocks, n, -1), resamples, seed)


@single_threaded
def emulator_indices(
    emulators: AnyEmulators,
    lower: FloatArray,
    upper: FloatArray,
    n: int = 1024,
    resamples: int = 100,
    draws: int = 32,
    draw_n: int = 128,
    seed: int = 1,
    tick: Callable[[], None] | None = None,
) -> Sobol:
    """Indices of the emulators' means, and the spread that the emulators' own uncertainty gives them.

    ``draws`` functions are drawn from each emulator and analysed on ``draw_n`` base points; 0 draws leaves it out.
    tick is called after each output.
    """
    result = function_indices(emulators.predict_mean, lower, upper, n, resamples, seed)
    if draws == 0:
        return result
    points = saltelli_sample(lower, upper, draw_n, seed + 1)
    blocks, _, d = points.shape
    x = points.reshape(-1, d)
    z = norm.ppf(0.975)
    # the mean, and the functions, on the same points: what sampling does to both cancels
    here = sobol_indices(emulators.predict_mean(x).reshape(blocks, draw_n, -1), 2, seed)
    s1_sd, st_sd = np.empty_like(result.s1), np.empty_like(result.st)
    s2_sd = np.full_like(result.s2, np.nan)
    for i in range(len(emulators.outputs)):
        y = emulators.draw(i, x, draws, seed + 2 + i).reshape(blocks, draw_n, draws)
        drawn = sobol_indices(y, 2, seed)
        # about the mean function's index, not the draws' own mean: a mean is smoother than any function it is the mean of,
        # which makes the indices of inputs that act little too small
        s1_sd[i], st_sd[i], s2_sd[i] = (
            np.sqrt(((there - at[i]) ** 2).mean(0))
            for there, at in ((drawn.s1, here.s1), (drawn.st, here.st), (drawn.s2, here.s2))
        )
        if tick is not None:
            tick()
    return Sobol(
        result.s1, np.hypot(result.s1_conf, z * s1_sd), result.st, np.hypot(result.st_conf, z * st_sd), result.s2,
        np.hypot(result.s2_conf, z * s2_sd), s1_sd, st_sd,
    )  # fmt: skip
