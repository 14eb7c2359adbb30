"""Figures of the studies, and what their command refuses: data at their places, axes with units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from lacli.base.errors import UsageError
from lacli.cli.study import study
from lacli.contracts.labels import REGION_COLOURS
from lacli.report.study_figures import laplace_figure, thickness_figure


def shell(thickness: float, patch: float, springs: float) -> dict[str, float]:
    """Of displacement 6 / thickness under pressure alone, half of it on springs."""
    moved = (3.0 if springs else 6.0) / patch
    return {"thickness_mm": thickness, "patch_mm": patch, "springs_kpa_per_mm": springs, "patch_displacement_mm": moved}


def test_shells_are_marked_at_their_thickness_uniform_ones_filled(tmp_path: Path, drawn: list[Figure]) -> None:
    pairs = [(1.0, 1.0), (3.0, 3.0), (3.0, 1.5)]
    thickness_figure([shell(t, p, s) for s in (0.0, 1.0) for t, p in pairs], [tmp_path / "t.png", tmp_path / "t.pdf"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["t.pdf", "t.png"]
    axis = drawn[0].axes[0]
    assert (axis.get_xscale(), axis.get_xlabel()) == ("log", "thickness around the apex (mm)")
    lines = {str(line.get_label()): line for line in axis.lines}
    assert np.array(lines["pressure alone, uniform"].get_xydata()) == pytest.approx(np.array([[1.0, 6.0], [3.0, 2.0]]))
    assert np.array(lines["on springs, 1 kPa/mm, thin patch"].get_xydata()) == pytest.approx(np.array([[1.5, 2.0]]))
    assert to_hex(lines["pressure alone, thin patch"].get_markerfacecolor()) == "#ffffff"
    assert to_hex(lines["pressure alone, uniform"].get_markerfacecolor()) != "#ffffff"


def test_each_region_s_stress_is_a_marker_in_its_colour(tmp_path: Path, drawn: list[Figure]) -> None:
    laplace_figure({"roof": (10.0, 8.0), "septum": (6.0, 7.0)}, 0.9, [tmp_path / "l.png"])
    axis = drawn[0].axes[0]
    marks = {str(line.get_label()): line for line in axis.lines if line.get_marker() == "o"}
    assert {name: (line.get_xdata()[0], line.get_ydata()[0]) for name, line in marks.items()} == {
        "roof": (10.0, 8.0), "septum": (6.0, 7.0),
    }  # fmt: skip
    assert to_hex(marks["roof"].get_color()).upper() == REGION_COLOURS["roof"].upper()
    assert axis.get_xlabel().endswith("(kPa)") and axis.get_ylabel().endswith("(kPa)")


def test_the_axes_hold_every_stress_that_is_shown(tmp_path: Path, drawn: list[Figure]) -> None:
    stresses = {"roof": (10.0, -2.0), "septum": (6.0, 7.0), "lateral": (-12.0, 5.0), "anterior": (9e4, 5.0)}
    laplace_figure(stresses, float("nan"), [tmp_path / "l.png"], ("lateral", "anterior"))
    axis = drawn[0].axes[0]
    marks = {str(line.get_label()): line for line in axis.lines if line.get_marker() == "o"}
    assert marks["lateral: flat or concave"].get_xdata()[0] == -12.0
    assert to_hex(marks["lateral: flat or concave"].get_markerfacecolor()) == "#ffffff"
    assert np.isnan(marks["anterior: flat or concave, not shown"].get_xdata()[0])
    low, high = axis.get_xlim()
    assert low < -12.0 and 10.0 < high < 30.0 and axis.get_ylim() == (low, high)
    assert not any("slope" in str(line.get_label()) for line in axis.lines)


@pytest.mark.parametrize(
    ("question", "run", "words"),
    [
        ("weather", None, "weather: no such study"),
        ("laplace", None, "a run goes with `laplace`"),
        ("thickness", "r", "only with it"),
    ],
)
def test_a_question_that_is_none_is_refused_before_anything_is_written(
    question: str, run: str | None, words: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=words):
        study.command(question, Path(run) if run else None, None, tmp_path / "s")
    assert not (tmp_path / "s").exists()
