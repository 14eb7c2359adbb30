"""What numerics do to the posterior, on simulators whose posterior is known in closed form."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pytest

from lacli.base.errors import LacliError, UsageError
from lacli.calibration.numerics import Choice, effects, recommend, worst_shift
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import Outcome

BOX = Box(("alpha_roof", "esp_mmhg"), np.array([1.0, 10.0]), np.array([3.0, 30.0]))  # ratios below 20: no logarithms
NAMES = ("d_roof_mm", "esv_ml")
AT = np.array([2.0, 20.0])
TARGETS = Targets(NAMES, np.zeros(2), np.array([0.1, 2.0]))


@dataclass
class Linear:
    """f = A z + b, z the box's unit coordinates; ``bend`` adds bend z1^2 to the first output."""

    a: Any
    b: Any
    cpu_s: float = 1.0
    bend: float = 0.0
    status: str = "done"
    gradients: bool = True

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        z = BOX.to_unit(inputs.to_numpy(float))[0]
        y = self.a @ z + self.b + np.array([self.bend * z[0] ** 2, 0.0])
        slope = (self.a + np.array([[2 * self.bend * z[0], 0.0], [0.0, 0.0]])) / (BOX.upper - BOX.lower)
        gradients = {(n, i): slope[p, d] for p, n in enumerate(NAMES) for d, i in enumerate(BOX.names)} if self.gradients else {}
        yield 0, Outcome(dict(zip(NAMES, y, strict=True)), self.status, "", {}, self.cpu_s, gradients=gradients)

    def determined_by(self, inputs: Sequence[str]) -> Mapping[str, Any]:
        return {}


A = np.array([[4.0, 0.0], [0.0, 100.0]])
REFERENCE = Choice("fine", Linear(A, np.zeros(2), cpu_s=100.0), {})


def test_a_constant_error_shifts_by_what_the_hand_gives() -> None:
    # precision of z1: (4 / .1)^2 + 12 = 1612, sd .02491; an error of .05 mm: J'r = 40 x .5, shift -20 / 1612 = -.01241 = -.498 sd
    cheap = Choice("coarse", Linear(A, np.array([0.05, 0.0])), {})
    found, best = effects([cheap, REFERENCE], TARGETS, BOX, AT)
    assert found.shift == pytest.approx([-20.0 / 1612.0 * np.sqrt(1612.0), 0.0], abs=1e-9)
    assert found.sd_ratio == pytest.approx([1.0, 1.0])
    assert found.x == pytest.approx([2.0 - 2.0 * 20.0 / 1612.0, 20.0])
    assert found.error == pytest.approx(0.5 / np.sqrt(2.0))
    assert found.cpu_s == 1.0 and best.cpu_s == 100.0
    assert best.shift == pytest.approx([0.0, 0.0]) and best.error == 0.0


def test_errors_that_are_stated_widen_and_shift_less() -> None:
    cheap = Choice("coarse", Linear(A, np.array([0.05, 0.0])), {"d_roof_mm": 0.1})
    found, _ = effects([cheap, REFERENCE], TARGETS, BOX, AT)
    # sd of the target .1 sqrt 2: precision 800 + 12, J'r = 40 / sqrt 2 x .5 / sqrt 2 = 10; from the shift already made as well
    precision = 812.0
    assert found.wider_ratio[0] == pytest.approx(np.sqrt(1612.0 / precision))
    assert abs(found.shift_wider[0]) == pytest.approx(10.0 / precision * np.sqrt(precision), rel=1e-6)
    assert abs(found.shift_wider[0]) < abs(found.shift[0])


def test_a_bent_response_takes_more_runs_and_ends_at_its_own_optimum() -> None:
    cheap = Choice("coarse", Linear(A, np.array([0.3, 0.0]), bend=1.0), {})
    found, _ = effects([cheap, REFERENCE], TARGETS, BOX, AT)
    assert 2 <= found.runs <= 5
    z = BOX.to_unit(found.x[None])[0]
    # stationary: J'r + 12 (z - .5) = 0, with f1 = 4 z1 + z1^2 + .3 against 2
    r = (4 * z[0] + z[0] ** 2 + 0.3 - 2.0) / 0.1
    slope = (4 + 2 * z[0]) / 0.1
    assert abs(slope * r + 12.0 * (z[0] - 0.5)) / slope**2 < 1e-3


def test_the_cheapest_within_the_tolerance_is_recommended() -> None:
    good = Choice("good", Linear(A, np.array([0.01, 0.0]), cpu_s=5.0), {})
    better = Choice("better", Linear(A, np.array([0.001, 0.0]), cpu_s=20.0), {})
    bad = Choice("bad", Linear(A, np.array([0.2, 0.0]), cpu_s=1.0), {})
    found = effects([bad, better, good, REFERENCE], TARGETS, BOX, AT)
    chosen = recommend(found[:-1], BOX.names, 0.25)
    assert chosen is not None and chosen.name == "good"
    assert recommend(found[:-1], BOX.names, 0.005) is None
    # a shift of the pressure alone is no shift of an alpha
    pressure = Choice("pressure", Linear(A, np.array([0.0, 9.0])), {})
    assert worst_shift(effects([pressure, REFERENCE], TARGETS, BOX, AT)[0], BOX.names) == pytest.approx(0.0, abs=1e-9)


def test_a_choice_that_fails_is_told_and_a_reference_that_fails_is_refused() -> None:
    failed = Choice("coarse", Linear(A, np.zeros(2), status="failed"), {})
    found, _ = effects([failed, REFERENCE], TARGETS, BOX, AT)
    assert "coarse failed" in found.trouble and np.isnan(found.shift).all()
    with pytest.raises(LacliError, match="coarse failed"):
        effects([REFERENCE, failed], TARGETS, BOX, AT)
    with pytest.raises(LacliError, match="no derivatives"):
        effects([Choice("plain", Linear(A, np.zeros(2), gradients=False), {})], TARGETS, BOX, AT)
    with pytest.raises(UsageError, match=r"outside the box: alpha_roof 9 \(1 to 3\)"):
        effects([REFERENCE], TARGETS, BOX, np.array([9.0, 20.0]))


@dataclass
class Steep(Linear):
    """First output (2 / k) atan(k (z1 - .5 - c)) x 4: Gauss-Newton steps overshoot where k c is beyond 1.39, to and fro."""

    k: float = 20.0
    c: float = 0.0

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        z = BOX.to_unit(inputs.to_numpy(float))[0]
        t = self.k * (z[0] - 0.5 - self.c)
        y = np.array([8.0 / self.k * np.arctan(t), 100.0 * z[1]])
        slope = np.diag([8.0 / (1.0 + t**2), 100.0]) / (BOX.upper - BOX.lower)
        gradients = {(n, i): slope[p, d] for p, n in enumerate(NAMES) for d, i in enumerate(BOX.names)}
        yield 0, Outcome(dict(zip(NAMES, y, strict=True)), gradients=gradients, cpu_s=self.cpu_s)


@pytest.mark.parametrize(("k", "c"), [(20.0, 0.1), (20.0, 0.15), (12.0, 0.1)])
def test_a_search_that_goes_to_and_fro_is_damped_or_told(k: float, c: float) -> None:
    """The optimum of the cheap choice is about c away, in sds of the reference: precision (8 / .1)^2 + 12 = 6412, sd .01249."""
    reference = Choice("fine", Steep(A, np.zeros(2), cpu_s=100.0, k=k), {})
    found, _ = effects([Choice("coarse", Steep(A, np.zeros(2), k=k, c=c), {}), reference], TARGETS, BOX, AT)
    if found.trouble:
        assert "did not come to its most probable point" in found.trouble and np.isnan(found.shift).all()
        assert recommend([found], BOX.names, 1e9) is None
    else:
        assert found.shift[0] == pytest.approx(c * np.sqrt(6412.0), abs=0.1)
