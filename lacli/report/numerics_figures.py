"""Speed against the answer: what a choice of numerics costs, and by how much it moves the stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lacli.calibration.numerics import Effect, worst_shift
from lacli.report.inference_figures import save
from lacli.report.style import paper

_LEAST = 1e-3  # standard deviations: the reference's own shift, 0, stands there


def frontier_figure(found: Sequence[Effect], inputs: Sequence[str], tolerance_sd: float, picture: Path) -> Path:
    """CPU seconds a run against the largest shift of an alpha; the line is what is acceptable. Choices that failed are absent."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(3.5, 2.8))
        for effect in found:
            if effect.trouble:
                continue
            y = max(_LEAST, worst_shift(effect, inputs))
            reference = effect is found[-1]
            good = y <= tolerance_sd
            axis.plot(effect.cpu_s, y, "D" if reference else "o", color="#009E73" if good else "#D55E00", markersize=5)
            axis.annotate(
                effect.name + (": reference, 0" if reference else ""),
                (effect.cpu_s, y),
                (4, 4),
                textcoords="offset points",
                fontsize=7,
            )
        axis.axhline(tolerance_sd, color="#666666", linewidth=0.8, linestyle="--")
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.margins(0.3, 0.15)
        axis.set_xlabel("CPU time of a run (s)")
        axis.set_ylabel("largest shift of an alpha (sd)")
        return save(figure, picture)
