"""Scales on which an emulator works: inputs linear or logarithmic, the output linear or a shifted logarithm.

An output with a long tail to one side is modelled as T(y) = log(sign y + offset). Which scale serves best is a matter of
restricted likelihood: of the raw output, the transformation's Jacobian included (warped Gaussian process, Snelson,
Rasmussen and Ghahramani 2004), so that scales compare on equal terms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray
from lacli.inference.emulation import gp

# an input that spans a ratio this large may act on a logarithmic scale (stiffness, exponents, springs)
_LOG_RATIO = 3.0
# room between the outermost run and the logarithm's singularity, in ranges of the runs: nearer, the likelihood of a
# shifted logarithm has no maximum (Cheng and Amin 1983), and a target just beyond the runs could not be reached
_ROOM = (0.1, 0.3, 1.0)
# a shift is one more parameter: it has to earn this much log likelihood
_WORTH = 2.0
# of a logarithm's moments: what is larger overflows where it is squared
LARGEST_EXPONENT = 170.0


@dataclass(frozen=True)
class OutputScale:
    """T(y) = y, or log(sign y + offset) where ``log``."""

    log: bool = False
    offset: float = 0.0
    sign: float = 1.0

    def forward(self, y: FloatArray) -> FloatArray:
        """T(y)."""
        return np.log(self.sign * y + self.offset) if self.log else y

    def backward(self, z: FloatArray) -> FloatArray:
        """y of T(y) = z."""
        return self.sign * (np.exp(z) - self.offset) if self.log else z

    def log_slope(self, y: FloatArray) -> FloatArray:
        """log |dT/dy|."""
        return -np.log(self.sign * y + self.offset) if self.log else np.zeros_like(y)

    def moments(self, mean: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of y where T(y) is normal with these (of a shifted log-normal where ``log``)."""
        if not self.log:
            return mean, variance
        # far from all runs either is beyond all numbers: as large as can still be worked with says so as well
        size = np.exp(np.minimum(mean + 0.5 * variance, LARGEST_EXPONENT))
        return self.sign * (size - self.offset), np.expm1(np.minimum(variance, LARGEST_EXPONENT)) * size**2


def coordinates(x: FloatArray, log_inputs: BoolArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Inputs (m, d) -> 2 (t(x) - low) / (high - low) - 1 with t = log where ``log_inputs`` (d,)."""
    t = np.array(x, float)
    t[:, log_inputs] = np.log(t[:, log_inputs])
    return 2.0 * (t - low) / (high - low) - 1.0


@dataclass(frozen=True)
class Scaled:
    """Training data on one choice of scales, ready for the process: u (n, d), y (n,), noise variance (n,)."""

    u: FloatArray
    y: FloatArray
    noise: FloatArray
    low: FloatArray
    high: FloatArray
    shift: float
    scale: float
    log_inputs: BoolArray
    output: OutputScale
    log_jacobian: float


def scale(x: FloatArray, y: FloatArray, error_sd: FloatArray, log_inputs: BoolArray, output: OutputScale) -> Scaled:
    """Put runs x (n, d), y (n,), with known errors (n,), on the scales."""
    t = x.copy()
    t[:, log_inputs] = np.log(t[:, log_inputs])
    low, high = t.min(0), t.max(0)
    high = np.where(high > low, high, low + 1.0)  # a subset of the runs may hold an input still
    value, log_slope = output.forward(y), output.log_slope(y)
    shift, spread = float(value.mean()), float(value.std()) or 1.0
    return Scaled(
        u=2.0 * (t - low) / (high - low) - 1.0, y=(value - shift) / spread, noise=(error_sd * np.exp(log_slope) / spread) ** 2,
        low=low, high=high, shift=shift, scale=spread, log_inputs=log_inputs, output=output,
        log_jacobian=float(log_slope.sum() - len(y) * np.log(spread)),
    )  # fmt: skip


def _evidence(data: Scaled, objective: float) -> float:
    """Log restricted likelihood of the raw output, comparable between input scales (Harville's basis correction)."""
    h = gp.basis(data.u)
    return -objective + 0.5 * float(np.linalg.slogdet(h.T @ h)[1]) + data.log_jacobian


@dataclass(frozen=True)
class _Choice:
    """A choice of scales with the theta (d + 2,) found for it."""

    data: Scaled
    theta: FloatArray
    evidence: float


def may_be_logarithmic(x: FloatArray) -> BoolArray:
    """Whether each input may act on a logarithmic scale (d,): positive, and over a wide ratio, in x (n, d): all points where
    the emulator will be asked, or their extremes."""
    low = x.min(0)
    return np.asarray((low > 0) & (x.max(0) > _LOG_RATIO * np.maximum(low, 1e-300)), bool)


def choose_scales(x: FloatArray, y: FloatArray, error_sd: FloatArray, start: FloatArray, may_log: BoolArray) -> _Choice:
    """The scales of greatest restricted likelihood for runs x (n, d), y (n,), climbing from theta ``start`` (d + 2,).

    may_log (d,): inputs that may be logarithmic. Linear and logarithmic inputs all together, then one by one; the output
    linear, logarithmic (where positive) or as a shifted logarithm to either side.
    """

    def fitted(log_inputs: BoolArray, output: OutputScale, theta: FloatArray, iterations: int) -> _Choice:
        data = scale(x, y, error_sd, log_inputs, output)
        found, value = gp.maximise(data.u, data.y, data.noise, [theta], max_iterations=iterations)
        return _Choice(data, found, _evidence(data, value))

    eligible = may_log & (x.min(0) > 0)
    input_scales = [np.zeros(x.shape[1], bool), eligible] if eligible.any() else [np.zeros(x.shape[1], bool)]
    output_scales = [OutputScale(), OutputScale(True)] if y.min() > 0 else [OutputScale()]
    best = max((fitted(i, o, start, 200) for o in output_scales for i in input_scales), key=lambda choice: choice.evidence)
    for j in np.flatnonzero(eligible):  # one pass: would this input do better on the other scale?
        flipped = best.data.log_inputs.copy()
        flipped[j] = not flipped[j]
        best = max(best, fitted(flipped, best.data.output, best.theta, 8), key=lambda choice: choice.evidence)
    shifted = _shifted(x, y, error_sd, best)
    if shifted is not None:
        other = fitted(best.data.log_inputs, shifted, best.theta, 25)
        if other.evidence > best.evidence + _WORTH:
            best = other
    return best


def _shifted(x: FloatArray, y: FloatArray, error_sd: FloatArray, best: _Choice) -> OutputScale | None:
    """The shifted logarithm that promises most, judged at the theta of the best scale so far, which is not yet its own: None
    where it loses more there (a tenth of a unit a run) than a theta of its own could win back."""
    room = np.ptp(y)
    candidates = [OutputScale(True, float(r * room - (s * y).min()), s) for s in (1.0, -1.0) for r in _ROOM]
    scores = []
    for output in candidates:
        data = scale(x, y, error_sd, best.data.log_inputs, output)
        value, _ = gp.negative_log_likelihood(best.theta, data.u, data.y, data.noise)
        scores.append(_evidence(data, value))
    top = int(np.argmax(scores))
    return candidates[top] if scores[top] > best.evidence - 0.1 * len(y) else None
