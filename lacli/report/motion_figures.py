"""Pictures of a tracked motion: transients with phases and bands, surfaces by displacement, contours on slices, an animation.

``python -m lacli.report.motion_figures FOLDER BUNDLE [IMAGES...]`` draws what FOLDER has data for; ``draw_apart`` does so in a
process of its own, because a graphics library without a working driver may end the whole process.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lacli.base import vtkxml
from lacli.base.arrays import FloatArray
from lacli.base.documents import read_json
from lacli.base.errors import LacliError
from lacli.base.files import replacing
from lacli.contracts.labels import BODY_REGIONS, REGION_COLOURS
from lacli.motion.store import PICTURES
from lacli.report.style import paper

TRANSIENTS, SURFACES, SLICES, ANIMATION = PICTURES
_COMPONENTS = {
    "d_{}_mm": "|u| (mm)",
    "n_{}_mm": "normal (mm)",
    "a_{}_mm": "alpha (mm)",
    "b_{}_mm": "beta (mm)",
    "area_strain_{}": "area strain",
}
_HU = (-150.0, 500.0)
_PIXELS = 480


def draw(folder: Path, bundle: Path, images: Sequence[Path]) -> list[Path]:
    """Draw into the folder what it has data for."""
    drawn = [transients(folder, folder / TRANSIENTS)]
    if images:
        drawn.append(slices(folder, list(images), folder / SLICES))
    drawn.append(surfaces(folder, folder / SURFACES))
    drawn.append(animation(folder, folder / ANIMATION))
    return drawn


def draw_apart(folder: Path, bundle: Path, images: Sequence[str]) -> tuple[list[Path], str]:
    """As ``draw``, in a process of its own: the pictures, and what went wrong ('' if nothing)."""
    command = [sys.executable, "-m", __name__, str(folder), str(bundle), *images]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, timeout=600)
    except subprocess.TimeoutExpired:
        return [], "drawing took more than 600 s"
    drawn = [Path(line) for line in answer.stdout.splitlines() if line.endswith((".png", ".gif"))]
    trouble = "" if answer.returncode == 0 else (answer.stderr.strip().splitlines() or [f"code {answer.returncode}"])[-1]
    return drawn, trouble


def transients(folder: Path, picture: Path) -> Path:
    """Volume (mL) and regional features against time, phases shaded, a band of 2 sd around each course."""
    frame = pd.read_csv(folder / "transients.csv")
    info = read_json(folder / "tracking.json")
    phases = info["phases"]
    fine = np.linspace(0.0, 1.0, 201)
    with paper():
        import matplotlib.pyplot as plt

        from lacli.motion.errors import courses

        rows = [p for p in _COMPONENTS if p.format("roof") in frame]
        figure, axes = plt.subplots(len(rows) + 1, 1, figsize=(5.2, 1.7 * (len(rows) + 1)), sharex=True)

        def course(axis: Any, key: str, colour: str, label: str | None) -> None:
            line, spread = courses.course(frame, info, key, fine)
            reach = 2.0 * spread
            axis.fill_between(fine, line - reach, line + reach, color=colour, alpha=0.18, linewidth=0)
            axis.plot(fine, line, color=colour, linewidth=1.2, label=label)
            axis.plot(frame["time"], frame[key], "o", color=colour, markersize=2.5)

        course(axes[0], "volume_ml", "black", None)
        axes[0].set_ylabel("volume (mL)")
        for axis, pattern in zip(axes[1:], rows, strict=True):
            for region in BODY_REGIONS:
                if pattern.format(region) in frame:
                    course(axis, pattern.format(region), REGION_COLOURS[region], region)
            axis.set_ylabel(_COMPONENTS[pattern])
        _shade(axes, phases)
        axes[-1].set_xlabel("time (fraction of the RR interval); bands: 2 sd")
        axes[-1].set_xlim(0.0, 1.0)
        axes[-1].legend(ncols=5, loc="upper center", bbox_to_anchor=(0.5, -0.45), columnspacing=1.0, handlelength=1.2)
        with replacing(picture) as temporary:
            figure.savefig(temporary)
        plt.close(figure)
    return picture


def _shade(axes: Any, phases: dict[str, float]) -> None:
    spans = [
        ("reservoir", 0.0, phases["es"]),
        ("conduit", phases["es"], phases["conduit_end"]),
        ("diastasis", phases["conduit_end"], phases["booster_start"]),
        ("booster", phases["booster_start"], 1.0),
    ]
    for number, (name, start, end) in enumerate(spans):
        if end - start < 0.01:
            continue
        for axis in axes:
            if number % 2 == 0:
                axis.axvspan(start, end, color="0.95", zorder=0, linewidth=0)
            axis.axvline(phases["es"], color="0.4", linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
        axes[0].text((start + end) / 2, 1.03, name, transform=axes[0].get_xaxis_transform(), ha="center", fontsize=8)


def _series(folder: Path) -> list[Any]:
    from lacli.motion.frames import by_number

    return [vtkxml.read(path) for path in by_number((folder / "frames").glob("frame_*.vtp"))]


def _es_frame(folder: Path) -> int:
    info = read_json(folder / "tracking.json")
    return int(np.argmin(np.abs(np.array(info["times"]) - info["phases"]["es"])))


def surfaces(folder: Path, picture: Path) -> Path:
    """The end-diastolic surface by displacement and its components at the frame nearest ES, from in front and from behind."""
    import pyvista as pv

    mesh = _series(folder)[_es_frame(folder)]
    moved = np.asarray(mesh.point_data["displacement"])
    mesh.points = np.asarray(mesh.points) - moved
    shown: list[tuple[str, FloatArray, str]] = [("|u|, mm", np.linalg.norm(moved, axis=1), "viridis")]
    for name in ("normal_mm", "alpha_mm", "beta_mm"):
        if name in mesh.point_data:
            shown.append((name.replace("_mm", ", mm"), np.asarray(mesh.point_data[name]), "RdBu_r"))
    plotter = pv.Plotter(off_screen=True, shape=(2, len(shown)), window_size=(_PIXELS * len(shown), 2 * _PIXELS), border=False)
    for column, (title, values, colours) in enumerate(shown):
        limit = float(np.percentile(np.abs(values), 99)) or 1.0
        for row, side in enumerate((-1, 1)):
            plotter.subplot(row, column)
            copy = mesh.copy()
            copy.point_data[title] = values
            plotter.add_mesh(
                copy, scalars=title, cmap=colours, clim=(0.0 if column == 0 else -limit, limit), smooth_shading=True,
                show_scalar_bar=row == 1,
                scalar_bar_args={"title": title, "vertical": False, "color": "black", "title_font_size": 22},
            )  # fmt: skip
            _look(plotter, mesh, side)
            if column == 0:
                plotter.add_text("from in front" if side < 0 else "from behind", font_size=10, color="black")
    plotter.set_background("white")
    with replacing(picture) as temporary:
        plotter.screenshot(str(temporary))
    plotter.close()
    return picture


def _look(plotter: Any, mesh: Any, side: int) -> None:
    """Axes are LPS: y to the back, z to the head."""
    centre = np.asarray(mesh.center)
    plotter.camera_position = [tuple(centre + np.array([0.0, side * 260.0, 0.0])), tuple(centre), (0.0, 0.0, 1.0)]
    plotter.camera.zoom(1.7)


def animation(folder: Path, picture: Path) -> Path:
    """The beating surface by displacement, from in front, as a GIF; cubic in time between the frames."""
    import pyvista as pv
    from scipy.interpolate import CubicSpline

    meshes = _series(folder)
    times = np.array(read_json(folder / "tracking.json")["times"])
    points = np.stack([np.asarray(m.points, dtype=np.float64) for m in meshes])
    spline = CubicSpline(np.append(times, 1.0), np.concatenate([points, points[:1]]), axis=0, bc_type="periodic")
    most = float(np.linalg.norm(points - points[0], axis=2).max()) or 1.0
    mesh = meshes[0].copy()
    mesh.point_data["|u|, mm"] = np.zeros(mesh.n_points)
    plotter = pv.Plotter(off_screen=True, window_size=(_PIXELS, _PIXELS))
    plotter.set_background("white")
    plotter.add_mesh(mesh, scalars="|u|, mm", cmap="viridis", clim=(0.0, most), smooth_shading=False)
    plotter.add_mesh(meshes[0], style="wireframe", color="gray", opacity=0.12)
    _look(plotter, meshes[0], -1)
    shots = []
    for moment in np.linspace(0.0, 1.0, 21)[:-1]:
        mesh.points = spline(moment)
        mesh.point_data["|u|, mm"] = np.linalg.norm(mesh.points - points[0], axis=1)
        plotter.render()
        shots.append(np.asarray(plotter.screenshot(return_img=True)))
    plotter.close()
    from PIL import Image as Picture

    pictures = [Picture.fromarray(shot) for shot in shots]
    with replacing(picture) as temporary:
        pictures[0].save(temporary, save_all=True, append_images=pictures[1:], duration=80, loop=0)
    return picture


def slices(folder: Path, images: list[Path], picture: Path) -> Path:
    """The tracked contour on an axial, a coronal and a sagittal slice of every frame; dashed: where end-diastole's was."""
    from lacli.motion import frames as framing

    meshes = _series(folder)
    centre = np.asarray(meshes[0].center)
    low, high = np.array(meshes[0].bounds).reshape(3, 2).T
    sources = framing.find(images)[: len(meshes)]
    with paper():
        import matplotlib.pyplot as plt

        count = len(meshes)
        figure, axes = plt.subplots(3, count, figsize=(1.6 * count, 4.8), squeeze=False)
        for column, (source, mesh) in enumerate(zip(sources, meshes, strict=True)):
            image = framing.read(source)
            for row in range(3):
                axis = axes[row, column]
                a, b = ((0, 1), (0, 2), (1, 2))[row]
                fixed = 3 - a - b
                grid = [np.arange(low[i] - 12.0, high[i] + 12.0, 0.7) for i in (a, b)]
                x, y = np.meshgrid(*grid)
                places = np.empty((x.size, 3))
                places[:, a], places[:, b], places[:, fixed] = x.ravel(), y.ravel(), centre[fixed]
                shown = framing.sample(image, places).reshape(x.shape)
                flip = row == 0  # axial: y grows to the back, drawn downwards
                axis.imshow(
                    shown, cmap="gray", vmin=_HU[0], vmax=_HU[1], origin="lower", interpolation="bilinear",
                    extent=(grid[0][0], grid[0][-1], grid[1][0], grid[1][-1]),
                )  # fmt: skip
                if flip:
                    axis.invert_yaxis()
                normal = np.eye(3)[fixed]
                for contour, style in ((meshes[0], {"color": "#56B4E9", "linestyle": "--"}), (mesh, {"color": "#E69F00"})):
                    _contour(axis, contour.slice(normal=normal, origin=centre), a, b, style)
                axis.set_xticks([])
                axis.set_yticks([])
                if row == 0:
                    axis.set_title(f"frame {column}", fontsize=8)
                if column == 0:
                    axis.set_ylabel(("axial", "coronal", "sagittal")[row])
        with replacing(picture) as temporary:
            figure.savefig(temporary, dpi=150)
        plt.close(figure)
    return picture


def _contour(axis: Any, cut: Any, a: int, b: int, style: dict[str, Any]) -> None:
    from matplotlib.collections import LineCollection

    lines = np.asarray(cut.lines).reshape(-1, 3)[:, 1:]
    points = np.asarray(cut.points)[:, [a, b]]
    axis.add_collection(
        LineCollection(list(points[lines]), linewidths=0.8, colors=style["color"], linestyles=style.get("linestyle", "-"))
    )


def main(arguments: list[str]) -> int:
    """Draw and print the pictures' names."""
    folder, bundle, *images = (Path(a) for a in arguments)
    try:
        for path in draw(folder, bundle, images):
            sys.stdout.write(f"{path}\n")
    except LacliError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
