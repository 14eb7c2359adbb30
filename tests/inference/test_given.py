"""Emulators and boxes of a user's files, against one another."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lacli.base.errors import UsageError
from lacli.inference.given import box_of, box_of_inputs, selected


def emulators(logged: tuple[float, float] = (1.0, 0.0)) -> SimpleNamespace:
    return SimpleNamespace(
        inputs=("stiff", "load"), outputs=("esv_ml", "d_roof_mm"), log_share=np.array(logged),
        range=lambda: (np.array([0.2, -1.0]), np.array([5.0, 2.0])), select=lambda names: ("selected", tuple(names)),
    )  # fmt: skip


def box_file(folder: Path, **ranges: list[float]) -> Path:
    file = folder / "box.toml"
    file.write_text("".join(f"{name} = {value}\n" for name, value in ranges.items()))
    return file


def test_outputs_are_selected_in_the_order_asked_for() -> None:
    assert selected(emulators(), ["d_roof_mm"], Path("e.npz")) == ("selected", ("d_roof_mm",))
    with pytest.raises(UsageError, match=r"e.npz: no emulator of edv_ml; there are esv_ml, d_roof_mm"):
        selected(emulators(), ["esv_ml", "edv_ml"], Path("e.npz"))


def test_a_box_is_put_in_the_emulators_order(tmp_path: Path) -> None:
    box = box_of(emulators(), box_file(tmp_path, load=[-0.5, 1.5], stiff=[0.3, 4.0]))
    assert box.names == ("stiff", "load") and box.lower.tolist() == [0.3, -0.5] and box.upper.tolist() == [4.0, 1.5]
    with pytest.raises(UsageError, match=r"box.toml: must hold exactly the inputs stiff, load"):
        box_of_inputs(["stiff", "load"], box_file(tmp_path, load=[0.0, 1.0], other=[0.0, 1.0]))


def test_without_a_file_the_box_is_the_runs_range() -> None:
    box = box_of(emulators(), None)
    assert box.lower.tolist() == [0.2, -1.0] and box.upper.tolist() == [5.0, 2.0]


def test_a_logarithm_needs_a_positive_range(tmp_path: Path) -> None:
    file = box_file(tmp_path, stiff=[0.0, 4.0], load=[-1.0, 1.0])
    with pytest.raises(UsageError, match=r"stiff starts at 0; an emulator takes its logarithm.*lacli emulate --box"):
        box_of(emulators(), file)
    assert box_of(emulators((0.0, 0.0)), file).lower.tolist() == [0.0, -1.0]
