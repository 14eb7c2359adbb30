"""Figures of the posterior and of a calibration: corner, traces, fit, recovery of a known truth."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.inference.box import Box
from lacli.inference.sampling.posterior import Chain
from lacli.report.inference_figures import INK, SPREAD, TARGET, label, save
from lacli.report.style import paper

LEVELS = tuple(1.0 - math.exp(-0.5 * sd**2) for sd in (0.5, 1.0, 1.5, 2.0))  # within so many sd of a pair that is normal


def corner_figure(
    chain: Chain, best: FloatArray, box: Box, path: Path, truth: FloatArray | None = None, as_prior: Sequence[str] = ()
) -> Path:
    """Marginals and pairs over the box, the most probable point, and the truth where it is known; inputs ``as_prior``, of which
    the targets told nothing, are marked."""
    with paper(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import corner
        import matplotlib.pyplot as plt

        flat = chain.flat()
        d = flat.shape[1]
        keep = np.random.default_rng(0).permutation(len(flat))[:20_000]
        size = min(7.2, 1.0 * d + 0.6)
        with plt.rc_context({"figure.constrained_layout.use": False, "axes.linewidth": 0.5}):
            figure = plt.figure(figsize=(size, size))
            corner.corner(
                flat[keep], fig=figure, bins=18, smooth=1.4, color=INK, plot_datapoints=False, fill_contours=True,
                levels=LEVELS, range=list(zip(box.lower, box.upper, strict=True)), max_n_ticks=3,
                labels=[label(n).replace(" (", "\n(") for n in box.names], label_kwargs={"fontsize": 6.5}, labelpad=0.22,
                hist_kwargs={"lw": 0.9},
            )  # fmt: skip
            corner.overplot_lines(figure, best, color=TARGET, lw=0.7)
            if truth is not None:
                corner.overplot_lines(figure, truth, color="k", lw=0.7, ls="--")
            for axis in figure.axes:
                axis.tick_params(labelsize=5.5, length=2)
            for i in (box.names.index(name) for name in as_prior):
                own = figure.axes[i * (d + 1)]
                own.text(0.5, 0.97, "as the prior", transform=own.transAxes, ha="center", va="top", fontsize=6, color=TARGET)
            lines = [plt.Line2D([], [], color=INK, lw=1.2), plt.Line2D([], [], color=TARGET, lw=1.2)]
            names = [f"posterior ({', '.join(f'{100 * level:.1f}' for level in LEVELS)} %)", "most probable"]
            if truth is not None:
                lines.append(plt.Line2D([], [], color="k", lw=1.2, ls="--"))
                names.append("truth")
            figure.legend(lines, names, loc="upper right", fontsize=8)
            figure.subplots_adjust(left=0.1, bottom=0.1, right=0.98, top=0.98, wspace=0.06, hspace=0.06)
            return save(figure, path)


def trace_figure(chain: Chain, path: Path) -> Path:
    """Walkers of the independent ensembles over the steps, a panel for each input, with R-hat and ESS."""
    with paper():
        import matplotlib.pyplot as plt

        d = chain.samples.shape[-1]
        columns = 3 if d > 4 else 1
        rows = -(-d // columns)
        figure, axes = plt.subplots(rows, columns, figsize=(7.2, 1.1 * rows + 0.4), squeeze=False, sharex=True)
        for axis in axes.ravel()[d:]:
            axis.set_visible(False)
        colours = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"]
        step = np.arange(1, chain.steps + 1)
        for i, axis in zip(range(d), axes.ravel(), strict=False):
            for e in range(chain.samples.shape[1]):
                series = chain.samples[:, e, :, i]
                low, high = np.quantile(series, [0.1, 0.9], axis=1)
                axis.fill_between(step, low, high, color=colours[e % 6], alpha=0.15, lw=0)
                axis.plot(step, series[:, 0], lw=0.35, color=colours[e % 6], alpha=0.7)
                axis.plot(step, np.median(series, axis=1), lw=0.9, color=colours[e % 6])
            axis.set_title(f"{label(chain.names[i])}: R-hat {chain.rhat[i]:.3f}, ESS {chain.ess[i]:.0f}", fontsize=7)
            axis.tick_params(labelsize=6.5)
        figure.supxlabel("step (one colour an ensemble: median, 10 - 90 %, one walker)", fontsize=7.5)
        return save(figure, path)


def fit_figure(fit: Sequence[Mapping[str, Any]], draws: FloatArray, path: Path) -> Path:
    """Each feature's (value - target) / sd: simulated at the most probable point, at posterior draws (k, p), emulated."""
    with paper():
        import matplotlib.pyplot as plt

        step = 0.3 if len(fit) <= 20 else 0.14
        figure, axis = plt.subplots(figsize=(3.5, 0.9 + step * len(fit)))
        place = np.arange(len(fit))[::-1]
        axis.axvspan(-1, 1, color=TARGET, alpha=0.2, lw=0)
        axis.axvline(0, color=TARGET, lw=0.8)
        for p, (j, row) in zip(place, enumerate(fit), strict=True):
            if len(draws):
                z = (draws[:, j] - row["target"]) / row["sd"]
                axis.plot(z, np.full(len(z), p), "|", color="0.45", ms=7, mew=0.8, label="posterior draws" if j == 0 else None)
            z = (row["emulated"] - row["target"]) / row["sd"]
            axis.errorbar(
                z,
                p + 0.18,
                xerr=2 * row["emulator_sd"] / row["sd"],
                fmt="s",
                ms=3,
                color=SPREAD,
                ecolor=SPREAD,
                label="emulated ± 2 sd" if j == 0 else None,
            )
            if "simulated" in row and np.isfinite(row["simulated"]):
                axis.plot(
                    (row["simulated"] - row["target"]) / row["sd"], p, "o", ms=4, color=INK, label="simulated" if j == 0 else None
                )
        axis.set_yticks(place, [label(str(row["feature"])) for row in fit], fontsize=7 if len(fit) <= 20 else 5)
        axis.set_xlabel("(value - target) / target's sd")
        handles, names = axis.get_legend_handles_labels()
        figure.legend(handles, names, fontsize=6.5, loc="outside upper center", ncols=3, columnspacing=0.8, handletextpad=0.3)
        return save(figure, path)


def recovery_figure(levels: Mapping[str, Sequence[Mapping[str, Any]]], box: Box, path: Path) -> Path:
    """Known truth against 95 % intervals and most probable values, at each noise level, on the box's ranges."""
    with paper():
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(7.2, 0.7 + 0.34 * box.d))
        colours = [INK, "#E69F00", "#009E73"]
        place = np.arange(box.d)[::-1]
        width = box.upper - box.lower
        for k, (name, rows) in enumerate(levels.items()):
            offset = 0.22 * (0.5 * (len(levels) - 1) - k)
            low = np.array([r["low95"] for r in rows])
            high = np.array([r["high95"] for r in rows])
            best = np.array([r["map"] for r in rows])
            axis.hlines(
                place + offset,
                (low - box.lower) / width,
                (high - box.lower) / width,
                color=colours[k],
                lw=3,
                alpha=0.6,
                label=name,
            )
            axis.plot((best - box.lower) / width, place + offset, "o", ms=3.5, color=colours[k])
        truth = np.array([r["truth"] for r in next(iter(levels.values()))])
        axis.plot((truth - box.lower) / width, place, "|", color="k", ms=16, mew=1.4, label="truth")
        axis.set_xlim(-0.02, 1.02)
        axis.set_yticks(
            place, [f"{label(n)}  [{a:g} - {b:g}]" for n, a, b in zip(box.names, box.lower, box.upper, strict=True)], fontsize=7.5
        )
        axis.set_xlabel("position in the range (bars: 95 % intervals; dots: most probable)")
        axis.legend(fontsize=7, loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=len(levels) + 1)
        return save(figure, path)
