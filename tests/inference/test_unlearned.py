"""Where an emulator knows little of its output, the intervals of its indices are said to be a lower bound."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lacli.api.inference import _unlearned
from lacli.inference.box import make_box
from lacli.inference.design import design
from lacli.inference.emulation.emulator import fit_emulator
from lacli.inference.emulation.emulator_set import EmulatorSet


@pytest.mark.parametrize(("r2", "said"), [((0.99, 0.81), ()), ((0.99, 0.5), ("b",)), ((-0.2, 0.5), ("a", "b"))])
def test_outputs_that_are_not_learnt_are_named(r2: tuple[float, float], said: tuple[str, ...]) -> None:
    words = _unlearned(SimpleNamespace(outputs=("a", "b"), held_out_r2=np.array(r2)))  # type: ignore[arg-type]
    assert all(f"{name} (held-out R2" in words for name in said) and bool(words) == bool(said)


def test_ishigamis_function_is_not_learnt_by_60_runs() -> None:
    box = make_box(["x", "y", "z"], [-np.pi] * 3, [np.pi] * 3)
    x = design(box, 60, "sobol", 2)
    f = np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    assert "lower bound" in _unlearned(EmulatorSet(box.names, (fit_emulator(x, f, "f", starts=1),)))
    assert _unlearned(EmulatorSet(box.names, (fit_emulator(x, x[:, 0] + x[:, 1] ** 2, "g", starts=1),))) == ""
