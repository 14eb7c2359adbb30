"""Figures of history matching: pairwise views of what is not ruled out, outputs wave by wave."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.targets import Targets
from lacli.inference.emulation.emulator_set import AnyEmulators
from lacli.inference.matching.matching import Region
from lacli.report.inference_figures import INK, TARGET, label, save
from lacli.report.style import paper

_CELLS = 20
_POINTS = 60_000


def region_figure(
    region: Region, path: Path, seed: int = 0, sample: FloatArray | None = None, share: float | None = None
) -> Path:
    """Pairs of inputs: below the diagonal the least implausibility over the other inputs (divided by the threshold; over 1
    is ruled out), above it the optical depth (share of the other inputs' values not ruled out).

    sample (m, d): points uniform in the region, and its share of the box: with them a region too small for the points of
    the box still shows, its depth counted from the sample. The ranges of the axes stand on the diagonal.
    """
    box = region.box
    x = box.uniform(_POINTS, np.random.default_rng(seed))
    if sample is not None:
        x = np.vstack([x, sample])
    level = region.level(x)
    weight = np.ones(len(x))
    weight[_POINTS:] = 0.0  # the sample does not count as depth
    cell = np.minimum((box.to_unit(x) * _CELLS).astype(int), _CELLS - 1)
    d = box.d
    with paper():
        import matplotlib.pyplot as plt

        size = min(7.2, 0.9 * d + 1.0)
        figure, axes = plt.subplots(d, d, figsize=(size, size + 0.4), squeeze=False)
        _tight(figure)
        least = depth = None
        for i in range(d):
            for j in range(d):
                axis = axes[i, j]
                axis.set_xticks([])
                axis.set_yticks([])
                for side in axis.spines.values():
                    side.set_linewidth(0.4)
                if i == j:
                    words = label(box.names[i]).replace(" ", "\n") + f"\n{box.lower[i]:.3g}\nto {box.upper[i]:.3g}"
                    name = axis.text(0.5, 0.5, words, ha="center", va="center", fontsize=5.5, transform=axis.transAxes)
                    name.set_in_layout(False)  # a long name may not narrow its column
                    continue
                flat = cell[:, i] * _CELLS + cell[:, j]
                if i > j:
                    grid = np.full(_CELLS**2, np.inf)
                    np.minimum.at(grid, flat, level)
                    shown = np.where(np.isfinite(grid), grid, np.nan).reshape(_CELLS, _CELLS)
                    least = axis.imshow(shown, origin="lower", cmap="viridis_r", vmin=0.0, vmax=2.0, aspect="auto")
                else:
                    count = np.bincount(flat, weight, _CELLS**2)
                    inside = np.bincount(flat, weight * (level < 1.0), _CELLS**2)
                    if sample is not None and share is not None:
                        # P(inside | cell) = P(cell | inside) P(inside) / P(cell)
                        sampled = np.bincount(flat[_POINTS:], minlength=_CELLS**2) / len(sample)
                        ratio = np.minimum(share * sampled / np.maximum(count / _POINTS, 0.5 / _POINTS), 1.0)
                    else:
                        ratio = inside / np.maximum(count, 1.0)
                    depth = axis.imshow(
                        ratio.reshape(_CELLS, _CELLS), origin="lower", cmap="magma", vmin=0.0, aspect="auto", vmax=None
                    )
        if depth is not None and least is not None:
            peak = max(image.get_array().max() for axis in axes[np.triu_indices(d, 1)] for image in axis.images)
            for axis in axes[np.triu_indices(d, 1)]:
                axis.images[0].set_clim(0.0, max(peak, 1e-6))
            left = figure.colorbar(least, ax=axes, location="bottom", shrink=0.42, anchor=(0.0, 0.5), pad=0.012, aspect=30)
            left.set_label("least implausibility / threshold (above 1: ruled out)", fontsize=7)
            right = figure.colorbar(depth, ax=axes, location="top", shrink=0.42, anchor=(1.0, 0.5), pad=0.012, aspect=30)
            right.set_label("optical depth (share not ruled out)", fontsize=7)
            for bar in (left, right):
                bar.ax.tick_params(labelsize=6)
        return save(figure, path)


def _tight(figure: Any) -> None:
    """Little room between many small panels."""
    figure.get_layout_engine().set(w_pad=0.01, h_pad=0.01, wspace=0.03, hspace=0.03)


def outputs_figure(waves: Sequence[tuple[str, AnyEmulators, FloatArray]], targets: Targets, path: Path) -> Path:
    """Outputs over what each wave left (name, emulators, points (m, d)), as violins against the target ± 1 and 3 sd."""
    with paper():
        import matplotlib.pyplot as plt

        p = len(targets.names)
        columns = min(4, p)
        rows = -(-p // columns)
        figure, axes = plt.subplots(rows, columns, figsize=(7.2, 1.9 * rows), squeeze=False)
        for axis in axes.ravel()[p:]:
            axis.set_visible(False)
        values = [emulators.predict_mean(points[:2000]) for _, emulators, points in waves]
        for j, axis in zip(range(p), axes.ravel(), strict=False):
            mu, sd = targets.mean[j], targets.sd[j]
            axis.axhspan(mu - 3 * sd, mu + 3 * sd, color=TARGET, alpha=0.12, lw=0)
            axis.axhspan(mu - sd, mu + sd, color=TARGET, alpha=0.25, lw=0)
            axis.axhline(mu, color=TARGET, lw=0.8)
            parts = axis.violinplot([v[:, j] for v in values], showextrema=False, widths=0.8)
            for body in parts["bodies"]:
                body.set_facecolor(INK)
                body.set_alpha(0.6)
            axis.set_xticks(range(1, len(waves) + 1), [name for name, _, _ in waves], fontsize=7)
            axis.set_title(label(targets.names[j]), fontsize=8)
            axis.tick_params(labelsize=7)
        figure.supxlabel("points not ruled out; bands: target ± 1 and ± 3 sd", fontsize=7)
        return save(figure, path)
