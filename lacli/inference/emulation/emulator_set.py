"""All outputs' emulators at once: batched mean and variance, stored in one file without pickle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError
from lacli.base.schema import Array, array_file, unfit, write_arrays
from lacli.base.threads import one_thread
from lacli.contracts.identity import Identity, array_digest, identify
from lacli.contracts.tables.table import RunTable
from lacli.inference.emulation import gp, gradient_file, moments
from lacli.inference.emulation.emulator import Emulator
from lacli.inference.emulation.function_draws import draw_functions
from lacli.inference.emulation.gradient_gp import GradientEmulators
from lacli.inference.emulation.run_errors import RunErrors, run_errors
from lacli.inference.emulation.scales import LARGEST_EXPONENT, OutputScale

FORMAT = 2
_REMEDY = "Run `lacli emulate` again."
_NAMES = {
    "inputs": Array("text", ("d",), distinct=True),
    "outputs": Array("text", ("p",), distinct=True),
}
# of each output; u: the training inputs, in [-1, 1] but for rounding
_EACH = {
    "log_inputs": Array("bool", ("d",)),
    "low": Array(shape=("d",)),
    "high": Array(shape=("d",)),
    "scales": Array(shape=(5,)),
    "quality": Array(shape=(4,)),
    "theta": Array(shape=("theta",)),
    "u": Array(shape=("n", "d"), least=-1.0 - 1e-6, most=1.0 + 1e-6),
    "y": Array(shape=("n",)),
    "noise": Array(shape=("n",), least=0.0),
}
# runs whose correlations bound the variance from above in a first look
_HEAD = 64


@dataclass(frozen=True)
class _Stack:
    """Arrays for prediction. Features phi (m, 1 + f) = (1, t), t = inputs on the linear scale and those in ``logged`` on
    the logarithmic one too, in [-1, 1].

    phi @ exponent + t^2 @ square (f, p) = log of the kernel's correlation with each run (``processes``); prior (p, 1): s2 +
    nugget; nugget and what makes moments the output's (p, 1), gain for the variance; ``logs``: numbers of the outputs
    modelled as logarithms.
    """

    logged: NDArray[np.int64]
    middle: FloatArray
    per_half_width: FloatArray
    processes: moments.Processes
    square: FloatArray
    prior: FloatArray
    nugget: FloatArray
    shift: FloatArray
    scale: FloatArray
    gain: FloatArray
    offset: FloatArray
    sign: FloatArray
    logs: frozenset[int]


@dataclass(frozen=True)
class EmulatorSet:
    """AnyEmulators (p) of the outputs of one simulator with d inputs."""

    inputs: tuple[str, ...]
    emulators: tuple[Emulator, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "_stack", _stack(self.emulators))
        object.__setattr__(self, "_errors", tuple(run_errors(e) for e in self.emulators))

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(e.output for e in self.emulators)

    @property
    def runs(self) -> int:
        """Number of training runs."""
        return len(self.emulators[0].process.y)

    @property
    def held_out_r2(self) -> FloatArray:
        """R2 (p,) of each output at runs that were left out."""
        return np.array([e.held_out_r2 for e in self.emulators])

    def left_out_ise(self) -> FloatArray:
        """Share (p,) of the runs within two standard deviations, each left out, by output."""
        return np.array([e.left_out_ise() for e in self.emulators])

    @property
    def log_share(self) -> FloatArray:
        """The share of the emulators that take each input's logarithm (d,)."""
        return np.mean([e.log_inputs for e in self.emulators], axis=0)

    def draw(self, j: int, x: FloatArray, draws: int, seed: int) -> FloatArray:
        """Values (m, draws) at x (m, d) of functions drawn from output j's emulator, in the output's units."""
        return draw_functions(self.emulators[j], x, draws, seed)

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

    def content_digest(self) -> str:
        """Digest of all that makes the emulators what they are: of what is stored."""
        arrays = _arrays(self)
        return array_digest(*(array for name in sorted(arrays) for array in (np.array(name), arrays[name])))

    def select(self, outputs: Sequence[str]) -> EmulatorSet:
        """The emulators of the named outputs, in that order."""
        return EmulatorSet(self.inputs, tuple(self.emulators[self.outputs.index(name)] for name in outputs))

    def predict(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m, p) and variance (m, p) of the outputs at x (m, d), in the outputs' units and their squares."""
        mean, variance = self._predict(list(range(len(self.emulators))), x)
        return mean.T, variance.T

    def error_variance(self, j: int, x: FloatArray) -> FloatArray:
        """Variance (m,) of the own error of runs at x (m, d) in output number j: 0 where the training runs tell none."""
        errors: RunErrors | None = self._errors[j]  # type: ignore[attr-defined]
        return np.zeros(len(x)) if errors is None else errors(x)

    def predict_truth(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m, p) and variance (m, p) of what the runs at x (m, d) stand for, their own error counted: what a measurement
        is held against."""
        mean, variance = self.predict(x)
        for j in range(len(self.emulators)):
            if self.emulators[j].error_sd > 0:
                variance[:, j] += self.error_variance(j, x)
        return mean, variance

    def predict_mean(self, x: FloatArray) -> FloatArray:
        """Mean (m, p) alone, at a fraction of the cost; of a logarithmic output, the median (no variance is computed)."""
        s: _Stack = self._stack  # type: ignore[attr-defined]
        which = list(range(len(self.emulators)))
        found = moments.sums(s.processes, *_features(s, x), which, used=0)
        _to_outputs(s, which, found.mean, np.zeros_like(found.mean))
        return found.mean.T

    def predict_one(self, j: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m,) and variance (m,) of output number j at x (m, d)."""
        mean, variance = self._predict([j], x)
        return mean[0], variance[0]

    def _predict(self, which: list[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        s: _Stack = self._stack  # type: ignore[attr-defined]
        found = moments.sums(s.processes, *_features(s, x), which)
        variance = found.linear
        variance -= found.explained
        variance += s.prior[which]
        _to_outputs(s, which, found.mean, variance)
        return found.mean, variance

    def screen(self, j: int, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Bounds of output j at x (m, d) for a third of a prediction's cost: mean from, to; variance from, to; (m,) each.

        The variance given only the first runs (in the order in which they tell most) is above the variance given all; the
        nugget is below it.
        """
        s: _Stack = self._stack  # type: ignore[attr-defined]
        found = moments.sums(s.processes, *_features(s, x), [j], used=_HEAD)
        least = s.nugget[j, 0] + found.linear[0]
        mean = np.stack([found.mean[0], found.mean[0]])
        variance = np.stack([least, least + np.maximum(s.prior[j, 0] - s.nugget[j, 0] - found.explained[0], 0.0)])
        _to_outputs(s, [j, j], mean, variance)  # rows: at the least and at the greatest variance
        if s.sign[j, 0] < 0:  # the mean falls with the variance
            mean = mean[::-1]
        return mean[0], mean[1], variance[0], variance[1]


# whatever is learnt from runs, it is asked in the same way
AnyEmulators = EmulatorSet | GradientEmulators


def _features(s: _Stack, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Features phi (m, 1 + f) of x (m, d), and the part (m, p) of the log correlations that is the same for all runs."""
    d = x.shape[1]
    phi = np.empty((len(x), 1 + len(s.middle)))
    phi[:, 0] = 1.0
    t = phi[:, 1:]
    t[:, :d] = x
    if len(s.logged):
        np.log(x if len(s.logged) == d else x[:, s.logged], out=t[:, d:])
    t -= s.middle
    t *= s.per_half_width
    return phi, (t * t) @ s.square


def _to_outputs(s: _Stack, which: list[int], mean: FloatArray, variance: FloatArray) -> None:
    """The processes' moments (len(which), m) -> the outputs', in place."""
    # all outputs, the common case, need no copies of the constants
    mine: Any = slice(None) if which == list(range(len(s.prior))) else which
    # rounding may leave a variance a hair under the nugget's; it cannot be less than a part of the prior's
    np.maximum(variance, 1e-12 * s.prior[mine], out=variance)
    mean *= s.scale[mine]
    mean += s.shift[mine]
    variance *= s.gain[mine]
    rows = [i for i, j in enumerate(which) if j in s.logs]
    if rows:
        logs = [which[i] for i in rows]
        here: Any = slice(None) if len(rows) == len(which) else rows
        v = variance[here]
        e = np.exp(np.minimum(mean[here] + 0.5 * v, LARGEST_EXPONENT))
        mean[here] = s.sign[logs] * (e - s.offset[logs])
        e *= e
        variance[here] = np.expm1(np.minimum(v, LARGEST_EXPONENT)) * e


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
        roots.append(g.s2 * g.inverse_factor.T)

    def tall(values: Sequence[float]) -> FloatArray:
        return np.array(values)[:, None]

    scales = [e.output_scale for e in emulators]
    return _Stack(
        logged=logged, middle=0.5 * (low + high), per_half_width=2.0 / (high - low), square=np.array(square).T.copy(),
        processes=moments.processes(np.array(exponent), np.array(linear), np.array(weights), np.array(roots)),
        nugget=tall([e.process.nugget for e in emulators]), prior=tall([e.process.s2 + e.process.nugget for e in emulators]),
        shift=tall([e.shift for e in emulators]), scale=tall([e.scale for e in emulators]),
        gain=tall([e.inflation * e.scale**2 for e in emulators]),
        offset=tall([o.offset for o in scales]), sign=tall([o.sign for o in scales]),
        logs=frozenset(j for j, o in enumerate(scales) if o.log),
    )  # fmt: skip


def _arrays(emulators: EmulatorSet) -> dict[str, Any]:
    """What is stored of the emulators, and determines them."""
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
    return arrays


def save_emulators(path: Path, emulators: AnyEmulators, identity: Identity | None = None) -> None:
    """Write the emulators to an .npz file (numbers and names only), with what they were made from (else they are used where
    they are named, and nowhere found again); the file appears whole or not at all."""
    arrays = _arrays(emulators) if isinstance(emulators, EmulatorSet) else gradient_file.arrays(emulators)
    if identity is not None:
        arrays["identity"] = np.array(identity.text())
    write_arrays(path, arrays)


def emulators_identity(table: RunTable, **options: Any) -> Identity:
    """What determines emulators: the table's numbers and names, and how they are fitted (options by name)."""
    return identify("emulators", runs={f.name: getattr(table, f.name) for f in fields(table) if f.name != "notes"}, **options)


def load_emulators(path: Path) -> AnyEmulators:
    """Read what ``save_emulators`` wrote. Raises InputError if the file is missing, damaged or of another kind."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such emulator file. Make it with `lacli emulate`.")
    with array_file(path, "an emulator file", _REMEDY, sealed=True) as file, one_thread():
        if gradient_file.MARK in file.names:
            return gradient_file.read(file)
        number = int(file.read({"format": Array("int")})["format"])
        if number != FORMAT:
            raise InputError(f"{path}: written in format {number}, this program reads {FORMAT}. {_REMEDY}")
        head = file.read(_NAMES)
        if not len(head["inputs"]) or not len(head["outputs"]):
            raise unfit("it names no input or no output")
        each = [file.read({f"{i}_{name}": array for name, array in _EACH.items()}) for i in range(len(head["outputs"]))]
        file.check_seal()
        emulators = [
            _emulator(output, {name: a[f"{i}_{name}"] for name in _EACH})
            for i, (output, a) in enumerate(zip(head["outputs"].tolist(), each, strict=True))
        ]
        result = EmulatorSet(tuple(head["inputs"].tolist()), tuple(emulators))
        _check_common_range(result)
    return result


def _emulator(output: str, a: dict[str, Any]) -> Emulator:
    log, offset, sign, shift, scale = (float(v) for v in a["scales"])
    inflation, r2, error_sd, objective = (float(v) for v in a["quality"])
    d, n = len(a["low"]), len(a["y"])
    bounds = np.array([gp.LENGTH_BOUNDS] * d + [gp.S2_BOUNDS, gp.ETA_BOUNDS])
    if len(a["theta"]) != d + 2:
        raise unfit(f"{output}: {len(a['theta'])} hyperparameters for {d} inputs, {d + 2} are expected")
    if n < d + 2:
        raise unfit(f"{output}: {n} runs for {d} inputs")
    if (a["theta"] < np.log(bounds[:, 0]) - 1e-9).any() or (a["theta"] > np.log(bounds[:, 1]) + 1e-9).any():
        raise unfit(f"{output}: a hyperparameter is out of its bounds")
    if (a["low"] >= a["high"]).any():
        raise unfit(f"{output}: an input's range is empty")
    if log not in (0.0, 1.0) or abs(sign) != 1.0 or scale <= 0 or inflation <= 0 or r2 > 1.0 or error_sd < 0:
        raise unfit(f"{output}: a scale or score is none that a fit gives")
    try:
        process = gp.condition(a["theta"], a["u"], a["y"], a["noise"], objective)
    except np.linalg.LinAlgError as error:
        raise unfit(f"{output}: its runs carry no linear mean ({error})") from error
    return Emulator(
        output, a["log_inputs"], a["low"], a["high"], OutputScale(bool(log), offset, sign), shift, scale, inflation, r2,
        error_sd, process,
    )  # fmt: skip


def _check_common_range(emulators: EmulatorSet) -> None:
    """All outputs were learnt from the same runs: their inputs' ranges agree."""

    def ends(e: Emulator) -> FloatArray:
        with np.errstate(over="ignore"):
            return np.array([np.where(e.log_inputs, np.exp(np.where(e.log_inputs, v, 0.0)), v) for v in (e.low, e.high)])

    first = ends(emulators.emulators[0])
    for e in emulators.emulators:
        mine = ends(e)
        if not np.isfinite(mine).all() or (np.abs(mine - first) > 1e-6 * (first[1] - first[0])).any():
            raise unfit(f"{e.output}: its inputs' ranges are not those of {emulators.outputs[0]}")
