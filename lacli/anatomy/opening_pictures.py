"""Openings with their names, from four standard views: of a bundle, and of a surface whose names are not certain."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.openings.landmarks import Landmarks, Opening
from lacli.anatomy.pictures import LIGHT, add_legend, looks, polydata, shoot
from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import EPI, OPENINGS, PLANES, REGION_COLOURS, REGIONS, RING_COLOUR, is_ring, is_wall
from lacli.geometry.surface import Surface

# right blue, left red, the superior ones dark: a swap is seen without reading
COLOURS = {
    "mv": "#8a8a8a",
    "rspv": "#12338f",
    "ripv": "#6fa8ff",
    "lspv": "#a01010",
    "lipv": "#ff8c7a",
    "appendage": "#1a9641",
}
FURTHER = "#c9a400"
FACING = -0.15  # cosine to the camera from which on an opening's name is written
SIDE_PIXELS, SMALL_PIXELS = 560, 440  # of one view: of a bundle, and of several readings at once

Draw = Callable[[Any], None]


def short(name: str) -> str:
    """As people write it."""
    return "LAA" if name == "appendage" else name.upper()


def bundle_picture(bundle: Bundle, file: Path) -> None:
    """Regions, fibres as strokes, and openings with their names, four views."""
    import pyvista as pv

    from lacli.anatomy.coordinates.describe import cell_label

    skin = bundle.triangles[(bundle.tags == EPI) | is_ring(bundle.tags), :3]
    label = cell_label(bundle, skin)
    outside = polydata(Surface(bundle.points, skin, label))
    openings = {}
    for name in OPENINGS:
        mine = bundle.triangles[bundle.tags == PLANES[name], :3]
        if len(mine):
            corner = bundle.points[mine]
            normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(axis=0)
            out = corner.mean(axis=(0, 1)) - bundle.points.mean(axis=0)
            normal = normal * np.sign(normal @ out) / max(float(np.linalg.norm(normal)), 1e-12)
            area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
            openings[name] = Opening(
                name, corner.mean(axis=(0, 1)), normal, corner.mean(axis=(0, 1)), float(2 * np.sqrt(area / np.pi)), 1.0, ""
            )
    strokes = None
    if bundle.fibre is not None and bundle.transmural is not None:
        corner = bundle.points[bundle.tets[:, :4]]
        outer = is_wall(bundle.region) & (bundle.transmural[bundle.tets[:, :4]].mean(axis=1) >= 0.5)
        outer &= np.arange(len(outer)) % 2 == 0
        middle, fibre = corner[outer].mean(axis=1), bundle.fibre[outer]
        away = middle - bundle.points.mean(axis=0)
        middle = middle + 1.2 * away / np.linalg.norm(away, axis=1)[:, None]
        n = len(middle)
        lines = np.column_stack([np.full(n, 2), np.arange(n), n + np.arange(n)])
        strokes = pv.PolyData(np.vstack([middle - 1.3 * fibre, middle + 1.3 * fibre]), lines=lines.ravel())

    def draw(plotter: Any) -> None:
        for name, value in REGIONS.items():
            if (label == value).any():
                plotter.add_mesh(outside.extract_cells(label == value), color=REGION_COLOURS[name], **LIGHT)
        if is_ring(label).any():
            plotter.add_mesh(outside.extract_cells(is_ring(label)), color=RING_COLOUR, **LIGHT)
        if strokes is not None:
            plotter.add_mesh(strokes, color="#303030", line_width=1.0, lighting=False)

    rows = [("Openings, regions, fibres of the outer half", openings, draw)]
    _grid(file, bundle.points, rows, columns=2)
    here = {short(n): COLOURS[n] for n in openings}
    add_legend(file, {**REGION_COLOURS, "rings": RING_COLOUR}, {**here, "fibre": "#303030"})


def readings_picture(surface: Surface, readings: Sequence[tuple[str, Landmarks]], file: Path) -> None:
    """The surface with the openings of each reading, a row of four views each."""
    mesh = polydata(surface)

    def draw(plotter: Any) -> None:
        plotter.add_mesh(mesh, color="#efe6df", smooth_shading=True, **LIGHT)

    _grid(file, surface.points, [(title, marks.openings, draw) for title, marks in readings], columns=4)
    names = {n for _, marks in readings for n in marks.openings}
    add_legend(file, {short(n): COLOURS.get(n, FURTHER) for n in (*OPENINGS, *sorted(names - set(OPENINGS))) if n in names}, {})


def draw_readings(surface: Surface, readings: Sequence[tuple[str, Landmarks]], file: Path) -> bool:
    """``readings_picture`` in a process of its own (a broken graphics driver must not end the caller); whether it was drawn."""
    from lacli.base.processes.process import answer_of

    with tempfile.TemporaryDirectory() as place:
        data = Path(place) / "surface.npz"
        listing = [[title, [_plain(o) for o in marks.openings.values()]] for title, marks in readings]
        np.savez(data, points=surface.points, triangles=surface.triangles, readings=np.array(json.dumps(listing)))
        try:
            done = answer_of([sys.executable, "-m", "lacli.anatomy.opening_pictures", str(data), str(file)], timeout_s=120)
        except Exception:  # whatever stops a picture, the message it belongs to comes first
            return False
        return done.returncode == 0 and file.is_file()


def _plain(o: Opening) -> list[Any]:
    return [o.name, o.centre.tolist(), o.normal.tolist(), o.beyond.tolist(), o.diameter_mm]


def _grid(file: Path, points: FloatArray, rows: Sequence[tuple[str, Mapping[str, Opening], Draw]], columns: int) -> None:
    """Four views of each row in ``columns`` columns."""
    import pyvista as pv

    deep = 4 // columns
    side = SIDE_PIXELS if len(rows) == 1 else SMALL_PIXELS
    window = (side * columns, side * deep * len(rows))
    plotter = pv.Plotter(off_screen=True, shape=(deep * len(rows), columns), window_size=window, border=False)
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    reach = float(np.linalg.norm(np.ptp(points, axis=0)) / 2)
    for r, (title, openings, draw) in enumerate(rows):
        centres = {n: o.centre for n, o in openings.items()}
        for k, (words, direction, up) in enumerate(looks(centres)[:4]):
            plotter.subplot(r * deep + k // columns, k % columns)
            plotter.set_background("white")
            draw(plotter)
            _mark(plotter, openings, direction)
            lines = [title, words] if k == 0 else [words]
            for line, text in enumerate(lines):
                height = 0.94 - 0.05 * line
                plotter.add_text(text, font_size=10, color="black", position=(0.02, height), viewport=True, name=f"line {line}")
            plotter.enable_parallel_projection()
            plotter.camera.focal_point = middle
            plotter.camera.position = middle + 5 * reach * direction
            plotter.camera.up = up
            plotter.camera.parallel_scale = 0.9 * reach
    shoot(plotter, file)


def _mark(plotter: Any, openings: Mapping[str, Opening], direction: FloatArray) -> None:
    """A coloured disc at each opening, and the names of those that look to the camera."""
    import pyvista as pv

    for name, opening in openings.items():
        disc = pv.Disc(
            center=opening.centre + 0.6 * opening.normal,
            normal=opening.normal,
            inner=0.0,
            outer=max(0.5 * opening.diameter_mm, 3.0),
            c_res=40,
        )
        plotter.add_mesh(disc, color=COLOURS.get(name, FURTHER), lighting=False)
        if opening.normal @ direction > FACING:
            plotter.add_point_labels(
                (opening.centre + 3.0 * opening.normal)[None],
                [short(name)],
                font_size=18,
                bold=True,
                text_color=COLOURS.get(name, FURTHER),
                shape_color="white",
                shape_opacity=0.85,
                show_points=False,
                always_visible=True,
            )


if __name__ == "__main__":
    with np.load(sys.argv[1], allow_pickle=False) as kept:
        wall = Surface(kept["points"], kept["triangles"], np.zeros(len(kept["triangles"]), dtype=np.int64))
        rows_ = json.loads(str(kept["readings"]))
    marks_ = []
    for title_, listed_ in rows_:
        openings_ = {}
        for name_, centre_, normal_, beyond_, width_ in listed_:
            openings_[name_] = Opening(
                name_, np.array(centre_), np.array(normal_), np.array(beyond_), float(width_), 1.0, "given"
            )
        marks_.append((str(title_), Landmarks(openings_)))
    readings_picture(wall, marks_, Path(sys.argv[2]))
