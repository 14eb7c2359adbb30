"""What was found, held against the targets: misfit of each output, inputs at an end of their range, targets out of reach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import qmc

from lacli.base.arrays import FloatArray
from lacli.base.threads import single_threaded
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.emulation.emulator_set import AnyEmulators

_SWEEP = 1 << 13
# an input whose most probable value is within this share of its range of an end sits there, if the draws gather there too:
# this many times as many in the last twentieth as a flat density would have
_AT_END, _GATHER, _NEAR = 0.01, 3.0, 0.05


@dataclass(frozen=True)
class Verdict:
    """The most probable point x (d,) against the targets.

    mean, sd (p,): emulated; implausibility (p,): |mean - target| over the root of their variances together; reachable
    (p,): whether some point of the box brings the output alone below the threshold; at_end: inputs at an end of their
    range, each with "lower" or "upper".
    """

    names: tuple[str, ...]
    targets: Targets
    mean: FloatArray
    sd: FloatArray
    implausibility: FloatArray
    reachable: tuple[bool, ...]
    at_end: dict[str, str]
    threshold: float

    @property
    def plausible(self) -> bool:
        """Whether every output is below the threshold."""
        return bool((self.implausibility < self.threshold).all())

    def warnings(self) -> list[str]:
        """What a user must know, in words; empty where all is well."""
        found = []
        for j in np.flatnonzero(self.implausibility >= self.threshold).tolist():
            what = "the most probable point misses" if self.reachable[j] else "no point of the box reaches"
            found.append(f"{what} {self._miss(j)}.")
        if not self.plausible and all(self.reachable):
            found.append(
                "each target alone is reached in the box, all together are not: they contradict each other or the model."
            )
        if self.at_end:
            ends = ", ".join(f"{name} ({end} end)" for name, end in self.at_end.items())
            found.append(f"at the end of their range: {ends}. The answer may lie outside the box.")
        return found

    def _miss(self, j: int) -> str:
        t = self.targets
        return (
            f"{t.names[j]}: {self.mean[j]:.4g} where the target is {t.mean[j]:.4g} ± {t.sd[j]:.3g}"
            f" (implausibility {self.implausibility[j]:.3g}, threshold {self.threshold:g})"
        )

    def document(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "plausible": self.plausible, "threshold": self.threshold, "warnings": self.warnings(),
            "at_end_of_range": dict(self.at_end),
            "outputs": [
                {
                    "output": name, "target": float(self.targets.mean[j]), "sd": float(self.targets.sd[j]),
                    "emulated": float(self.mean[j]), "emulator_sd": float(self.sd[j]),
                    "implausibility": float(self.implausibility[j]), "reachable": self.reachable[j],
                }
                for j, name in enumerate(self.targets.names)
            ],
        }  # fmt: skip


@single_threaded
def judge(
    emulators: AnyEmulators, targets: Targets, box: Box, x: FloatArray, threshold: float = 3.0, draws: FloatArray | None = None
) -> Verdict:
    """Hold the most probable point x (d,) against the targets, whose outputs are the emulators' in the same order.

    draws (m, d): samples of the posterior; an input is at an end of its range where the point is and draws gather (a flat
    posterior has its maximum anywhere).
    """

    def misfit(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        mean, variance = emulators.predict_truth(points)
        return np.abs(mean - targets.mean) / np.sqrt(variance + targets.sd**2), mean, np.sqrt(variance)

    implausibility, mean, sd = (a[0] for a in misfit(x[None]))
    least = implausibility.copy()
    if (least >= threshold).any():
        points = box.from_unit(qmc.Sobol(box.d, rng=np.random.default_rng(0)).random(_SWEEP))
        points = np.vstack([points[box.contains(points)], draws if draws is not None else x[None]])
        least = np.minimum(least, misfit(points)[0].min(0))
    return Verdict(
        box.names, targets, mean, sd, implausibility, tuple(bool(v) for v in least < threshold), _at_end(box, x, draws), threshold
    )  # fmt: skip


def _at_end(box: Box, x: FloatArray, draws: FloatArray | None) -> dict[str, str]:
    found = {}
    u = box.to_unit(x[None])[0]
    v = box.to_unit(draws) if draws is not None and len(draws) else u[None]
    for name, best, drawn in zip(box.names, u, v.T, strict=True):
        for end, way, ways in (("lower", best, drawn), ("upper", 1.0 - best, 1.0 - drawn)):
            if way < _AT_END and (ways < _NEAR).mean() > _GATHER * _NEAR:
                found[name] = end
    return found
