"""Figures over patients: a quantity by region, one marker a patient; and one quantity against another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.files import replacing
from lacli.contracts.labels import REGION_COLOURS
from lacli.report.style import paper

_OTHER = "#555555"


def regions_figure(values: FloatArray, regions: Sequence[str], name: str, files: Sequence[Path]) -> None:
    """Boxes by region with a marker a patient, joined by patient. values: (patients, regions). One file a format."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(3.5, 2.8))
        places = np.arange(len(regions))
        axis.boxplot(values, positions=places, widths=0.5, showfliers=False, medianprops={"color": "black"})
        for row in values:
            axis.plot(places, row, color="0.8", linewidth=0.6, zorder=1)
        for j, region in enumerate(regions):
            colour = REGION_COLOURS.get(region, _OTHER)
            axis.plot(np.full(len(values), places[j]), values[:, j], "o", color=colour, markersize=4, zorder=3)
        axis.set_xticks(places, regions)
        axis.set_ylabel(name)
        _save(figure, files)


def scatter_figure(
    x: FloatArray, y: FloatArray, regions: Sequence[str], names: tuple[str, str], sd: FloatArray | None, files: Sequence[Path]
) -> None:
    """y against x, (patients, regions), coloured by region; sd: of x, as bars. names: of x and y."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(3.5, 3.0))
        for j, region in enumerate(regions):
            bars = None if sd is None else sd[:, j]
            colour = REGION_COLOURS.get(region, _OTHER)
            axis.errorbar(x[:, j], y[:, j], xerr=bars, fmt="o", color=colour, markersize=4, elinewidth=0.6, label=region)
        axis.set(xlabel=names[0], ylabel=names[1])
        axis.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=8)
        _save(figure, files)


def _save(figure: object, files: Sequence[Path]) -> None:
    import matplotlib.pyplot as plt

    for file in files:
        with replacing(file) as temporary:
            figure.savefig(temporary)  # type: ignore[attr-defined]
    plt.close(figure)  # type: ignore[arg-type]
