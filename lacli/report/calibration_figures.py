"""The figures of a calibration, drawn into its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.calibration.calibration import Calibration
from lacli.calibration.synthetic_truth import Recovery
from lacli.inference.box import Box
from lacli.report.inference_figures_matching import outputs_figure, region_figure
from lacli.report.inference_figures_posterior import corner_figure, fit_figure, recovery_figure, trace_figure

FIGURES = ("region.png", "outputs.png", "corner.png", "trace.png", "fit.png")
RECOVERY = "recovery.png"


def draw_calibration(result: Calibration, folder: Path, truth: FloatArray | None = None) -> list[Path]:
    """Region, outputs by wave, corner (with the ``truth`` (d,) where it is known), traces and fit, as files in ``folder``."""
    region, outputs, corner, trace, fit = (folder / name for name in FIGURES)
    waves = [
        (f"wave {r.wave}", w.emulators, s.points)
        for r, w, s in zip(result.waves, result.region.waves, result.samples, strict=True)
    ]
    return [
        region_figure(result.region, region, sample=result.samples[-1].points, share=result.waves[-1].share),
        outputs_figure(waves, result.region.waves[-1].targets, outputs),
        corner_figure(result.chain, result.map_x, result.region.box, corner, truth),
        trace_figure(result.chain, trace),
        fit_figure(result.fit, result.draws, fit),
    ]


def draw_recoveries(recoveries: Sequence[Recovery], box: Box, folder: Path) -> list[Path]:
    """What was recovered at each noise level beside the truth, and each level's own figures in its folder."""
    drawn = [recovery_figure({r.level: r.rows for r in recoveries}, box, folder / RECOVERY)]
    for r in recoveries:
        drawn += draw_calibration(r.calibration, folder / r.level, np.array([row["truth"] for row in r.rows]))
    return drawn
