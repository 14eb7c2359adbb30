"""Figures over patients: a quantity by region, one marker a patient; and one quantity against another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.files import replacing
from lacli.contracts.labels import REGION_COLOURS
from lacli.report.style import paper

_OTHER = "#555555"


def regions_figure(
    values: FloatArray,
    regions: Sequence[str],
    name: str,
    files: Sequence[Path],
    stars: Mapping[tuple[str, str], str] | None = None,
) -> None:
    """Boxes by region with a marker a patient, joined by patient. values: (patients, regions); stars: above pairs of regions,
    those without any are left out. One file a format."""
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
        marked = [(regions.index(a), regions.index(b), said) for (a, b), said in (stars or {}).items() if said]
        step = 0.06 * (float(np.ptp(values)) or 1.0)
        for level, (a, b, said) in enumerate(sorted(marked, key=lambda pair: (abs(pair[1] - pair[0]), pair))):
            height = float(values.max()) + (1.0 + level) * step
            axis.plot([a, a, b, b], [height - 0.25 * step, height, height, height - 0.25 * step], color="black", linewidth=0.6)
            axis.text((a + b) / 2, height - 0.2 * step, said, ha="center", va="bottom", fontsize=6)
        save_all(figure, files)


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
        save_all(figure, files)


def influence_figure(inputs: Sequence[str], outputs: Sequence[str], shares: FloatArray, files: Sequence[Path]) -> None:
    """Heat map of the share (inputs, outputs) of each output's variance that an input makes; the inputs that together make 90 %
    of an output's are in colour, the others grey, as the published study has it."""
    with paper():
        import matplotlib.pyplot as plt

        counted = ninety(shares)
        height, width = 0.26 * len(inputs) + 1.3, min(7.2, 0.3 * len(outputs) + 1.9)
        figure, axis = plt.subplots(figsize=(width, height))
        axis.imshow(np.where(counted, np.nan, shares), cmap="Greys", vmin=0.0, vmax=1.0, aspect="auto")
        image = axis.imshow(np.where(counted, shares, np.nan), cmap="viridis_r", vmin=0.0, vmax=1.0, aspect="auto")
        for i, j in np.argwhere(shares >= 0.05):
            axis.text(j, i, f"{100 * shares[i, j]:.0f}", ha="center", va="center", fontsize=5,
                      color="white" if counted[i, j] and shares[i, j] > 0.5 else "black")  # fmt: skip
        axis.set_xticks(range(len(outputs)), outputs, rotation=90, fontsize=6)
        axis.set_yticks(range(len(inputs)), inputs, fontsize=7)
        figure.colorbar(image, ax=axis, label="share of the variance")
        save_all(figure, files)


def ninety(shares: FloatArray) -> BoolArray:
    """(inputs, outputs): whether an input is among the largest that together make 90 % of an output's variance."""
    order = np.argsort(-shares, axis=0, kind="stable")
    ranked = np.take_along_axis(shares, order, axis=0)
    before = np.cumsum(ranked, axis=0) - ranked
    counted = np.zeros(shares.shape, dtype=bool)
    np.put_along_axis(counted, order, (before < 0.9) & (ranked > 0), axis=0)
    return counted


def courses_figure(frame: pd.DataFrame, files: Sequence[Path]) -> None:
    """A column a patient: targets at their times with 2 sd, and lines through the values at the most probable point; volume
    above, displacements of the regions below. frame: participant_id, feature, time, target, sd, at_map."""
    with paper():
        import matplotlib.pyplot as plt

        people = list(dict.fromkeys(frame["participant_id"]))
        lengths = [f"d_{region}_mm" for region in REGION_COLOURS if (frame["feature"] == f"d_{region}_mm").any()]
        figure, axes = plt.subplots(2, len(people), figsize=(max(3.0, 1.5 * len(people)), 3.4), sharex=True, sharey="row",
                                    squeeze=False)  # fmt: skip
        for column, person in zip(axes.T, people, strict=True):
            column[0].set_title(str(person), fontsize=7)
            for axis, keys in ((column[0], ["volume_ml"]), (column[1], lengths)):
                for key in keys:
                    mine = frame[(frame["participant_id"] == person) & (frame["feature"] == key)].sort_values("time")
                    region = key.removeprefix("d_").removesuffix("_mm")
                    colour = REGION_COLOURS.get(region, "black")
                    axis.errorbar(mine["time"], mine["target"], yerr=2.0 * mine["sd"], fmt="o", color=colour, markersize=2.5,
                                  elinewidth=0.6)  # fmt: skip
                    axis.plot(mine["time"], mine["at_map"], "-", color=colour, linewidth=1.0, label=region if lengths else None)
        axes[0, 0].set_ylabel("volume (mL)")
        axes[1, 0].set_ylabel("displacement (mm)")
        for axis in axes[1]:
            axis.set_xlabel("time (RR)", fontsize=7)
        handles, labels = axes[1, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5 if len(people) > 2 else 2, fontsize=6)
        save_all(figure, files)


@dataclass(frozen=True)
class Atrium:
    """One of a gallery: corners (t, 3, 3) mm of the endocardial triangles, their colours, direction to the camera, up (3,)."""

    name: str
    corners: FloatArray
    colours: Sequence[str]
    direction: FloatArray
    up: FloatArray


def gallery_figure(atria: Sequence[Atrium], marked: Sequence[str], files: Sequence[Path]) -> None:
    """All atria from one side at one scale, by region; marked: names set in bold, with a star. One file a format."""
    with paper():
        import matplotlib.pyplot as plt
        from matplotlib.collections import PolyCollection
        from matplotlib.colors import to_rgb

        columns = min(5, len(atria))
        rows = -(-len(atria) // columns)
        figure, axes = plt.subplots(rows, columns, figsize=(7.2, 1.6 * rows + 0.3), squeeze=False)
        flats = [a.corners @ np.stack([np.cross(a.up, a.direction), a.up, a.direction], axis=1) for a in atria]
        half = 0.55 * max(float(np.ptp(flat[..., :2].reshape(-1, 2), axis=0).max()) for flat in flats)
        for axis in axes.flat:
            axis.set_axis_off()
        for axis, atrium, flat in zip(axes.flat, atria, flats, strict=False):
            middle = (flat.reshape(-1, 3).max(axis=0) + flat.reshape(-1, 3).min(axis=0)) / 2
            normal = np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
            light = 0.45 + 0.55 * np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
            order = np.argsort(flat[:, :, 2].mean(axis=1))  # far ones first
            colour = np.array([to_rgb(c) for c in atrium.colours]) * light[:, None]
            axis.add_collection(
                PolyCollection(list(flat[order, :, :2]), facecolors=colour[order], edgecolors=colour[order], linewidths=0.2)
            )
            axis.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
            star = atrium.name in marked
            axis.set_title(f"{atrium.name} *" if star else atrium.name, fontweight="bold" if star else "normal", fontsize=8)
        bar = axes[0, 0]
        low = bar.get_xlim()[0], bar.get_ylim()[0]
        bar.plot([low[0], low[0] + 20.0], [low[1], low[1]], color="black", linewidth=1.5)
        bar.text(low[0], low[1], "20 mm", fontsize=7, va="bottom")
        save_all(figure, files)


def save_all(figure: object, files: Sequence[Path]) -> None:
    """Save a figure, a file a format, each whole or not at all, and close it."""
    import matplotlib.pyplot as plt

    for file in files:
        with replacing(file) as temporary:
            figure.savefig(temporary)  # type: ignore[attr-defined]
    plt.close(figure)  # type: ignore[arg-type]
