"""All outputs' emulators at once: batched mean and variance, stored in one file without pickle."""

from __future__ import annotations

import itertools
import zipfile
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrmm

from lacli.errors import InputError
from lacli.inference import gp
from lacli.inference.emulator import Emulator
from lacli.inference.scales import OutputScale
from lacli.inference.threads import one_thread
from lacli.store import replacing

FloatArray = NDArray[np.float64]

FORMAT = 2
# rows of a block: the block of kernel values of one output stays in the second-level cache
_BLOCK = 512
# runs whose correlations bound the variance from above in a first look
_HEAD = 64
# up to this many points one batched product over all outputs beats a loop over them
_BATCH = 160


@dataclass(frozen=True)
class _Stack:
    """Arrays for prediction. Features phi (m, 1 + f) = (1, t), t = inputs on the linear scale and those in ``logged`` on
    the logarithmic one too, in [-1, 1].

    phi @ exponent (p, 1 + f, n) + t^2 @ square (f, p) = log of the kernel's correlation with each run, for all outputs in
    one product as all_exponents (1 + f, p n); linear (p, 1 + f, 1 + q): the mean's and its uncertainty's part linear in
    phi, as all_linear (1 + f, p (1 + q)); weights (p, n, 1 + q): their part linear in the correlations; roots (p, n, n):
    transposed inverse Cholesky factors times s2, their first rows and columns alone (heads), and vertical strips of them
    cut off below the diagonal: (last row, (p, rows, columns)); prior (p,): s2 + nugget; nugget (p,); moments (p,) for the
    output, ``logs``: numbers of the outputs modelled as logarithms.
    """

    logged: NDArray[np.int64]
    low: FloatArray
    high: FloatArray
    exponent: FloatArray
    square: FloatArray
    all_exponents: FloatArray
    linear: FloatArray
    all_linear: FloatArray
    weights: FloatArray
    roots: FloatArray
    heads: FloatArray
    strips: tuple[tuple[int, FloatArray], ...]
    prior: FloatArray
    nugget: FloatArray
    shift: FloatArray
    scale: FloatArray
    inflation: FloatArray
    offset: FloatArray
    sign: FloatArray
    logs: NDArray[np.int64]


@dataclass(frozen=True)
class EmulatorSet:
    """Emulators (p) of the outputs of one simulator with d inputs."""

    inputs: tuple[str, ...]
    emulators: tuple[Emulator, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "_stack", _stack(self.emulators))

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(e.output for e in self.emulators)

    @property
    def runs(self) -> int:
        """Number of training runs."""
        return len(self.emulators[0].process.y)

    @property
    def error_sd(self) -> FloatArray:
        """The runs' own errors (p,), one standard deviation in the outputs' units: 0 where none is known."""
        return np.array([e.error_sd for e in self.emulators])

    def range(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest training inputs (d,), in their units."""
        e = self.emulators[0]
        lift = [np.where(e.log_inputs, np.exp(np.where(e.log_inputs, v, 0.0)), v) for v in (e.low, e.high)]
        return lift[0], lift[1]

    def training_inputs(self) -> FloatArray:
        """Inputs (n, d) of the training runs, in their units (in the order in which they tell most)."""
        e = self.emulators[0]
        t = e.low + 0.5 * (e.process.u + 1.0) * (e.high - e.low)
        t[:, e.log_inputs] = np.exp(t[:, e.log_inputs])
        return t

    def select(self, outputs: Sequence[str]) -> EmulatorSet:
        """The emulators of the named outputs, in that order."""
        return EmulatorSet(self.inputs, tuple(self.emulators[self.outputs.index(name)] for name in outputs))

    def predict(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m, p) and variance (m, p) of the outputs at x (m, d), in the outputs' units and their squares."""
        return self._evaluate(x, True)

    def predict_mean(self, x: FloatArray) -> FloatArray:
        """Mean (m, p) alone, at a fraction of the cost; of a logarithmic output, the median (no variance is computed)."""
        return self._evaluate(x, False)[0]

    def predict_one(self, j: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m,) and variance (m,) of output number j at x (m, d)."""
        s: _Stack = self._stack  # type: ignore[attr-defined]
        mean, variance = np.empty((1, len(x))), np.empty((1, len(x)))
        _blocks(s, [j], *_features(s, x), mean, variance)
        _to_outputs(s, [j], mean, variance)
        return mean[0], variance[0]

    def screen(self, j: int, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Bounds of output j at x (m, d) for a third of a prediction's cost: mean from, to; variance from, to; (m,) each.

        The variance given only the first runs (in the order in which they tell most) is above the variance given all; the
        nugget is below it.
        """
        s: _Stack = self._stack  # type: ignore[attr-defined]
        phi, squared = _features(s, x)
        n = s.exponent.shape[2]
        head = s.heads.shape[1]
        buffer = np.empty((_BLOCK, n))
        mean, variance = np.empty((2, len(x))), np.empty((2, len(x)))
        for begin in range(0, len(x), _BLOCK):
            f = phi[begin : begin + _BLOCK]
            rows = slice(begin, begin + len(f))
            k = buffer[: len(f)]
            np.dot(f, s.exponent[j], out=k)
            k += squared[rows, j, None]
            np.exp(k, out=k)
            t = k @ s.weights[j]
            t += f @ s.linear[j]
            w = t[:, 1:]
            v = k[:, :head] @ s.heads[j]
            mean[:, rows] = t[:, 0]
            variance[0, rows] = s.nugget[j] + np.einsum("ij,ij->i", w, w)
            spread = (s.prior[j] - s.nugget[j]) - np.einsum("ij,ij->i", v, v)
            variance[1, rows] = variance[0, rows] + np.maximum(spread, 0.0)
        _to_outputs(s, [j, j], mean, variance)  # rows: at the least and at the greatest variance
        if s.sign[j] < 0:  # the mean falls with the variance
            mean = mean[::-1]
        return mean[0], mean[1], variance[0], variance[1]

    def _evaluate(self, x: FloatArray, with_variance: bool) -> tuple[FloatArray, FloatArray]:
        s: _Stack = self._stack  # type: ignore[attr-defined]
        x = np.asarray(x, float)
        m, p = len(x), len(self.emulators)
        phi, squared = _features(s, x)
        if m > _BATCH:
            mean, variance = np.empty((p, m)), np.zeros((p, m))
            _blocks(s, list(range(p)), phi, squared, mean, variance if with_variance else None)
        else:
            k = (phi @ s.all_exponents).reshape(m, p, -1)
            k += squared[:, :, None]
            np.exp(k, out=k)
            k = k.transpose(1, 0, 2)
            linear = (phi @ s.all_linear).reshape(m, p, -1).transpose(1, 0, 2)
            if with_variance:
                t = np.matmul(k, s.weights)
                t += linear
                mean = t[:, :, 0].copy()
                w = t[:, :, 1:]
                variance = np.einsum("pmq,pmq->pm", w, w)
                variance += s.prior[:, None]
                for end, strip in s.strips:
                    v = np.matmul(k[:, :, :end], strip)
                    variance -= np.einsum("pmn,pmn->pm", v, v)
            else:
                mean = np.matmul(k, s.weights[:, :, :1])[:, :, 0] + linear[:, :, 0]
                variance = np.zeros((p, m))
        _to_outputs(s, slice(None), mean, variance)
        return mean.T, variance.T


def _features(s: _Stack, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Features phi (m, 1 + f) of x (m, d), and the part (m, p) of the log correlations that is the same for all runs."""
    d = x.shape[1]
    phi = np.empty((len(x), 1 + len(s.low)))
    phi[:, 0] = 1.0
    t = phi[:, 1:]
    t[:, :d] = x
    if len(s.logged):
        np.log(x[:, s.logged], out=t[:, d:])
    t -= s.low
    t *= 2.0 / (s.high - s.low)
    t -= 1.0
    return phi, (t * t) @ s.square


def _blocks(
    s: _Stack, which: list[int], phi: FloatArray, squared: FloatArray, mean: FloatArray, variance: FloatArray | None
) -> None:
    """Fill mean and variance (len(which), m) output by output, in blocks of points that fit in cache."""
    n = s.exponent.shape[2]
    buffer = np.empty((_BLOCK, n))
    for begin in range(0, len(phi), _BLOCK):
        f = phi[begin : begin + _BLOCK]
        k = buffer[: len(f)]
        rows = slice(begin, begin + len(f))
        for i, j in enumerate(which):
            np.dot(f, s.exponent[j], out=k)
            k += squared[rows, j, None]
            np.exp(k, out=k)
            if variance is None:
                mean[i, rows] = k @ s.weights[j, :, 0] + f @ s.linear[j, :, 0]
                continue
            t = k @ s.weights[j]
            t += f @ s.linear[j]
            mean[i, rows] = t[:, 0]
            w = t[:, 1:]
            # k' in Fortran order shares k's memory: the triangular product happens in place, half a full one's cost
            dtrmm(1.0, s.roots[j].T, k.T, lower=1, overwrite_b=1)
            variance[i, rows] = s.prior[j] - np.einsum("ij,ij->i", k, k) + np.einsum("ij,ij->i", w, w)


def _to_outputs(s: _Stack, which: list[int] | slice, mean: FloatArray, variance: FloatArray) -> None:
    """The processes' moments (len(which), m) -> the outputs', in place."""
    # rounding may leave a variance a hair under the nugget's; it cannot be less than a part of the prior's
    np.maximum(variance, 1e-12 * s.prior[which, None], out=variance)
    mean *= s.scale[which, None]
    mean += s.shift[which, None]
    variance *= (s.inflation * s.scale**2)[which, None]
    if isinstance(which, slice):
        rows, logs = s.logs, s.logs
    else:
        rows = np.flatnonzero(np.isin(which, s.logs))
        logs = np.array(which, np.int64)[rows]
    if len(rows):
        v = variance[rows]
        e = np.exp(mean[rows] + 0.5 * v)
        mean[rows] = s.sign[logs, None] * (e - s.offset[logs, None])
        variance[rows] = np.expm1(v) * e**2


def _stack(emulators: Sequence[Emulator]) -> _Stack:
    first = emulators[0]
    d, n = len(first.low), len(first.process.y)
    logged = np.flatnonzero(np.any([e.log_inputs for e in emulators], axis=0))
    place = np.zeros(d, np.int64)  # of a logged input among the features
    place[logged] = d + np.arange(len(logged))
    # the reference scale: a range that every emulator shares in value, on the linear and (if used) logarithmic scale
    x_low = np.where(first.log_inputs, np.exp(np.where(first.log_inputs, first.low, 0.0)), first.low)
    x_high = np.where(first.log_inputs, np.exp(np.where(first.log_inputs, first.high, 0.0)), first.high)
    low = np.r_[x_low, np.log(x_low[logged])]
    high = np.r_[x_high, np.log(x_high[logged])]
    f = len(low)
    exponent, square, linear, weights, roots = [], [], [], [], []
    for e in emulators:
        g = e.process
        column = np.where(e.log_inputs, place, np.arange(d))  # the feature that carries input j
        # u = a t + b, with t the reference coordinate
        a = (high - low)[column] / (e.high - e.low)
        b = 2.0 * (low[column] - e.low) / (e.high - e.low) + a - 1.0
        inverse = 1.0 / g.lengths**2
        shifted = g.u - b
        w, of_square = np.zeros((1 + f, n)), np.zeros(f)
        w[0] = -0.5 * (shifted**2 * inverse).sum(1)
        w[1 + column] = (shifted * (a * inverse)).T
        of_square[column] = -0.5 * a**2 * inverse
        to_h = np.zeros((1 + f, 1 + d))
        to_h[0, 0] = 1.0
        to_h[0, 1:] = b
        to_h[1 + column, 1 + np.arange(d)] = a
        exponent.append(w)
        square.append(of_square)
        linear.append(np.hstack([(to_h @ g.beta)[:, None], to_h @ g.c.T]))
        weights.append(g.s2 * np.hstack([g.alpha[:, None], -(g.c @ g.g).T]))
        roots.append(np.ascontiguousarray(g.s2 * g.inverse_factor.T))
    n_strips = max(1, min(4, n // 32))
    ends = np.linspace(0, n, n_strips + 1).astype(int)
    stacked = np.array(roots)
    strips = tuple((int(b), np.ascontiguousarray(stacked[:, :b, a:b])) for a, b in itertools.pairwise(ends))
    return _Stack(
        logged=logged, low=low, high=high, exponent=np.array(exponent), square=np.array(square).T.copy(),
        all_exponents=np.hstack(exponent), linear=np.array(linear), all_linear=np.hstack(linear), weights=np.array(weights),
        roots=stacked, heads=stacked[:, :_HEAD, :_HEAD].copy(), strips=strips,
        nugget=np.array([e.process.nugget for e in emulators]),
        prior=np.array([e.process.s2 + e.process.nugget for e in emulators]),
        shift=np.array([e.shift for e in emulators]), scale=np.array([e.scale for e in emulators]),
        inflation=np.array([e.inflation for e in emulators]), offset=np.array([e.output_scale.offset for e in emulators]),
        sign=np.array([e.output_scale.sign for e in emulators]), logs=np.flatnonzero([e.output_scale.log for e in emulators]),
    )  # fmt: skip


def save_emulators(path: Path, emulators: EmulatorSet) -> None:
    """Write the emulators to an .npz file (numbers and names only); the file appears whole or not at all."""
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT), "inputs": np.array(emulators.inputs), "outputs": np.array(emulators.outputs),
    }  # fmt: skip
    for i, e in enumerate(emulators.emulators):
        arrays |= {
            f"{i}_log_inputs": e.log_inputs, f"{i}_low": e.low, f"{i}_high": e.high,
            f"{i}_scales": np.array([*astuple(e.output_scale), e.shift, e.scale], float),
            f"{i}_quality": np.array([e.inflation, e.held_out_r2, e.error_sd, e.process.objective], float),
            f"{i}_theta": e.process.theta, f"{i}_u": e.process.u, f"{i}_y": e.process.y, f"{i}_noise": e.process.noise,
        }  # fmt: skip
    with replacing(Path(path)) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def load_emulators(path: Path) -> EmulatorSet:
    """Read what ``save_emulators`` wrote. Raises InputError if the file is missing, damaged or of another kind."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such emulator file. Make it with `lacli emulate`.")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as a, one_thread():
            if int(a["format"]) != FORMAT:
                raise InputError(
                    f"{path}: written in format {int(a['format'])}, this program reads {FORMAT}. Run `lacli emulate` again."
                )
            emulators = []
            for i, output in enumerate(a["outputs"]):
                log, offset, sign, shift, scale = (float(v) for v in a[f"{i}_scales"])
                inflation, r2, error_sd, objective = (float(v) for v in a[f"{i}_quality"])
                process = gp.condition(a[f"{i}_theta"], a[f"{i}_u"], a[f"{i}_y"], a[f"{i}_noise"], objective)
                emulators.append(
                    Emulator(
                        str(output), a[f"{i}_log_inputs"], a[f"{i}_low"], a[f"{i}_high"],
                        OutputScale(bool(log), offset, sign), shift, scale, inflation, r2, error_sd, process,
                    )
                )  # fmt: skip
            return EmulatorSet(tuple(str(name) for name in a["inputs"]), tuple(emulators))
    except (KeyError, ValueError, OSError, zipfile.BadZipFile, np.linalg.LinAlgError) as error:
        raise InputError(f"{path}: not an emulator file, or a damaged one ({error}). Run `lacli emulate` again.") from error
