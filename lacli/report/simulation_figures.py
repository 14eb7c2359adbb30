"""Pictures of a finished simulation: transients against time, and the atrium at end-diastole and end-systole.

``python -m lacli.report.simulation_figures RUN_FOLDER`` draws both; ``draw_apart`` does so in a process of its own,
because a graphics library without a working driver may end the whole process.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lacli.base import vtkxml
from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError
from lacli.base.files import replacing
from lacli.base.processes.process import answer_of
from lacli.contracts.labels import PLANE_COLOUR, REGION_COLOURS, REGIONS, RING_COLOUR, RINGS, is_ring
from lacli.report.style import paper

TRANSIENTS, SHAPES = "transients.png", "shapes.png"
SOURCES = ("transients.csv", "fields/ed.vtu", "fields/es.vtu")  # products of a run that the pictures are drawn from
_COLUMNS = ("time", "phase", "pressure_mmhg", "volume_ml", "d_global_mm")
_PIXELS = 700


def draw(folder: Path) -> list[Path]:
    """Draw what the run in ``folder`` has data for, into the folder. Raises InputError on damaged files."""
    drawn = []
    if (folder / "transients.csv").is_file():
        drawn.append(transient_figure(folder / "transients.csv", folder / TRANSIENTS))
    if (folder / "fields" / "ed.vtu").is_file() and (folder / "fields" / "es.vtu").is_file():
        drawn.append(shape_figure(folder / "fields" / "ed.vtu", folder / "fields" / "es.vtu", folder / SHAPES))
    return drawn


def draw_apart(folder: Path) -> tuple[list[Path], str]:
    """As ``draw``, in a process of its own: the pictures, and what went wrong ('' if nothing)."""
    command = [sys.executable, "-m", __name__, str(folder)]
    try:
        answer = answer_of(command, timeout_s=300)
    except subprocess.TimeoutExpired:
        return [], "drawing took more than 300 s"
    drawn = [Path(line) for line in answer.stdout.splitlines() if line.endswith(".png")]
    trouble = "" if answer.returncode == 0 else (answer.stderr.strip().splitlines() or [f"code {answer.returncode}"])[-1]
    return drawn, trouble


# --- transients -------------------------------------------------------------------------------------------------------


def transient_figure(table: Path, picture: Path) -> Path:
    """Pressure (mmHg), volume (mL) and displacement (mm) against time (fraction of the cycle).

    table: columns time, phase, pressure_mmhg, volume_ml, d_global_mm and d_<region>_mm.
    """
    frame = _read_transients(table)
    with paper():
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(3, 1, figsize=(4.6, 5.6), sharex=True, height_ratios=[1, 1, 1.6])
        pressure, volume, displacement = axes
        mark = "o" if len(frame) <= 30 else ""
        line = {"marker": mark, "markersize": 3, "linewidth": 1.6, "clip_on": False}
        pressure.plot(frame["time"], frame["pressure_mmhg"], color="black", **line)
        pressure.set_ylabel("pressure (mmHg)")
        volume.plot(frame["time"], frame["volume_ml"], color="black", **line)
        volume.set_ylabel("volume (mL)")
        displacement.plot(frame["time"], frame["d_global_mm"], color="black", label="global", zorder=3, **line)
        for name, colour in REGION_COLOURS.items():
            if f"d_{name}_mm" in frame:
                displacement.plot(frame["time"], frame[f"d_{name}_mm"], color=colour, label=name, **{**line, "linewidth": 1.2})
        displacement.set_ylabel("displacement from ED (mm)")
        displacement.set_xlabel("time (fraction of the cycle)")
        displacement.set_ylim(bottom=0)
        displacement.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.24))
        _mark_phases(axes, frame)
        displacement.set_xlim(frame["time"].min(), frame["time"].max())
        with replacing(picture) as temporary:
            figure.savefig(temporary)
        plt.close(figure)
    return picture


def _read_transients(table: Path) -> pd.DataFrame:
    try:
        frame = pd.read_csv(table)
    except (OSError, ValueError) as error:
        raise InputError(f"{table}: not a table of transients ({error}).") from error
    absent = [name for name in _COLUMNS if name not in frame]
    if absent:
        raise InputError(f"{table}: the column {absent[0]!r} is missing.")
    if frame.empty:
        raise InputError(f"{table}: the table is empty.")
    return frame


def _mark_phases(axes: Any, frame: pd.DataFrame) -> None:
    """Shade every second phase, name each above, and mark end-systole (the largest volume)."""
    times = frame["time"].to_numpy()
    runs = [(name, [i for i, _ in group]) for name, group in groupby(enumerate(frame["phase"]), key=lambda item: item[1])]
    for count, (name, rows) in enumerate(runs):
        # a phase reaches from the last time of the one before
        begin, end = times[max(rows[0] - 1, 0)], times[rows[-1]]
        if end <= begin:
            continue
        for axis in axes:
            if count % 2 == 0:
                axis.axvspan(begin, end, color="0.95", zorder=0, linewidth=0)
        axes[0].text((begin + end) / 2, 1.02, str(name), transform=axes[0].get_xaxis_transform(), ha="center", va="bottom")
    es = times[int(frame["volume_ml"].to_numpy().argmax())]
    for axis in axes:
        axis.axvline(es, color="0.4", linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
    late = es > times[0] + 0.8 * (times[-1] - times[0])
    axes[1].annotate(
        "ES",
        (es, 0.06),
        xycoords=axes[1].get_xaxis_transform(),
        xytext=(-4 if late else 4, 0),
        textcoords="offset points",
        ha="right" if late else "left",
        color="0.3",
    )


# --- shapes -----------------------------------------------------------------------------------------------------------


def shape_figure(ed_file: Path, es_file: Path, picture: Path) -> Path:
    """The atrium at ED and ES by region, and at ES by displacement from ED (mm), from in front and from behind.

    Files: points in mm, cell array ``region``; point array ``displacement`` (3) in mm from ED in the second.
    """
    ed, es = _read_shape(ed_file), _read_shape(es_file)
    if "displacement" not in es.point_data:
        raise InputError(f"{es_file}: the point array 'displacement' is missing.")
    es.point_data["distance"] = np.linalg.norm(np.asarray(es.point_data["displacement"], dtype=float), axis=1)
    front, up = _viewing_directions(ed)
    top = float(es.point_data["distance"].max()) or 1.0
    frame = _frame(np.vstack([ed.points, es.points]), front, up)
    surfaces = [_surface(ed), _surface(es)]
    with paper():
        import matplotlib.pyplot as plt

        height = 2.3 * frame.height / frame.width
        figure = plt.figure(figsize=(7.2, 2 * height + 1.1))
        grid = figure.add_gridspec(3, 3, height_ratios=[height, height, 0.75])
        for row, (sign, side) in enumerate(((1.0, "from in front"), (-1.0, "from behind"))):
            view = frame.seen_from(sign)
            pictures = [_render(surfaces[0], False, top, view), *(_render(surfaces[1], how, top, view) for how in (False, True))]
            axes = [figure.add_subplot(grid[row, column]) for column in range(3)]
            for axis, image in zip(axes, pictures, strict=True):
                axis.imshow(image)
                axis.set(xticks=[], yticks=[])
                axis.spines[:].set_visible(False)
            for axis in axes[1:]:
                axis.contour((pictures[0] < 250).any(axis=2), [0.5], colors="black", linewidths=0.8)
            axes[0].set_ylabel(side)
            if row == 0:
                for axis, title in zip(
                    axes, ("end-diastole (ED)", "end-systole (ES), ED outlined", "ES, displacement"), strict=True
                ):
                    axis.set_title(title)
        _scale_bar(axes[0], frame)
        _legends(figure, grid, top)
        with replacing(picture) as temporary:
            figure.savefig(temporary)
        plt.close(figure)
    return picture


def _read_shape(file: Path) -> Any:
    shape = vtkxml.read(file, remedy="Run the scene again.")
    if "region" not in shape.cell_data:
        raise InputError(f"{file}: the cell array 'region' is missing.")
    return shape


def _surface(shape: Any) -> Any:
    """Outer surface, smooth for 10-node cells."""
    # the sides of cells that other cells cover stay inside; one subdivision shows the curvature of P2 cells
    return shape.extract_surface(nonlinear_subdivision=2, algorithm="dataset_surface")


def _viewing_directions(shape: Any) -> tuple[FloatArray, FloatArray]:
    """From where anterior is nearest, with the roof (or away from the mitral valve) up."""
    region = np.asarray(shape.cell_data["region"])
    centres = shape.cell_centers().points
    middle = centres.mean(axis=0)

    def centroid(*ids: int) -> FloatArray:
        found = np.isin(region, ids)
        return centres[found].mean(axis=0) if found.any() else middle

    mitral = centroid(RINGS["mv"], 21)
    up = centroid(REGIONS["roof"]) - mitral if not np.allclose(mitral, middle) else centroid(REGIONS["roof"]) - middle
    front = centroid(REGIONS["anterior"]) - centroid(REGIONS["posterior"])
    if np.linalg.norm(up) < 1e-6:
        up = np.array([0.0, 0.0, 1.0])
    up = up / np.linalg.norm(up)
    front = front - up * float(front @ up)
    if np.linalg.norm(front) < 1e-6:
        front = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    return front / np.linalg.norm(front), up


@dataclass(frozen=True)
class _Frame:
    """What a picture shows: ``centre``, looked at from ``towards`` with ``up`` up; width and height in mm."""

    centre: FloatArray
    towards: FloatArray
    up: FloatArray
    width: float
    height: float

    def seen_from(self, sign: float) -> _Frame:
        return replace(self, towards=sign * self.towards)

    @property
    def pixels(self) -> tuple[int, int]:
        return _PIXELS, round(_PIXELS * self.height / self.width)


def _frame(points: FloatArray, front: FloatArray, up: FloatArray) -> _Frame:
    """The smallest frame, the same from in front and from behind, that shows all points with a margin."""
    axes = np.array([np.cross(up, front), up, front])
    seen = points @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    width, height, _ = 1.06 * (high - low)
    return _Frame((low + high) / 2 @ axes, front, up, float(max(width, 0.5 * height)), float(max(height, 0.5 * width)))


def _render(surface: Any, by_distance: bool, top: float, frame: _Frame) -> NDArray[np.uint8]:
    """A picture (height, width, 3) of ``surface``, by distance or by region, on white."""
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkLogger

    # without a display VTK first tries X11 and says that it is not there
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    plotter = pv.Plotter(off_screen=True, window_size=frame.pixels)
    plotter.set_background("white")
    look = {"smooth_shading": True, "split_sharp_edges": True, "feature_angle": 40.0, "ambient": 0.35, "diffuse": 0.75}
    if by_distance:
        plotter.add_mesh(surface, scalars="distance", cmap="viridis", clim=(0.0, top), show_scalar_bar=False, **look)
    else:
        colours = _region_colours(np.asarray(surface.cell_data["region"]))
        plotter.add_mesh(surface, scalars=colours, rgb=True, show_scalar_bar=False, **look)
    plotter.enable_parallel_projection()
    away = 5 * (frame.width + frame.height)
    plotter.camera_position = [tuple(frame.centre + away * frame.towards), tuple(frame.centre), tuple(frame.up)]
    plotter.camera.parallel_scale = frame.height / 2
    plotter.reset_camera_clipping_range()
    plotter.enable_anti_aliasing("ssaa")
    image = plotter.screenshot(return_img=True)
    plotter.close()
    return np.asarray(image)


def _region_colours(region: NDArray[Any]) -> NDArray[np.uint8]:
    from matplotlib.colors import to_rgb

    colour = np.tile(to_rgb(PLANE_COLOUR), (len(region), 1))
    for name, number in REGIONS.items():
        colour[region == number] = to_rgb(REGION_COLOURS[name])
    colour[is_ring(region)] = to_rgb(RING_COLOUR)
    return (255 * colour).astype(np.uint8)


def _scale_bar(axis: Any, frame: _Frame) -> None:
    length = 20.0 if frame.width > 30 else 5.0
    pixels = length / frame.width * _PIXELS
    right, below = 0.02 * _PIXELS, 1.04 * frame.pixels[1]
    axis.autoscale(False)
    axis.plot([right, right + pixels], [below, below], color="black", linewidth=2, solid_capstyle="butt", clip_on=False)
    axis.text(right + pixels + 10, below, f"{length:g} mm", ha="left", va="center", fontsize=8)


def _legends(figure: Any, grid: Any, top: float) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Patch

    patches = [Patch(color=colour, label=name) for name, colour in REGION_COLOURS.items()]
    patches += [Patch(color=RING_COLOUR, label="rings"), Patch(color=PLANE_COLOUR, label="valve planes")]
    left = figure.add_subplot(grid[2, :2])
    left.axis("off")
    left.legend(handles=patches, loc="lower left", ncols=4, fontsize=8, handlelength=1.2)
    right = figure.add_subplot(grid[2, 2])
    right.axis("off")
    bar = right.inset_axes((0.05, 0.55, 0.9, 0.22))
    figure.colorbar(ScalarMappable(Normalize(0.0, top), "viridis"), cax=bar, orientation="horizontal")
    bar.set_xlabel("displacement from ED (mm)")


def _main() -> None:
    os.environ.setdefault("PYVISTA_OFF_SCREEN", "true")
    try:
        for picture in draw(Path(sys.argv[1])):
            sys.stdout.write(f"{picture}\n")
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(1)


if __name__ == "__main__":
    _main()
