"""Figures of transients, emulators, waves, meshes and walls: data at their places."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from lacli.contracts.labels import BODY_REGIONS
from lacli.report import cohort_figures_fits as fits
from lacli.report.inference_figures import label

KEYS = ("volume_ml", *(f"d_{region}_mm" for region in BODY_REGIONS))


def rows(patient: str, size: float) -> list[dict[str, Any]]:
    """Image at 21 times, runs at five of them, end-systole at .4."""
    found = []
    for key in KEYS:
        for time in np.linspace(0.0, 1.0, 21).round(4).tolist():
            value = size * np.sin(np.pi * time)
            run = {"first_low": 0.5 * value, "first_median": value, "first_high": 2.0 * value, "at_map": 0.9 * value}
            here = run if time in (0.0, 0.2, 0.4, 0.6, 0.8) else dict.fromkeys(run, np.nan)
            phase = "reservoir" if time <= 0.4 else "conduit"
            row = {"participant_id": patient, "feature": key, "time": time, "phase": phase, "image": value, "image_sd": 0.1}
            found.append({**row, **here})
    return found


def test_a_patient_s_transients_have_band_line_and_dots(tmp_path: Path, drawn: list[Figure]) -> None:
    fits.transients_figure(pd.DataFrame(rows("a", 4.0)), [tmp_path / "t.png", tmp_path / "t.svg"])
    axis = drawn[0].axes[1]
    assert axis.get_ylabel() == "d anterior (mm)"
    lines = {str(line.get_label()): line for line in axis.lines}
    assert np.array(lines["most probable run"].get_ydata())[2] == pytest.approx(3.6 * np.sin(0.4 * np.pi))
    assert len(lines["image, 2 sd"].get_xdata()) == 21
    first = next(c for c in axis.collections if c.get_label() == "first runs")
    assert first.get_paths()[0].vertices[:, 1].max() == pytest.approx(8.0 * np.sin(0.4 * np.pi))
    dots = [line for line in axis.lines if line.get_markersize() == 5]
    assert [float(np.asarray(line.get_xdata())[0]) for line in dots] == [0.4, 0.4]
    assert [text.get_text() for text in drawn[0].axes[0].texts] == ["reservoir", "conduit"]


def test_the_cohort_s_course_is_the_mean_with_its_sd(tmp_path: Path, drawn: list[Figure]) -> None:
    frame = pd.DataFrame([*rows("a", 3.0), *rows("b", 5.0)])
    fits.cohort_transients_figure(frame, [tmp_path / "c.png"])
    axis = drawn[0].axes[0]
    mean = next(line for line in axis.lines if line.get_label() == "image, mean ± sd")
    at = int(np.argmin(np.abs(np.array(mean.get_xdata()) - 0.4)))
    assert np.array(mean.get_ydata())[at] == pytest.approx(4.0 * np.sin(0.4 * np.pi))
    band = axis.collections[0].get_paths()[0].vertices
    # 3 and 5: mean 4, sd sqrt 2
    assert band[:, 1].max() == pytest.approx(4.0 + 2.0**0.5, rel=1e-6)
    run = fits.over_grid(frame, "volume_ml", "at_map", fits.GRID)
    assert run.shape == (2, 41) and np.isnan(run[:, -1]).all(), "not beyond the run's last time"


def test_the_worst_emulator_is_framed_and_named(tmp_path: Path, drawn: list[Figure]) -> None:
    scores = [("a", "esv_ml", 0.99, 0.95), ("b", "esv_ml", 0.62, 0.97), ("a", "d_roof_mm", 0.98, 0.88), ("b", "d_roof_mm", 1, 1)]
    frame = pd.DataFrame(scores, columns=["participant_id", "output", "r2", "ise"])
    fits.scores_figure(frame, [tmp_path / "s.png"])
    first, second = drawn[0].axes[:2]
    assert first.get_title().endswith("worst: 0.620\nesv_ml of b") and second.get_title().endswith("worst: 0.880\nd_roof_mm of a")
    assert first.patches[0].get_xy() == (0.5, -0.5)
    assert np.asarray(first.images[0].get_array()).tolist() == [[0.99, 0.62], [0.98, 1.0]]
    fits.scores_figure(frame.assign(ise=np.nan), [tmp_path / "s.png"])


def test_shares_by_wave(tmp_path: Path, drawn: list[Figure]) -> None:
    waves = [{"participant_id": p, "wave": w, "nroy_share": s} for p, w, s in (("a", 1, 0.2), ("a", 2, 0.05), ("b", 1, 0.3))]
    fits.shares_figure(pd.DataFrame(waves), [tmp_path / "w.png"])
    (axis,) = drawn[0].axes
    assert axis.get_yscale() == "log" and np.asarray(axis.lines[0].get_ydata()).tolist() == pytest.approx([20.0, 5.0])


def test_cells_and_their_errors(tmp_path: Path, drawn: list[Figure]) -> None:
    table = [(1, 4.0, True, "model", 0.2), (1, 2.0, False, "model", 0.1), (1, 4.0, True, "measured", 0.15),
             (2, 4.0, True, "model", 0.05), (2, 2.0, False, "model", 0.01)]  # fmt: skip
    frame = pd.DataFrame(table, columns=["order", "cell_mm", "own", "source", "error_mm"]).assign(participant_id="a")
    fits.convergence_figure(frame, [tmp_path / "m.png"])
    lines = {str(line.get_label()): np.array(line.get_xydata()) for line in drawn[0].axes[0].lines}
    assert lines["linear cells"] == pytest.approx(np.array([[2.0, 0.1], [4.0, 0.2]]))
    assert lines["linear cells, measured"] == pytest.approx(np.array([[4.0, 0.15]]))
    assert "quadratic cells, measured" not in lines


def test_walls_two_ways_and_fat_by_window(tmp_path: Path, drawn: list[Figure]) -> None:
    wall = [
        {"participant_id": p, "region": r, "one": 2.0 + i, "other": 2.0 + i + off, "fat_a": 1.0 + i, "fat_b": 2.0 + i}
        for p, off in (("a", 0.1), ("b", 0.3))
        for i, r in enumerate(BODY_REGIONS)
    ]
    frame = pd.DataFrame(wall)
    fits.thicknesses_figure(frame, ("one", "other"), [tmp_path / "t.png"])
    fits.fat_figure(frame, {"standard": "fat_a", "wide": "fat_b"}, [tmp_path / "f.png"])
    assert drawn[0].axes[0].get_title() == "median difference 0.20 mm"
    dots = [line for line in drawn[1].axes[0].lines if line.get_label() in ("standard", "wide")]
    assert np.asarray(dots[1].get_ydata()).tolist() == [2.0, 2.0, 3.0, 3.0, 4.0, 4.0, 5.0, 5.0, 6.0, 6.0]


def test_a_feature_s_label_has_its_time() -> None:
    assert label("d_roof_mm@0.25") == "d roof (mm) at 0.25" and label("esv_ml") == "ESV (mL)"
