"""A simulator of seconds' thousandths with exact derivatives: saturating responses of three inputs, in a dozen outputs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from lacli.inference.box import Box, make_box
from lacli.inference.runs import Outcome

INPUTS = ("alpha_roof", "alpha_septum", "edp_mmhg")
OUTPUTS = tuple(f"f{j}" for j in range(12))


def box() -> Box:
    return make_box(INPUTS, (0.125, 0.125, 1.0), (4.0, 4.0, 12.0))


def respond(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outputs (12,) and derivatives (12, 3) at x (3,): p_j / (1 + alpha-weighted stiffness), sums of two such terms."""
    a, b, p = x
    y, slope = [], []
    for j in range(12):
        w, q = 0.3 + 0.1 * j, 1.5 - 0.08 * j
        load = p + 4.0 + 0.2 * j
        u, v = a**0.7, b**0.6
        stiff = 1.0 + w * u + q * v
        y.append(10.0 * load / stiff / 6.0 + 0.5 * np.sin(0.4 * p + 0.3 * j) * u)
        du, dv = 0.7 * a**-0.3, 0.6 * b**-0.4
        common = -10.0 * load / stiff**2 / 6.0
        slope.append(
            [
                common * w * du + 0.5 * np.sin(0.4 * p + 0.3 * j) * du,
                common * q * dv,
                10.0 / stiff / 6.0 + 0.2 * np.cos(0.4 * p + 0.3 * j) * u,
            ]
        )
    return np.array(y), np.array(slope)


class Membranes:
    """The simulator; counts its calls. ``fail``: says of a point whether it fails there; ``told``: whether derivatives are."""

    def __init__(self, fail: Any = None, told: bool = True) -> None:
        self.calls, self.fail, self.told = 0, fail, told

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        for index, row in enumerate(inputs[list(INPUTS)].to_numpy(float)):
            self.calls += 1
            if self.fail is not None and self.fail(row):
                yield index, Outcome({}, "failed", "diverged")
                continue
            y, slope = respond(row)
            gradients = {(o, i): float(slope[j, k]) for j, o in enumerate(OUTPUTS) for k, i in enumerate(INPUTS)}
            yield index, Outcome(dict(zip(OUTPUTS, y.tolist(), strict=True)), gradients=gradients if self.told else {}, cpu_s=1.0)

    def determined_by(self, inputs: Sequence[str]) -> Mapping[str, Any]:
        return {"model": "membranes"}
