"""Mean and variance of several Gaussian processes at many points, as three sums: compiled, or by numpy without a compiler."""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dtrmm

from lacli.base import resources
from lacli.base.arrays import FloatArray
from lacli.base.processes import native as compiled

_PAD = 8  # runs and parts are padded to a multiple of it
_WORK_ROWS = 48
# rows of a block by numpy: the correlations of one output stay in the second-level cache
_BLOCK = 512


@dataclass(frozen=True)
class Processes:
    """Arrays of p processes of n runs, for features phi (f): padded with zeros as ``moments.cpp`` wants them.

    k = exp(phi . exponent + shift): correlations with the runs; exponent (p, f, n). (phi, k) . weights (p, f + n, q): the
    mean, then parts whose squares add up to the variance of the mean's linear part. k . roots (p, n, n), upper
    triangles: parts whose squares add up to what the runs explain of the variance.
    """

    exponent: FloatArray
    weights: FloatArray
    roots: FloatArray

    def __reduce__(self) -> tuple[type[Processes], tuple[FloatArray, ...]]:
        # a copy, or what another process gets, stands on arrays of its own: no address goes with them
        return Processes, (self.exponent, self.weights, self.roots)

    @property
    def runs(self) -> int:
        """n, padded."""
        return self.exponent.shape[2]

    @functools.cached_property
    def addresses(self) -> tuple[int, int, int]:
        """Of the three arrays' numbers: numpy takes its time to tell them."""
        return self.exponent.ctypes.data, self.weights.ctypes.data, self.roots.ctypes.data


@dataclass(frozen=True)
class Sums:
    """Of the asked processes (c, m): mean; variance = prior + linear - explained."""

    mean: FloatArray
    linear: FloatArray
    explained: FloatArray


def processes(exponent: FloatArray, linear: FloatArray, weights: FloatArray, roots: FloatArray) -> Processes:
    """From exponent (p, f, n), linear (p, f, q), weights (p, n, q), roots (p, n, n)."""
    p, f, n = exponent.shape
    q = weights.shape[2]
    runs, parts = (-(-v // _PAD) * _PAD for v in (n, q))
    padded = Processes(np.zeros((p, f, runs)), np.zeros((p, f + runs, parts)), np.zeros((p, runs, runs)))
    padded.exponent[:, :, :n] = exponent
    padded.weights[:, :f, :q] = linear
    padded.weights[:, f : f + n, :q] = weights
    padded.roots[:, :n, :n] = roots
    return padded


def sums(s: Processes, phi: FloatArray, shift: FloatArray, which: list[int], used: int | None = None) -> Sums:
    """At points with features phi (m, f) and shift (m, p), for the processes numbered ``which``.

    used: how many of the first runs explain variance (rounded up to 8; all by default); 0: the mean alone.
    """
    used = s.runs if used is None else min(s.runs, -(-used // _PAD) * _PAD)
    function = _compiled()
    if function is None:
        return _by_numpy(s, phi, shift, which, used)
    m, f = phi.shape
    phi, shift = np.ascontiguousarray(phi), np.ascontiguousarray(shift)
    count = len(which)
    numbers = (ctypes.c_long * count)(*which)
    out = np.empty((3, count, m))
    work = np.empty(_WORK_ROWS * (f + s.runs))
    begin = out.ctypes.data
    size = 8 * count * m
    function(
        m, len(s.exponent), f, s.runs, s.weights.shape[2], count, numbers, used, phi.ctypes.data, shift.ctypes.data,
        *s.addresses, work.ctypes.data, begin, begin + size, begin + 2 * size,
    )  # fmt: skip
    return Sums(out[0], out[1], out[2])


@functools.cache
def _compiled() -> ctypes._NamedFuncPointer | None:
    library = compiled.library(resources.folder("solvers") / "emulator" / "moments.cpp")
    if library is None:
        return None
    function = library.moments
    whole, address = ctypes.c_long, ctypes.c_void_p
    function.argtypes = [*[whole] * 6, address, whole, *[address] * 9]
    function.restype = None
    return function


def _by_numpy(s: Processes, phi: FloatArray, shift: FloatArray, which: list[int], used: int) -> Sums:
    m, f = phi.shape
    result = Sums(*np.zeros((3, len(which), m)))
    for begin in range(0, m, _BLOCK):
        rows = slice(begin, min(begin + _BLOCK, m))
        block = phi[rows]
        for i, j in enumerate(which):
            k = block @ s.exponent[j]
            k += shift[rows, j, None]
            np.exp(k, out=k)
            weights = s.weights[j] if used else s.weights[j, :, :1]
            t = k @ weights[f:]
            t += block @ weights[:f]
            result.mean[i, rows] = t[:, 0]
            result.linear[i, rows] = np.einsum("mq,mq->m", t[:, 1:], t[:, 1:])
            if used == s.runs:
                # k' in Fortran order shares k's memory: the triangular product happens in place, half a full one's cost
                dtrmm(1.0, s.roots[j].T, k.T, lower=1, overwrite_b=1)
            elif used:
                k = k[:, :used] @ s.roots[j, :used, :used]
            if used:
                result.explained[i, rows] = np.einsum("mn,mn->m", k, k)
    return result
