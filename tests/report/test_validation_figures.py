"""Figures of motion, validation and calibration: what is drawn is the data, in its units and the regions' colours."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from lacli.contracts.labels import BODY_REGIONS, REGION_COLOURS
from lacli.motion.check.validation import Validation
from lacli.report import calibration_figures, motion_figures, segmentation_figures, validation_figures

TIMES = np.array([0.0, 0.2, 0.4, 0.7])


def test_tracked_points_and_simulated_lines_are_the_data(tmp_path: Path, drawn: list[Figure]) -> None:
    keys = ("volume_ml", *(f"d_{region}_mm" for region in BODY_REGIONS))
    tracked = np.outer(np.sin(np.pi * TIMES), 1.0 + np.arange(len(keys)))
    used = np.zeros(tracked.shape, bool)
    used[2] = True
    found = Validation(
        keys=keys, times=TIMES, simulated=tracked + 0.5, tracked=tracked, sd=np.full(tracked.shape, 0.25), used=used, left_out=0
    )
    validation_figures.transients(found, tmp_path / "v.png")
    axes = drawn[0].axes
    assert [a.get_ylabel() for a in axes[:2]] == ["volume, change (mL)", "|u| (mm)"]
    assert "RR interval" in axes[-1].get_xlabel()
    lines = [line for line in axes[1].lines if len(line.get_xdata()) == len(TIMES) and line.get_linestyle() == "-"]
    for j, region in enumerate(BODY_REGIONS):
        line = next(x for x in lines if to_hex(x.get_color()).upper() == REGION_COLOURS[region].upper())
        assert np.asarray(line.get_ydata()) == pytest.approx(tracked[:, 1 + j] + 0.5)
    bars = [patch.get_height() for patch in axes[-1].patches]
    assert bars == pytest.approx([2.0] * len(TIMES))  # .5 / .25 at every frame


def test_a_motion_s_transients_are_by_time_with_units(tmp_path: Path, drawn: list[Figure]) -> None:
    frame = pd.DataFrame({"time": TIMES, "volume_ml": 80 + 20 * np.sin(np.pi * TIMES)})
    for region in BODY_REGIONS:
        for what in "dnab":
            frame[f"{what}_{region}_mm"] = np.sin(np.pi * TIMES)
    frame.to_csv(tmp_path / "transients.csv", index=False)
    sd = {name: 0.1 for name in frame.columns if name != "time"}
    phases = {"es": 0.4, "conduit_end": 0.6, "booster_start": 0.8}
    (tmp_path / "tracking.json").write_text(json.dumps({"phases": phases, "sd": sd, "times": TIMES.tolist()}))
    try:
        motion_figures.transients(tmp_path, tmp_path / "t.png")
    except KeyError as error:
        pytest.fail(f"tracking.json lacks {error}")
    labels = [axis.get_ylabel() for axis in drawn[0].axes]
    assert any("mL" in label for label in labels) and any("mm" in label for label in labels)


def test_names_and_colours_of_figures_stand_once() -> None:
    assert len(set(calibration_figures.FIGURES)) == len(calibration_figures.FIGURES)
    assert calibration_figures.RECOVERY not in calibration_figures.FIGURES
    colours = list(segmentation_figures.COLOURS.values())
    assert len(set(colours)) == len(colours) == 5 and all(len(c) == 7 and c.startswith("#") for c in colours)
