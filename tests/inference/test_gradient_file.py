"""Emulators with gradients as a file: they come back as they were, and what no fit gives is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.base.errors import InputError
from lacli.contracts.tables.table import combine
from lacli.inference.emulation import gradient_file
from lacli.inference.emulation.emulator_set import load_emulators, save_emulators
from lacli.inference.emulation.gradient_gp import GradientEmulators, fit_gradient_emulators


@pytest.fixture(scope="module")
def emulators() -> GradientEmulators:
    x = np.random.default_rng(2).random((12, 2)) + 0.5
    table = combine(
        pd.DataFrame(x, columns=["a", "b"]),
        pd.DataFrame({
            "y_mm": x[:, 0] ** 2 + x[:, 1], "dy_mm/da": 2 * x[:, 0], "dy_mm/db": np.ones(12),
        }),
    )  # fmt: skip
    assert table.gradients is not None
    return fit_gradient_emulators(table)


def test_what_is_read_predicts_as_what_was_written(emulators: GradientEmulators, tmp_path: Path) -> None:
    save_emulators(tmp_path / "e.npz", emulators)
    again = load_emulators(tmp_path / "e.npz")
    assert isinstance(again, GradientEmulators)
    at = np.random.default_rng(3).random((5, 2)) + 0.5
    for mine, other in zip(again.predict(at), emulators.predict(at), strict=True):
        assert mine == pytest.approx(other, rel=1e-10)
    assert again.predict_mean(at)[:, 0] == pytest.approx(at[:, 0] ** 2 + at[:, 1], abs=0.02)
    assert set(gradient_file.arrays(again)) == set(gradient_file.arrays(emulators))


def test_an_edited_file_is_refused(emulators: GradientEmulators, tmp_path: Path) -> None:
    save_emulators(tmp_path / "e.npz", emulators)
    arrays = dict(np.load(tmp_path / "e.npz"))
    arrays["low"] = arrays["high"].copy()
    np.savez(tmp_path / "e.npz", **arrays)
    with pytest.raises(InputError, match=r"e\.npz"):
        load_emulators(tmp_path / "e.npz")
