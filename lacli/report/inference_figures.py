"""Figures of emulators and sensitivity: predicted against simulated, heat map of indices, ranking."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.files import replacing
from lacli.inference.emulation.validation import Scores
from lacli.inference.sensitivity import Sobol
from lacli.report.style import paper

INK, SPREAD, TARGET = "#0072B2", "#9CC3DE", "#D55E00"
_UNITS = {"_ml": "mL", "_mm": "mm", "_mmhg": "mmHg", "_kpa": "kPa", "_kpa_per_um": "kPa/µm"}


def label(name: str) -> str:
    """A column's name as an axis label: ``esv_ml`` -> ``ESV (mL)``, ``alpha_roof`` -> ``α roof``, with its time if it has one."""
    name, at, time = name.replace("$", r"\$").partition("@")  # no formula begins there
    if at:
        return f"{label(name)} at {time}"
    for ending in ("_kpa_per_um", "_mmhg", "_ml", "_mm", "_kpa"):
        if name.endswith(ending):
            return f"{_words(name.removesuffix(ending))} ({_UNITS[ending]})"
    return _words(name)


def _words(name: str) -> str:
    capitals = {"edp", "esp", "esv", "edv", "pth", "c"}
    words = [word.upper() if word in capitals else {"alpha": "α", "k": "k"}.get(word, word) for word in name.split("_")]
    return " ".join(words)


def save(figure, path: Path) -> Path:  # type: ignore[no-untyped-def]
    """Write a figure whole or not at all, and close it."""
    import matplotlib.pyplot as plt

    with replacing(Path(path)) as temporary:
        figure.savefig(temporary)
    plt.close(figure)
    return Path(path)


def validation_figure(scores: Sequence[Scores], y: FloatArray, path: Path) -> Path:
    """Held-out predictions (± 2 sd) against simulations y (n, p), a panel for each output."""
    with paper():
        import matplotlib.pyplot as plt

        columns = min(4, len(scores))
        rows = -(-len(scores) // columns)
        figure, axes = plt.subplots(rows, columns, figsize=(7.2, 2.0 * rows + 0.2), squeeze=False)
        for axis in axes.ravel()[len(scores) :]:
            axis.set_visible(False)
        for j, (s, axis) in enumerate(zip(scores, axes.ravel(), strict=False)):
            inside = np.abs(s.mean - y[:, j]) < 2.0 * s.sd
            for keep, colour in ((inside, INK), (~inside, TARGET)):
                axis.errorbar(
                    y[keep, j], s.mean[keep], yerr=2.0 * s.sd[keep], fmt="o", ms=1.8, lw=0.5, color=colour, ecolor=SPREAD, mew=0
                )
            ends = [y[:, j].min(), y[:, j].max()]
            axis.plot(ends, ends, color="0.4", lw=0.7, zorder=0)
            axis.set_title(f"{label(s.output)}\n$R^2$ {s.r2:.4f}, within 2 sd {s.ise:.0%}", fontsize=7.5)
            axis.tick_params(labelsize=7)
            axis.locator_params(nbins=4)
        figure.supxlabel("simulated", fontsize=8)
        figure.supylabel("predicted without the run (± 2 sd; red: outside)", fontsize=8)
        return save(figure, path)


def sensitivity_figure(s: Sobol, inputs: Sequence[str], outputs: Sequence[str], path: Path) -> Path:
    """Heat maps of first-order and total indices, outputs by inputs; numbers where they matter."""
    with paper():
        import matplotlib.pyplot as plt

        height = 1.2 + 0.3 * len(outputs)
        figure, axes = plt.subplots(1, 2, figsize=(7.2, height + 0.9), sharey=True)
        image: Any = None
        for axis, values, title in ((axes[0], s.s1, "first-order"), (axes[1], s.st, "total")):
            image = axis.imshow(np.clip(values, 0.0, 1.0), cmap="viridis", vmin=0.0, vmax=1.0, aspect="auto")
            axis.set_xticks(
                range(len(inputs)), [label(n) for n in inputs], rotation=60, ha="right", rotation_mode="anchor", fontsize=7
            )
            axis.set_yticks(range(len(outputs)), [label(n) for n in outputs], fontsize=7)
            axis.set_title(title)
            axis.tick_params(length=0)
            for i, j in np.argwhere(values >= 0.05).tolist():
                axis.text(
                    j, i, f"{values[i, j]:.2f}", ha="center", va="center", fontsize=5.5, color="w" if values[i, j] < 0.6 else "k"
                )
            for side in axis.spines.values():
                side.set_visible(False)
        figure.colorbar(image, ax=axes, shrink=0.8, label="Sobol' index", pad=0.01)
        return save(figure, path)


def ranking_figure(s: Sobol, inputs: Sequence[str], outputs: Sequence[str], path: Path) -> Path:
    """Inputs by their greatest total effect: bars with the sampling interval (95 %) and the emulators' own sd."""
    with paper():
        import matplotlib.pyplot as plt

        rank = s.ranking()
        order = rank.argsort()
        best = s.st.argmax(0)
        j = np.arange(len(inputs))
        total, conf, spread = s.st[best, j], s.st_conf[best, j], s.st_emulator_sd[best, j]
        figure, axis = plt.subplots(figsize=(3.5, 0.8 + 0.24 * len(inputs)))
        place = np.arange(len(inputs))
        axis.barh(place, total[order], color=INK, height=0.7, label="total effect")
        axis.barh(place, s.s1[best, j][order].clip(0), color=SPREAD, height=0.35, label="first-order")
        both = np.hypot(conf, 1.96 * spread)
        axis.errorbar(total[order], place, xerr=both[order], fmt="none", ecolor="k", lw=0.8, capsize=1.5)
        axis.set_yticks(place, [label(inputs[k]) for k in order], fontsize=7)
        reach = float((total + both).max())
        for p, k in zip(place, order, strict=True):
            axis.text(reach * 1.03, float(p), label(outputs[best[k]]).split(" (")[0], va="center", fontsize=6, color="0.35")
        axis.set_xlim(0.0, reach * 1.35)
        axis.set_xlabel("Sobol' index on the output named (95 %)")
        axis.legend(fontsize=6.5, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
        return save(figure, path)
