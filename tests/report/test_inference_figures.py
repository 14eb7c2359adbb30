"""Figures of the inference: what is drawn is the data, labels have units, files are whole."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from chains import chain_of
from matplotlib.figure import Figure

from lacli.contracts.tables.table import combine
from lacli.contracts.targets import Targets
from lacli.inference.box import Box, make_box
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet
from lacli.report import inference_figures, inference_figures_matching, inference_figures_posterior, style

INPUTS = ("alpha_roof", "esp_mmhg")
BOX = make_box(INPUTS, [0.1, 10.0], [4.0, 30.0])


def texts(figure: Figure) -> str:
    return " | ".join(t.get_text() for axis in figure.axes for t in (axis.xaxis.label, axis.yaxis.label, axis.title, *axis.texts))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("esv_ml", "ESV (mL)"),
        ("d_roof_mm", "d roof (mm)"),
        ("alpha_roof", "α roof"),
        ("edp_mmhg", "EDP (mmHg)"),
        ("a$b", r"a\$b"),
    ],
)
def test_a_column_s_name_becomes_a_label_with_its_unit(name: str, words: str) -> None:
    assert inference_figures.label(name) == words


def test_settings_of_print_end_with_the_figure() -> None:
    before = plt.rcParams["font.size"]
    with style.paper():
        assert plt.rcParams["font.size"] == 9.0 and not plt.rcParams["axes.spines.top"]
    assert plt.rcParams["font.size"] == before


def test_traces_show_every_walker_and_the_diagnostics(tmp_path: Path, drawn: list[Figure]) -> None:
    chain = chain_of(INPUTS, steps=40, walkers=6)
    path = inference_figures_posterior.trace_figure(chain, tmp_path / "trace.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    axes = [axis for axis in drawn[0].axes if axis.get_visible()]
    assert len(axes) == 2
    assert sum(line.get_xdata().size >= 20 for line in axes[0].lines) >= 2
    assert "1.001" in texts(drawn[0]) and "900" in texts(drawn[0])


def test_the_fit_is_in_standard_deviations_of_the_targets(tmp_path: Path, drawn: list[Figure]) -> None:
    fit = [{"feature": "d_roof_mm", "target": 5.0, "sd": 0.5, "emulated": 5.5, "emulator_sd": 0.1, "simulated": 4.0},
           {"feature": "esv_ml", "target": 90.0, "sd": 4.0, "emulated": 98.0, "emulator_sd": 1.0, "simulated": 90.0}]  # fmt: skip
    inference_figures_posterior.fit_figure(fit, np.array([[6.0, 86.0], [5.0, 90.0]]), tmp_path / "fit.png")
    found = {round(float(x), 6) for line in drawn[0].axes[0].lines for x in np.atleast_1d(line.get_xdata())}
    # draws (6 - 5) / .5 = 2, (86 - 90) / 4 = -1; emulated 1 and 2; simulated -2 and 0
    assert {2.0, -1.0, 1.0, -2.0, 0.0} <= found
    many = [{**fit[0], "feature": f"d_roof_mm@{k / 50:g}"} for k in range(1, 41)]
    inference_figures_posterior.fit_figure(many, np.empty((0, 40)), tmp_path / "many.png")
    assert [text.get_text() for text in drawn[1].axes[0].get_yticklabels()][24] == "d roof (mm) at 0.5"
    assert drawn[1].get_size_inches()[1] < 8.0


def test_the_corner_holds_the_marginals_on_the_box(tmp_path: Path, drawn: list[Figure]) -> None:
    chain = chain_of(INPUTS)
    box = Box(INPUTS, np.array([-6.0, -5.0]), np.array([5.0, 4.5]))  # the chain's samples are standard normal
    assert pytest.approx((0.118, 0.393, 0.675, 0.865), abs=5e-4) == inference_figures_posterior.LEVELS
    inference_figures_posterior.corner_figure(chain, np.array([1.0, 0.5]), box, tmp_path / "corner.png", np.array([2.0, 1.0]))
    axes = drawn[0].axes
    assert len(axes) == 4
    assert axes[2].get_xlim() == pytest.approx((-6.0, 5.0)) and axes[2].get_ylim() == pytest.approx((-5.0, 4.5))
    assert "ESP (mmHg)" in texts(drawn[0]).replace("\n", " ") and "α roof" in texts(drawn[0])


def test_outputs_by_wave_stand_against_their_targets(tmp_path: Path, drawn: list[Figure]) -> None:
    rng = np.random.default_rng(1)
    x = BOX.from_unit(rng.random((30, 2)))
    outputs = pd.DataFrame({"d_roof_mm": x[:, 0], "esv_ml": 60 + x[:, 1]})
    table = combine(pd.DataFrame(x, columns=list(INPUTS)), outputs)
    emulators = EmulatorSet(table.inputs, tuple(fit_emulators(table)))
    targets = Targets(("d_roof_mm", "esv_ml"), np.array([2.0, 80.0]), np.array([0.2, 4.0]))
    inference_figures_matching.outputs_figure([("wave 1", emulators, x)], targets, tmp_path / "outputs.png")
    assert "d roof (mm)" in texts(drawn[0]) and "ESV (mL)" in texts(drawn[0])
    for axis, (mean, sd) in zip(drawn[0].axes, ((2.0, 0.2), (80.0, 4.0)), strict=False):
        spans = [patch.get_extents().height for patch in axis.patches]
        assert len(spans) >= 2, "one and three standard deviations"
        low, high = axis.get_ylim()
        assert low <= mean - 3 * sd and mean + 3 * sd <= high


def test_a_figure_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    figure = plt.figure()
    with pytest.raises(ValueError, match="not supported"):
        inference_figures.save(figure, tmp_path / "x.nonsense")
    plt.close(figure)
    assert list(tmp_path.iterdir()) == []
