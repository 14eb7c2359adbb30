"""Figures over patients of what lies behind the answers: transients, emulators, waves, meshes, walls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lacli.base.arrays import FloatArray
from lacli.contracts.labels import BODY_REGIONS, REGION_COLOURS
from lacli.report.cohort_figures import save_all
from lacli.report.inference_figures import label
from lacli.report.style import paper

_IMAGE, _RUN, _FIRST = "#0072B2", "#D55E00", "0.75"
_PANELS = ("volume_ml", *(f"d_{region}_mm" for region in BODY_REGIONS))
GRID = np.linspace(0.0, 1.0, 41)
_FEW = 2  # times of a run that make no course


def transients_figure(frame: pd.DataFrame, files: Sequence[Path]) -> None:
    """Of one patient (as transients.csv has it), a panel for volume and each region's displacement: the image's course with 2 sd,
    the band of the first runs, the run at the most probable point, dots at end-systole, phases shaded."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(2, 3, figsize=(7.2, 3.8), sharex=True)
        phases = _phases(frame)
        for axis, key in zip(axes.flat, _PANELS, strict=True):
            mine = frame[frame["feature"] == key].sort_values("time")
            _course(axis, mine, "image", _IMAGE, "image, 2 sd", 2.0 * mine["image_sd"].to_numpy(float))
            first = mine.dropna(subset=["first_low"])
            axis.fill_between(first["time"], first["first_low"], first["first_high"], color=_FIRST, alpha=0.5, linewidth=0,
                              zorder=1, label="first runs")  # fmt: skip
            axis.plot(first["time"], first["first_median"], color="0.45", linewidth=0.8, zorder=2)
            run = mine.dropna(subset=["at_map"])
            axis.plot(run["time"], run["at_map"], "-o", color=_RUN, markersize=2.5, linewidth=1.1, label="most probable run")
            if phases:
                es = phases[0][2]
                for column, colour in (("image", _IMAGE), ("at_map", _RUN)):
                    here = mine[(mine["time"] - es).abs() < 1e-6].dropna(subset=[column])
                    axis.plot(here["time"], here[column], "o", color=colour, markersize=5, markeredgecolor="white", zorder=5)
            _shade(axis, phases, key == _PANELS[0])
            axis.set_ylabel(label(key), fontsize=8)
            axis.set_xlim(0.0, 1.0)
        _finish(figure, axes, 3)
        save_all(figure, files)


def _finish(figure: Any, axes: Any, columns: int) -> None:
    """Time below, and one legend for all panels."""
    for axis in axes[1]:
        axis.set_xlabel("time (RR)", fontsize=8)
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=columns, fontsize=8)


def _course(axis: Any, mine: pd.DataFrame, column: str, colour: str, name: str, reach: FloatArray) -> None:
    """A line with its band through many times, bars at few."""
    known = mine[column].notna().to_numpy()
    time, value, reach = mine["time"].to_numpy(float)[known], mine[column].to_numpy(float)[known], reach[known]
    if len(time) > 12:
        axis.fill_between(time, value - reach, value + reach, color=colour, alpha=0.2, linewidth=0, zorder=2)
        axis.plot(time, value, color=colour, linewidth=1.2, label=name, zorder=3)
    elif len(time):
        axis.errorbar(time, value, yerr=reach, fmt="o", color=colour, markersize=3, elinewidth=0.8, label=name, zorder=3)


def _phases(frame: pd.DataFrame) -> list[tuple[str, float, float]]:
    """Name, from, to: of the phases in their order."""
    times = frame.dropna(subset=["phase"]).drop_duplicates("time").sort_values("time")
    found: list[tuple[str, float, float]] = []
    for name, rows in groupby(zip(times["phase"].astype(str), times["time"].astype(float), strict=True), key=lambda row: row[0]):
        if name:
            last = max(time for _, time in rows)
            found.append((name, found[-1][2] if found else 0.0, last))
    return found


def _shade(axis: Any, phases: Sequence[tuple[str, float, float]], named: bool) -> None:
    for number, (name, start, end) in enumerate(phases):
        if number % 2 == 0:
            axis.axvspan(start, end, color="0.95", zorder=0, linewidth=0)
        if named:
            axis.text((start + end) / 2, 1.02, name, transform=axis.get_xaxis_transform(), ha="center", fontsize=6)
    if phases:
        axis.axvline(phases[0][2], color="0.4", linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)


def cohort_transients_figure(frame: pd.DataFrame, files: Sequence[Path]) -> None:
    """Over the patients: mean and one sd of the images' courses and of the most probable runs', each run a thin line."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(2, 3, figsize=(7.2, 3.6), sharex=True)
        grid = GRID
        for axis, key in zip(axes.flat, _PANELS, strict=True):
            for column, colour, name in (("image", _IMAGE, "image"), ("at_map", _RUN, "most probable run")):
                lines = over_grid(frame, key, column, grid)
                if column == "at_map":
                    axis.plot(grid, lines.T, color=colour, linewidth=0.4, alpha=0.5)
                told = np.isfinite(lines).sum(axis=0) > 1
                if not told.any():
                    continue
                mean, sd = np.nanmean(lines[:, told], axis=0), np.nanstd(lines[:, told], axis=0, ddof=1)
                axis.fill_between(grid[told], mean - sd, mean + sd, color=colour, alpha=0.2, linewidth=0)
                axis.plot(grid[told], mean, color=colour, linewidth=1.5, label=f"{name}, mean ± sd")
            axis.set_ylabel(label(key), fontsize=8)
            axis.set_xlim(0.0, 1.0)
        _finish(figure, axes, 2)
        save_all(figure, files)


def over_grid(frame: pd.DataFrame, key: str, column: str, grid: FloatArray) -> FloatArray:
    """(patients, m): a feature's course of each patient with more than two times, linear between them; NaN outside of them."""
    rows = []
    for _, mine in frame[frame["feature"] == key].groupby("participant_id", sort=False):
        known = mine.dropna(subset=[column]).sort_values("time")
        if len(known) > _FEW:
            rows.append(np.interp(grid, known["time"], known[column], left=np.nan, right=np.nan))
    return np.array(rows).reshape(-1, len(grid))


def scores_figure(frame: pd.DataFrame, files: Sequence[Path]) -> None:
    """R2 and ISE of the emulators, an output a row and a patient a column, the worst framed and named. frame: as scores.csv."""
    with paper():
        import matplotlib.pyplot as plt

        people, outputs = list(dict.fromkeys(frame["participant_id"])), list(dict.fromkeys(frame["output"]))
        shown = [name for name in (("r2", "$R^2$"), ("ise", "share within 2 sd")) if frame[name[0]].notna().any()]
        width, height = min(7.2, len(shown) * (0.34 * len(people) + 1.1) + 1.4), 0.17 * len(outputs) + 1.5
        figure, axes = plt.subplots(1, len(shown), figsize=(max(4.8, width), height), sharey=True, squeeze=False)
        for axis, (key, name) in zip(axes.flat, shown, strict=True):
            table = frame.pivot(index="output", columns="participant_id", values=key).reindex(index=outputs, columns=people)
            values = table.to_numpy(float)
            image = axis.imshow(values, cmap="viridis", vmin=min(0.9, float(np.nanmin(values))), vmax=1.0, aspect="auto")
            i, j = np.unravel_index(int(np.nanargmin(values)), values.shape)
            axis.add_patch(plt.Rectangle((float(j) - 0.5, float(i) - 0.5), 1.0, 1.0, fill=False, edgecolor=_RUN, linewidth=1.5))
            axis.set_title(f"{name}\nworst: {values[i, j]:.3f}\n{outputs[i]} of {people[j]}", fontsize=7)
            axis.set_xticks(range(len(people)), people, rotation=90, fontsize=6)
            axis.set_yticks(range(len(outputs)), [label(output) for output in outputs], fontsize=6)
            figure.colorbar(image, ax=axis, fraction=0.05).ax.tick_params(labelsize=6)
        save_all(figure, files)


def shares_figure(frame: pd.DataFrame, files: Sequence[Path]) -> None:
    """Share of the box not ruled out after each wave, a line a patient. frame: as waves.csv."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(3.5, 2.8))
        for name, mine in frame.dropna(subset=["nroy_share"]).groupby("participant_id", sort=False):
            axis.plot(mine["wave"], 100.0 * mine["nroy_share"], "-o", markersize=3.5, linewidth=1.0, label=str(name))
        axis.set_yscale("log")
        axis.set(xlabel="wave", ylabel="not ruled out (% of the box)")
        axis.set_xticks(sorted(frame["wave"].dropna().astype(int).unique()))
        axis.legend(fontsize=6, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        save_all(figure, files)


def convergence_figure(frame: pd.DataFrame, files: Sequence[Path]) -> None:
    """Error of the displacements at end-systole against the size of the cells, a line a patient and order; dots: the own
    mesh, crosses: measured on it. frame: as convergence.csv."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(3.5, 3.0))
        for order, colour, name in ((1, _RUN, "linear cells"), (2, _IMAGE, "quadratic cells")):
            mine = frame[frame["order"] == order]
            model, measured = mine[mine["source"] == "model"], mine[mine["source"] == "measured"]
            for number, (_, line) in enumerate(model.groupby("participant_id", sort=False)):
                line = line.sort_values("cell_mm")
                axis.plot(line["cell_mm"], line["error_mm"], color=colour, linewidth=0.9, label=name if number == 0 else None)
            at = model[model["own"]]
            axis.plot(at["cell_mm"], at["error_mm"], "o", color=colour, markersize=4, linestyle="")
            if len(measured):
                axis.plot(measured["cell_mm"], measured["error_mm"], "x", color=colour, markersize=6, label=f"{name}, measured")
        axis.set(xscale="log", yscale="log", xlabel="edge of the cells (mm)", ylabel="error of displacements, rms (mm)")
        for one in (axis.xaxis, axis.yaxis):
            one.set_major_locator(plt.matplotlib.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
            one.set_major_formatter("{x:g}")
            one.set_minor_formatter("")
        axis.legend(fontsize=7)
        save_all(figure, files)


def thicknesses_figure(frame: pd.DataFrame, names: tuple[str, str], files: Sequence[Path]) -> None:
    """Wall thickness measured in one way against another, mm, a marker a patient and region, with the line of identity."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(3.2, 3.0))
        ends = np.array([frame[list(names)].min().min() - 0.2, frame[list(names)].max().max() + 0.2])
        axis.plot(ends, ends, color="0.6", linewidth=0.8, zorder=0)
        for region, mine in frame.groupby("region", sort=False):
            axis.plot(mine[names[0]], mine[names[1]], "o", color=REGION_COLOURS[str(region)], markersize=4, label=region)
        off = float(np.nanmedian(np.abs(frame[names[0]] - frame[names[1]])))
        axis.set_title(f"median difference {off:.2f} mm", fontsize=8)
        axis.set(xlabel="by Laplace's lines (mm)", ylabel="by the eikonal (mm)", xlim=ends, ylim=ends, aspect="equal")
        axis.legend(fontsize=7)
        save_all(figure, files)


def fat_figure(frame: pd.DataFrame, columns: Mapping[str, str], files: Sequence[Path]) -> None:
    """Fat by region, mL, a box a window side by side with a marker a patient. columns: name of each window's column."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(5.4, 2.8))  # the legend takes a fifth: names of regions have to stand apart
        width = 0.8 / len(columns)
        for k, ((window, column), colour) in enumerate(zip(columns.items(), (_IMAGE, _RUN, "#009E73"), strict=False)):
            places = np.arange(len(BODY_REGIONS)) + (k - (len(columns) - 1) / 2) * width
            values = [frame.loc[frame["region"] == region, column].dropna().to_numpy(float) for region in BODY_REGIONS]
            axis.boxplot(values, positions=places, widths=0.8 * width, showfliers=False, medianprops={"color": "black"})
            x = np.concatenate([np.full(len(v), place) for place, v in zip(places, values, strict=True)])
            axis.plot(x, np.concatenate(values), "o", color=colour, markersize=3.5, label=window)
        axis.set_xticks(range(len(BODY_REGIONS)), BODY_REGIONS)
        axis.set_ylabel("epicardial fat (mL)")
        axis.legend(fontsize=7, title="window", title_fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        save_all(figure, files)
