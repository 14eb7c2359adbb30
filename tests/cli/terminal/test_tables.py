"""What the inference commands share: tables of runs, or emulators from a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.base.errors import UsageError
from lacli.cli.terminal import tables
from lacli.inference.emulation.emulator_set import EmulatorSet, save_emulators


@pytest.fixture
def runs(tmp_path: Path) -> tuple[Path, Path]:
    rng = np.random.default_rng(3)
    x = rng.random((30, 2))
    pd.DataFrame(x, columns=["a_mm", "b_mm"]).to_csv(tmp_path / "x.csv", index=False)
    y = pd.DataFrame({"p_ml": 2 * x[:, 0] + x[:, 1] + 1, "q_ml": x[:, 0] * x[:, 1] + 1})
    y.to_csv(tmp_path / "y.csv", index=False)
    return tmp_path / "x.csv", tmp_path / "y.csv"


def test_both_tables_are_needed_and_never_beside_emulators(runs: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--inputs and --outputs"):
        tables.read(runs[0], None, None)
    with pytest.raises(UsageError, match="not both"):
        tables.fitted(runs[0], None, None, tmp_path / "e.npz", 0)


def test_emulators_are_fitted_to_tables_or_read_and_selected(runs: tuple[Path, Path], tmp_path: Path) -> None:
    fitted, table = tables.fitted(*runs, None, None, 0)
    assert table is not None and table.outputs == ("p_ml", "q_ml")
    at = np.array([[0.25, 0.5]])
    assert fitted.predict_mean(at)[0] == pytest.approx([2.0, 1.125], abs=0.02)  # 2 x .25 + .5 + 1; .25 x .5 + 1
    assert isinstance(fitted, EmulatorSet)
    save_emulators(tmp_path / "e.npz", fitted)
    again, none = tables.fitted(None, None, ["q_ml"], tmp_path / "e.npz", 0)
    assert none is None and again.outputs == ("q_ml",)
    assert again.predict_mean(at)[0] == pytest.approx(fitted.predict_mean(at)[0, 1:], rel=1e-12)


def test_one_output_alone_is_read(runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert tables.read(*runs, ["q_ml"]).outputs == ("q_ml",)
    tables.warn("of [box]")
    assert capsys.readouterr().err.endswith("warning: of [box]\n")
