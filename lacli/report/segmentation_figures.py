"""The segmentation on slices of the CT, with the wall's thickness: what a person looks at before trusting it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.segmentation.road import Segmented
from lacli.anatomy.segmentation.wall import NEIGHBOUR, UNCLEAR
from lacli.base.arrays import FloatArray
from lacli.report.style import paper

COLOURS = {"blood": "#D55E00", "wall": "#F0E442", "fat": "#56B4E9", "neighbour": "#CC79A7", "unclear": "#009E73"}
_HU = (-200.0, 500.0)
_SHARES = (0.3, 0.5, 0.7)
_NAMES = ("sagittal", "coronal", "axial")


def slices(ct: Image, found: Segmented, picture: Path) -> Path:
    """Three slices along each axis of the grid: contours of blood, wall and fat, where a neighbour touches or no wall is seen."""
    labels, numbers = found.labels, found.numbers
    blood = labels.array == numbers.la
    where = np.argwhere(blood)
    with paper():
        import matplotlib.pyplot as plt
        from matplotlib.lines import Line2D

        figure, axes = plt.subplots(3, 3, figsize=(7.2, 7.6))
        for row, axis in enumerate((0, 1, 2)):
            for column, share in enumerate(_SHARES):
                at = int(np.quantile(where[:, axis], share))
                _slice(axes[row, column], ct, found, axis, at)
        marks = [Line2D([], [], color=COLOURS[n], linewidth=1.5, label=n) for n in ("blood", "wall", "fat")]
        marks += [
            Line2D([], [], color=COLOURS[n], marker=".", linestyle="", label=words)
            for n, words in (("neighbour", "a neighbour touches: bounded"), ("unclear", "no wall seen"))
        ]
        figure.legend(handles=marks, loc="outside lower center", ncols=5)
        whole = found.thickness[0]
        figure.suptitle(f"wall {whole.mean_mm:.2f} ± {whole.sd_mm:.2f} mm (mean and its sd)")
        figure.savefig(picture)
        plt.close(figure)
    return picture


def turned(right: FloatArray, up: FloatArray) -> tuple[bool, bool]:
    """Whether a slice whose axes go along these unit vectors (3,) (LPS) is to be mirrored across, and turned upside down, so that
    the left and the back of the patient are on the right, the head above and, where none is, the front."""
    across, along = (int(np.argmax(np.abs(axis))) for axis in (right, up))
    # downwards to the back and to the left, upwards to the head
    wanted = 1.0 if along == 2 else -1.0
    return bool(right[across] < 0.0), bool(up[along] * wanted < 0.0)


def _slice(axis_: Any, ct: Image, found: Segmented, axis: int, at: int) -> None:
    labels, numbers = found.labels, found.numbers
    piece = np.take(labels.array, at, axis=axis)
    shape = labels.array.shape
    others = [a for a in range(3) if a != axis]
    grid = np.meshgrid(*(np.arange(shape[a]) for a in others), indexing="ij")
    index = np.empty((grid[0].size, 3))
    index[:, axis] = at
    for a, g in zip(others, grid, strict=True):
        index[:, a] = g.ravel()
    world = labels.to_world(index[:, ::-1])
    value = ndimage.map_coordinates(ct.array, ct.to_index(world)[:, ::-1].T, order=1, mode="nearest", output=np.float32)
    axis_.imshow(value.reshape(grid[0].shape), cmap="gray", vmin=_HU[0], vmax=_HU[1], origin="lower")
    for name, mask in (
        ("fat", piece == numbers.fat), ("wall", np.isin(piece, (numbers.la, numbers.wall))), ("blood", piece == numbers.la),
    ):  # fmt: skip
        if mask.any() and not mask.all():
            axis_.contour(mask.astype(float), [0.5], colors=COLOURS[name], linewidths=0.8)
    for name, kind in (("neighbour", NEIGHBOUR), ("unclear", UNCLEAR)):
        mine = found.wall.flag == kind
        if mine.any():
            place = found.labels.to_index(found.wall.surface.points[mine])[:, ::-1]
            near = np.abs(place[:, axis] - at) * labels.spacing[0] < 0.8
            axis_.plot(place[near][:, others[1]], place[near][:, others[0]], ".", color=COLOURS[name], markersize=2.5)
    way = _NAMES[int(np.argmax(np.abs(labels.direction[:, 2 - axis])))]
    across, down = turned(labels.direction[:, 2 - others[1]], labels.direction[:, 2 - others[0]])
    if across:
        axis_.invert_xaxis()
    if down:
        axis_.invert_yaxis()
    axis_.set_title(f"{way}, slice {at}", fontsize=7)
    axis_.set_axis_off()
