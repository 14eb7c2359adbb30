"""Emulators learnt from runs' values and gradients: many outputs through a few Gaussian processes.

Outputs, whitened, are combinations of processes: each output one of its own where they are few, else principal components
(Higdon et al. 2008) of values and gradients together, what is cut off added to the variance. Inputs are on the scale,
linear or logarithmic, on which the gradients vary less; derivatives go with them by the chain rule. A process takes the
derivatives along the inputs that bend it most, as many as its size allows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.base.errors import UsageError
from lacli.base.threads import single_threaded
from lacli.contracts.identity import array_digest
from lacli.contracts.tables.table import RunTable
from lacli.inference.emulation import gradient_process as process
from lacli.inference.emulation.function_draws import draw_process
from lacli.inference.emulation.gradient_kernel import KINDS, Kind
from lacli.inference.emulation.gradient_process import Data, GradientGP
from lacli.inference.emulation.run_errors import RunErrors, told_errors
from lacli.inference.emulation.scales import coordinates, may_be_logarithmic

# up to so many outputs have a process each; of more, components that leave no output more than this share of its variance
_MOST_OWN, _CUT = 16, 1e-4
# rows of a process when it is fitted (its time grows as their cube), and when it predicts
_FIT_ROWS, _MOST_ROWS = 450, 1500
# an input whose derivatives are a smaller share of all squared ones than this does nothing
_NIL = 1e-8
_TARGET_COVERAGE, _INFLATION_BOUNDS = 0.955, (0.25, 16.0)


@dataclass(frozen=True)
class GradientEmulators:
    """Emulators (p) of one simulator with d inputs, as ``EmulatorSet``: with the gradient of the mean besides.

    log_inputs, low, high (d,): u = 2 (t(x) - low) / (high - low) - 1 with t = log where ``log_inputs``. Output j =
    shift + scale (weights[j] . processes), weights (p, q); residual (p,): variance of what the components cut off, over
    scale squared; inflation (p,): of the variance, by leaving runs out; held_out_r2 (p,) likewise; told_error (n, p):
    variance of each run's own error, in the outputs' units squared.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    log_inputs: BoolArray
    low: FloatArray
    high: FloatArray
    shift: FloatArray
    scale: FloatArray
    weights: FloatArray
    residual: FloatArray
    inflation: FloatArray
    held_out_r2: FloatArray
    told_error: FloatArray
    processes: tuple[GradientGP, ...]

    def __post_init__(self) -> None:
        scales = (self.processes[0].data.u, self.log_inputs, self.low, self.high)
        object.__setattr__(self, "_errors", tuple(told_errors(told, *scales) for told in self.told_error.T))

    @property
    def runs(self) -> int:
        """Number of training runs."""
        return len(self.processes[0].data.u)

    @property
    def log_share(self) -> FloatArray:
        """Share of the emulators that take each input's logarithm (d,)."""
        return self.log_inputs.astype(float)

    def draw(self, j: int, x: FloatArray, draws: int, seed: int) -> FloatArray:
        """Values (m, draws) at x (m, d) of functions drawn from output j's distribution (without nugget, the hyperparameters as
        they are), in the output's units."""
        u, rng = coordinates(x, self.log_inputs, self.low, self.high), np.random.default_rng(seed)
        values = np.zeros((len(x), draws))
        for c in np.flatnonzero(self.weights[j]):
            values += self.weights[j, c] * draw_process(self.processes[c], u, draws, float(self.inflation[j]), rng)
        return self.shift[j] + self.scale[j] * values

    def range(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest training inputs (d,), in their units."""
        ends = [np.where(self.log_inputs, np.exp(np.where(self.log_inputs, v, 0.0)), v) for v in (self.low, self.high)]
        return ends[0], ends[1]

    def training_inputs(self) -> FloatArray:
        """Inputs (n, d) of the training runs, in their units."""
        t = self.low + 0.5 * (self.processes[0].data.u + 1.0) * (self.high - self.low)
        t[:, self.log_inputs] = np.exp(t[:, self.log_inputs])
        return t

    def content_digest(self) -> str:
        """Digest of all that makes the emulators what they are: of what is stored."""
        from lacli.inference.emulation.gradient_file import arrays

        kept = arrays(self)
        return array_digest(*(array for name in sorted(kept) for array in (np.array(name), kept[name])))

    def select(self, outputs: Sequence[str]) -> GradientEmulators:
        """The emulators of the named outputs, in that order, with the processes they need."""
        j = [self.outputs.index(name) for name in outputs]
        weights = self.weights[j]
        used = np.flatnonzero(weights.any(0))
        return GradientEmulators(
            self.inputs, tuple(outputs), self.log_inputs, self.low, self.high, self.shift[j], self.scale[j], weights[:, used],
            self.residual[j], self.inflation[j], self.held_out_r2[j], self.told_error[:, j],
            tuple(self.processes[c] for c in used),
        )  # fmt: skip

    def predict(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m, p) and variance (m, p) of the outputs at x (m, d), in the outputs' units and their squares."""
        return self._predict(np.arange(len(self.outputs)), x)

    def error_variance(self, j: int, x: FloatArray) -> FloatArray:
        """Variance (m,) of the own error of runs at x (m, d) in output number j: 0 where the training runs tell none."""
        errors: RunErrors | None = self._errors[j]  # type: ignore[attr-defined]
        return np.zeros(len(x)) if errors is None else errors(x)

    def predict_truth(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m, p) and variance (m, p) of what the runs at x (m, d) stand for, their own error counted: what a measurement
        is held against."""
        mean, variance = self.predict(x)
        for j in np.flatnonzero(self.told_error.any(0)).tolist():
            variance[:, j] += self.error_variance(j, x)
        return mean, variance

    def predict_mean(self, x: FloatArray) -> FloatArray:
        """Mean (m, p) alone, at a fraction of the cost."""
        u = coordinates(x, self.log_inputs, self.low, self.high)
        means = np.stack([g.predict_mean(u) for g in self.processes], axis=1)
        return self.shift + self.scale * (means @ self.weights.T)

    def predict_one(self, j: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (m,) and variance (m,) of output number j at x (m, d)."""
        mean, variance = self._predict(np.array([j]), x)
        return mean[:, 0], variance[:, 0]

    def screen(self, j: int, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Bounds of output j at x (m, d): mean from, to; variance from, to; (m,) each: here the prediction itself."""
        mean, variance = self.predict_one(j, x)
        return mean, mean, variance, variance

    def predict_gradient(self, x: FloatArray) -> FloatArray:
        """The mean's gradient (m, d, p) at x (m, d), in the outputs' units over the inputs'."""
        u = coordinates(x, self.log_inputs, self.low, self.high)
        slopes = np.stack([g.predict_gradient(u) for g in self.processes], axis=2)
        per_x = 2.0 / (self.high - self.low) / np.where(self.log_inputs, x, 1.0)
        return per_x[:, :, None] * (slopes @ self.weights.T) * self.scale

    def _predict(self, which: IntArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        u = coordinates(x, self.log_inputs, self.low, self.high)
        weights = self.weights[which]
        used = np.flatnonzero(weights.any(0))
        found = [self.processes[c].predict(u) for c in used]
        mean, variance = (np.stack([f[k] for f in found], axis=1) for k in (0, 1))
        weights = weights[:, used]
        spread = (variance @ (weights**2).T + self.residual[which]) * (self.inflation[which] * self.scale[which] ** 2)
        return self.shift[which] + self.scale[which] * (mean @ weights.T), spread


@dataclass(frozen=True)
class _Whitened:
    """Runs as the processes see them: u (n, d); values (n, p) whitened; slopes (n, d, p) by u, NaN where
    unknown; noise (n, p)."""

    u: FloatArray
    values: FloatArray
    slopes: FloatArray
    noise: FloatArray
    log_inputs: BoolArray
    low: FloatArray
    high: FloatArray
    shift: FloatArray
    scale: FloatArray


@single_threaded
def fit_gradient_emulators(
    table: RunTable,
    *,
    seed: int = 0,
    tick: Callable[[], None] | None = None,
    may_log: BoolArray | None = None,
    kind: Kind | None = None,
    most_own: int = _MOST_OWN,
) -> GradientEmulators:
    """Emulators of all outputs of a table with gradients, in its order; ``tick`` is called after each process.

    may_log (d,): inputs that may be taken on a logarithmic scale, by the runs where None; kind: the kernel, the likelier one of
    the first process where None; most_own: up to so many outputs have a process each. seed: for the interface alone, nothing
    is drawn. Raises UsageError for a table without gradients.
    """
    if table.gradients is None:
        raise UsageError("the table has no derivatives (columns d<output>/d<input>); these emulators learn from them.")
    white = _whiten(table, may_be_logarithmic(table.x) if may_log is None else may_log)
    weights, residual = _components(white, most_own)
    processes = []
    for c in range(weights.shape[1]):
        data = _data(white, weights[:, c])
        fitted = _fit(data, kind)
        kind = fitted.kind
        processes.append(fitted)
        if tick is not None:
            tick()
    inflation, r2 = _left_out(white, weights, residual, processes)
    return GradientEmulators(
        table.inputs, table.outputs, white.log_inputs, white.low, white.high, white.shift, white.scale, weights, residual,
        inflation, r2, table.error_sd**2, tuple(processes),
    )  # fmt: skip


def _whiten(table: RunTable, may_log: BoolArray) -> _Whitened:
    """Inputs on the scale on which the gradients vary less over the runs, outputs with unit standard deviation."""
    assert table.gradients is not None
    shift, spread = table.y.mean(0), table.y.std(0)
    spread = np.where(spread > 0, spread, 1.0)
    linear, logarithmic = np.zeros(len(table.inputs), bool), may_log & (table.x.min(0) > 0)
    found = {}
    for name, logged in (("linear", linear), ("log", logarithmic)):
        slopes = _slopes(table, logged) / spread
        found[name] = np.nansum(np.nanvar(_known(slopes), axis=0), axis=1)
    chosen = logarithmic & (found["log"] < found["linear"])
    low, high = _ends(table.x, chosen)
    return _Whitened(
        coordinates(table.x, chosen, low, high), (table.y - shift) / spread, _slopes(table, chosen) / spread,
        (table.error_sd / spread) ** 2, chosen, low, high, shift, spread,
    )  # fmt: skip


def _known(slopes: FloatArray) -> FloatArray:
    """Slopes (n, d, p), 0 in columns that no run tells: they have no variance, and nanvar nothing to warn of."""
    return np.where(np.isfinite(slopes).any(0), slopes, 0.0)


def _ends(x: FloatArray, logged: BoolArray) -> tuple[FloatArray, FloatArray]:
    t = np.where(logged, np.log(np.where(logged, x, 1.0)), x)
    low, high = t.min(0), t.max(0)
    return low, np.where(high > low, high, low + 1.0)


def _slopes(table: RunTable, logged: BoolArray) -> FloatArray:
    """The gradients (n, d, p) by u: dx / du = half the range, times x on a logarithmic scale."""
    assert table.gradients is not None
    low, high = _ends(table.x, logged)
    per_u = 0.5 * (high - low) * np.where(logged, table.x, 1.0)
    return table.gradients * per_u[:, :, None]


def _components(white: _Whitened, most_own: int) -> tuple[FloatArray, FloatArray]:
    """Weights (p, q) of the processes in the outputs, orthonormal columns, and the variance they leave (p,)."""
    p = white.values.shape[1]
    if p <= most_own:
        return np.eye(p), np.zeros(p)
    rows = np.vstack([white.values, np.nan_to_num(white.slopes).reshape(-1, p)])
    _, _, vt = np.linalg.svd(rows, full_matrices=False)
    for q in range(1, len(vt) + 1):
        weights = vt[:q].T
        residual = np.mean((white.values - white.values @ weights @ weights.T) ** 2, axis=0)
        if residual.max() <= _CUT:
            break
    return weights, residual


def _data(white: _Whitened, weight: FloatArray) -> Data:
    """What one process sees: the combination ``weight`` (p,) of values and slopes, derivatives along the inputs that bend it."""
    used = weight != 0
    values = white.values @ weight
    slopes = white.slopes[:, :, used] @ weight[used]  # NaN where one of them is unknown
    known = np.isfinite(slopes)
    counted = np.maximum(known.sum(0), 1)
    filled = np.where(known, slopes, 0.0)
    mean = filled.sum(0) / counted
    bend = (np.where(known, slopes - mean, 0.0) ** 2).sum(0) / counted
    acts = (filled**2).sum(0) > _NIL * (filled**2).sum()
    order = np.argsort(-np.where(known.any(0) & acts, bend, -1.0), kind="stable")
    room = max(1, _MOST_ROWS // len(values) - 1)
    active = np.sort(order[: min(room, int((known.any(0) & acts).sum()))])
    rows = np.vstack([np.ones((1, len(values)), bool), known[:, active].T])
    observed = np.vstack([values[None], filled[:, active].T])
    # a derivative that is the same everywhere has a noise too: of rounding, against the largest there is
    floor = 1e-8 * max(float((filled**2).mean(0).max()), 1e-12)
    return Data(white.u, active, rows, observed, white.noise @ weight**2, np.maximum(bend[active], floor))


def _fit(data: Data, kind: Kind | None) -> GradientGP:
    every = np.arange(0, len(data.u), max(1, -(-data.rows.size // _FIT_ROWS)))
    part = data.part(every)
    found = []
    for candidate in KINDS if kind is None else (kind,):
        theta, value = process.maximise(candidate, part, process.start(part))
        found.append((value, candidate, theta))
    value, chosen, theta = min(found, key=lambda f: f[0])
    return process.condition(chosen, theta, data, value)


def _left_out(
    white: _Whitened, weights: FloatArray, residual: FloatArray, processes: Sequence[GradientGP]
) -> tuple[FloatArray, FloatArray]:
    """The factor of each output's variance (p,) with which the stated share of the runs, each left out with its gradient, lies
    within two standard deviations; R2 (p,)."""
    left = [g.leave_one_run_out() for g in processes]
    errors, variances = (np.stack([e[k] for e in left], axis=1) for k in (0, 1))
    cut = white.values - white.values @ weights @ weights.T
    error = errors @ weights.T + cut
    variance = variances @ (weights**2).T + residual
    n = len(error)
    level = min(1.0, _TARGET_COVERAGE * (n + 1) / n)
    inflation = np.clip(np.quantile(np.abs(error) / (2.0 * np.sqrt(variance)), level, axis=0) ** 2, *_INFLATION_BOUNDS)
    return inflation, 1.0 - (error**2).sum(0) / np.maximum((white.values**2).sum(0), 1e-300)
