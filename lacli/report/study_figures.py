"""Figures of the studies: displacement of shells against their thickness, stress of a run against the law of Laplace."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from lacli.contracts.labels import REGION_COLOURS
from lacli.report.cohort_figures import save_all
from lacli.report.style import paper

_OTHER = "#555555"
_FAR = 2.0  # of the largest stress compared: a region that is not compared and beyond it would press the others together


def thickness_figure(shells: Sequence[Mapping[str, Any]], files: Sequence[Path]) -> None:
    """Displacement of the patch's place against its thickness there, both logarithmic: a line for pressure alone and one on
    springs, uniform shells filled, thin patches open."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(3.5, 2.9))
        for number, springs in enumerate(sorted({s["springs_kpa_per_mm"] for s in shells})):
            colour = ("#0072B2", "#D55E00")[number % 2]
            name = f"on springs, {springs:g} kPa/mm" if springs else "pressure alone"
            for patch in (False, True):
                mine = sorted(
                    (s["patch_mm"], s["patch_displacement_mm"])
                    for s in shells
                    if s["springs_kpa_per_mm"] == springs and (s["patch_mm"] < s["thickness_mm"]) == patch
                )
                face, line = ("white", "--") if patch else (colour, "-")
                label = f"{name}, {'thin patch' if patch else 'uniform'}"
                axis.plot(
                    *zip(*mine, strict=True), line, marker="o", color=colour, markerfacecolor=face, markersize=4, label=label
                )
        axis.set(xscale="log", yscale="log", xlabel="thickness around the apex (mm)", ylabel="displacement around the apex (mm)")
        for one in (axis.xaxis, axis.yaxis):
            one.set_major_formatter("{x:g}")
            one.set_minor_formatter("")
        axis.set_xticks(sorted({s["patch_mm"] for s in shells}))
        axis.set_yticks([v for v in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20) if axis.get_ylim()[0] <= v <= axis.get_ylim()[1]])
        axis.legend(fontsize=7)
        save_all(figure, files)


def laplace_figure(
    stresses: Mapping[str, tuple[float, float]], slope: float, files: Sequence[Path], left_out: Collection[str] = ()
) -> None:
    """The run's stress against the law's, kPa, a marker a region, with the line of identity and the slope through nought (NaN:
    none). left_out: regions that the slope is not of: hollow, or, where the law is far beyond the others, named alone."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(3.5, 3.0))
        kept = [value for region, pair in stresses.items() if region not in left_out for value in pair]
        far = _FAR * max(map(abs, kept or [run for _, run in stresses.values()]))
        shown = {region: pair for region, pair in stresses.items() if region not in left_out or max(map(abs, pair)) <= far}
        values = [0.0, *(value for pair in shown.values() for value in pair)]
        margin = 0.1 * (max(values) - min(values)) or 1.0
        low, most = min(values) - margin * (min(values) < 0), max(values) + margin
        axis.plot([low, most], [low, most], color="0.6", linewidth=0.8, label="the law")
        if math.isfinite(slope):
            axis.plot([low, most], [slope * low, slope * most], "--", color="0.3", linewidth=0.8, label=f"slope {slope:.2g}")
        for region in stresses:
            colour = REGION_COLOURS.get(region, _OTHER)
            law, run = shown.get(region, (math.nan, math.nan))
            name = region if region not in left_out else f"{region}: flat or concave" + ("" if region in shown else ", not shown")
            face = "white" if region in left_out else colour
            axis.plot(law, run, "o", color=colour, markerfacecolor=face, markersize=5, label=name)
        axis.set(xlabel="law of Laplace (kPa)", ylabel="wall stress along less across (kPa)", xlim=(low, most), ylim=(low, most))
        axis.legend(fontsize=7, ncols=2)
        save_all(figure, files)
