"""The picture of numerics against the posterior: a mark for each choice where it belongs, and never half a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from lacli.base.errors import StorageError
from lacli.calibration.numerics import Effect
from lacli.report.numerics_figures import frontier_figure

INPUTS = ("alpha_roof", "alpha_septum", "edp_mmhg")


def effect(name: str, cpu_s: float, shift: tuple[float, float, float], trouble: str = "") -> Effect:
    ones = np.ones(3)
    return Effect(name, 3, cpu_s, ones, np.array(shift), ones, np.array(shift) / 2, ones, 0.5, trouble)


def test_a_mark_is_at_the_cost_and_the_largest_shift_of_an_alpha(tmp_path: Path, drawn: list[Figure]) -> None:
    # the third input is no alpha: its shift of 3 sd does not count
    found = [
        effect("linear", 2.0, (0.1, -0.8, 3.0)), effect("broken", 9.0, (0.0, 0.0, 0.0), "no state"),
        effect("quadratic", 8.0, (0.2, 0.1, 3.0)), effect("reference", 60.0, (0.0, 0.0, 0.0)),
    ]  # fmt: skip
    assert frontier_figure(found, INPUTS, 0.25, tmp_path / "f.png") == tmp_path / "f.png"
    assert [path.name for path in tmp_path.iterdir()] == ["f.png"], "no temporary file is left"
    axis = drawn[0].axes[0]
    marks = {line.get_xdata()[0]: (line.get_ydata()[0], line.get_color()) for line in axis.lines if line.get_marker() in "oD"}
    assert {x: y for x, (y, _) in marks.items()} == pytest.approx({2.0: 0.8, 8.0: 0.2, 60.0: 1e-3})
    assert marks[2.0][1] != marks[8.0][1] == marks[60.0][1], "beyond what is acceptable is another colour"
    assert [text.get_text() for text in axis.texts] == ["linear", "quadratic", "reference: reference, 0"]


def test_a_figure_that_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = tmp_path / "f.png"
    picture.write_bytes(b"old")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full)
    with pytest.raises(StorageError, match="the disk is full"):
        frontier_figure([effect("reference", 60.0, (0.0, 0.0, 0.0))], INPUTS, 0.25, picture)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]
