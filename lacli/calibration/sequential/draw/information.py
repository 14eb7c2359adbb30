"""What targets can teach of the inputs: by derivatives of runs, before a calibration; by groups of targets, after it.

With J the derivatives of the features by the inputs at a run, C the targets' covariance and V the priors' variances, the
linearised posterior has the precision J' C^-1 J + V^-1; its gain over the prior is 1/2 log det(I + V J' C^-1 J) nats.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.evidence import factor, gather
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.priors import prior_sd
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import RunLog

# of a target's name, its group
_KINDS = {"d": "magnitudes", "n": "normal components", "a": "tangential components", "b": "tangential components"}


@dataclass(frozen=True)
class Forecast:
    """Of each input (d,): prior_sd; expected_sd, the median over ``runs`` points of the box, and the least and the largest of
    them; in the inputs' units; targets: how many teach it."""

    inputs: tuple[str, ...]
    prior_sd: FloatArray
    expected_sd: FloatArray
    least: FloatArray
    most: FloatArray
    runs: int
    targets: int

    def rows(self) -> list[dict[str, float | str]]:
        """By input: what is expected, and the share by which the sd falls."""
        return [
            {
                "input": name, "prior_sd": float(before), "expected_sd": float(after), "least_sd": float(low),
                "most_sd": float(high), "contraction": 1.0 - float(after / before),
            }
            for name, before, after, low, high in zip(
                self.inputs, self.prior_sd, self.expected_sd, self.least, self.most, strict=True
            )
        ]  # fmt: skip


def forecast(log: RunLog, x: FloatArray, targets: Targets, scale: Scale) -> Forecast:
    """From the runs at x (m, d) that tell derivatives."""
    box = scale.box
    before = prior_sd(targets.priors, box.names, box.lower, box.upper)
    evidence = gather(log, x, targets, scale)
    evidence = evidence.take(evidence.told)
    found = []
    for point, jacobian in zip(evidence.x, evidence.jacobian[:, : evidence.targets], strict=True):
        by_x = jacobian / scale.slope(point[None])
        found.append(np.sqrt(np.diag(np.linalg.inv(by_x.T @ by_x + np.diag(before**-2)))))
    sds = np.array(found)
    return Forecast(box.names, before, np.median(sds, axis=0), sds.min(0), sds.max(0), len(sds), len(targets.names))


def group_of(name: str) -> str:
    """Of a target by its name: volume, magnitudes, components or strains, at end-systole or in frames."""
    key, at, _ = name.partition("@")
    kind = "volumes" if key.endswith("_ml") else "strains" if "strain" in key else _KINDS.get(key.partition("_")[0], "others")
    return f"{kind} in frames" if at else kind


def by_group(targets: Targets, slopes: FloatArray, box: Box) -> list[dict[str, float | str]]:
    """By the derivatives (p, d) of the targets' features by the inputs: by group of targets, how many, the nats that they tell
    alone, and those lost without them."""
    before = prior_sd(targets.priors, box.names, box.lower, box.upper)
    groups: dict[str, list[str]] = {}
    for name in targets.names:
        groups.setdefault(group_of(name), []).append(name)
    of = dict(zip(targets.names, slopes, strict=True))

    def gain(names: list[str]) -> float:
        if not names:
            return 0.0
        by_x = solve_triangular(factor(targets.select(names)), np.array([of[name] for name in names]), lower=True) * before
        return float(0.5 * np.linalg.slogdet(np.eye(len(before)) + by_x.T @ by_x)[1])

    whole = gain(list(targets.names))
    return [
        {
            "group": group, "targets": len(names), "alone_nats": gain(names),
            "lost_without_nats": whole - gain([name for name in targets.names if name not in names]),
        }
        for group, names in groups.items()
    ]  # fmt: skip
