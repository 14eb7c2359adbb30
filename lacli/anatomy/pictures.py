"""Pictures of an anatomy: regions, fibres, thickness, the coordinate square, cut views. PNG, no display needed."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import (
    ENDO,
    EPI,
    OPENINGS,
    PLANE_COLOUR,
    PLANES,
    REGION_COLOURS,
    REGIONS,
    RING_COLOUR,
    RINGS,
    is_plane,
    is_ring,
    is_wall,
)
from lacli.geometry.surface import Surface

# off screen rendering must not look for an X server
os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")


# mostly ambient: shadows must not turn one colour of a legend into another
LIGHT = {"ambient": 0.5, "diffuse": 0.5, "specular": 0.0}


def polydata(surface: Surface) -> Any:
    """The surface as a VTK data set with its labels."""
    import pyvista as pv

    faces = np.column_stack([np.full(len(surface.triangles), 3), surface.triangles])
    mesh = pv.PolyData(surface.points, faces.ravel())
    mesh.cell_data["label"] = surface.label
    return mesh


def _boundary(bundle: Bundle, keep: NDArray[np.bool_]) -> Any:
    from lacli.anatomy.coordinates.describe import cell_label
    from lacli.geometry.subdivision import straight

    faces = bundle.triangles[keep]
    fine = straight(faces)
    repeat = len(fine) // max(len(faces), 1)
    label = np.repeat(cell_label(bundle, faces[:, :3]), repeat)
    return polydata(Surface(bundle.points, fine, label))


def views(bundle: Bundle) -> list[tuple[str, FloatArray, FloatArray]]:
    """Four looks at the atrium: name, direction to the camera, up; from its own openings, whatever the frame of the input."""
    centre = {}
    for name in OPENINGS:
        tris = bundle.triangles[bundle.tags == PLANES[name], :3]
        if len(tris):
            centre[name] = bundle.points[tris].reshape(-1, 3).mean(axis=0)
    return looks(centre)


def looks(centre: Mapping[str, FloatArray]) -> list[tuple[str, FloatArray, FloatArray]]:
    """As ``views``, from the centres (3,) of openings; a side with one vein has that one."""
    right, left_ones = ([centre[n] for n in pair if n in centre] for pair in (("rspv", "ripv"), ("lspv", "lipv")))
    if "mv" not in centre or not right or not left_ones:
        up, left = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    else:
        up = (np.mean(right, axis=0) + np.mean(left_ones, axis=0)) / 2 - centre["mv"]
        left = np.mean(left_ones, axis=0) - np.mean(right, axis=0)
    up = up / np.linalg.norm(up)
    left = left - (left @ up) * up
    left /= np.linalg.norm(left)
    back = np.cross(up, left)
    return [
        ("from the front", -back, up),
        ("from the back", back, up),
        ("from the left", left, up),
        ("from the right", -left, up),
        ("from above", up, -back),
        ("through the valve", -up, -back),
    ]


Panel = tuple[int, str, Callable[[Any], None]]


def _panels(file: Path, bundle: Bundle, panels: Sequence[Panel], columns: int, zoom: float = 0.82) -> None:
    """One picture of several looks at the bundle; a panel is a number in ``views``, its text, and what draws into it.

    ``zoom``: half of a panel's height over half of the bundle's diagonal.
    """
    import pyvista as pv

    sides = views(bundle)
    rows = -(-len(panels) // columns)
    plotter = pv.Plotter(off_screen=True, shape=(rows, columns), window_size=(620 * columns, 600 * rows), border=False)
    middle = (bundle.points.max(axis=0) + bundle.points.min(axis=0)) / 2
    reach = float(np.linalg.norm(np.ptp(bundle.points, axis=0)) / 2)
    for k, (look, text, draw) in enumerate(panels):
        _, direction, up = sides[look]
        plotter.subplot(k // columns, k % columns)
        plotter.set_background("white")
        draw(plotter)
        # at a point, not in a corner: there VTK scales each text on its own
        plotter.add_text(text, font_size=11, color="black", position=(0.02, 0.94), viewport=True)
        for bar in dict(plotter.scalar_bars).values():
            bar.SetTextPositionToPrecedeScalarBar()
        plotter.enable_parallel_projection()
        plotter.camera.focal_point = middle
        plotter.camera.position = middle + 5 * reach * direction
        plotter.camera.up = up
        plotter.camera.parallel_scale = zoom * reach
    shoot(plotter, file)


def _titled(bundle: Bundle, chosen: Sequence[int], title: str, draw: Callable[[Any], None]) -> list[Panel]:
    """The same drawing seen from several sides, the title over the first."""
    names = [name for name, _, _ in views(bundle)]
    return [(i, f"{title}, {names[i]}" if k == 0 else names[i], draw) for k, i in enumerate(chosen)]


def _bar(title: str) -> dict[str, Any]:
    # the blank line keeps the title clear of the numbers
    return {
        "title": f"\n{title}",
        "color": "black",
        "title_font_size": 16,
        "label_font_size": 14,
        "vertical": False,
        "height": 0.1,
    }


def shoot(plotter: Any, file: Path) -> None:
    """Write what the plotter shows, whole or not at all."""
    temporary = file.with_name(f".part-{os.getpid()}-{file.name}")
    plotter.screenshot(str(temporary))
    plotter.close()
    temporary.replace(file)


def regions(bundle: Bundle, file: Path) -> None:
    """Regions, rings and planes, six views."""
    surface = _boundary(bundle, bundle.tags != ENDO)
    label = np.asarray(surface.cell_data["label"])

    def draw(plotter: Any) -> None:
        groups = [(REGION_COLOURS[n], label == v) for n, v in REGIONS.items()]
        groups += [(RING_COLOUR, is_ring(label)), (PLANE_COLOUR, is_plane(label))]
        for colour, mine in groups:
            if mine.any():
                plotter.add_mesh(surface.extract_cells(mine), color=colour, smooth_shading=False, **LIGHT)

    _panels(file, bundle, _titled(bundle, range(6), "Regions", draw), 3)
    add_legend(file, {**REGION_COLOURS, "rings": RING_COLOUR, "planes of the openings": PLANE_COLOUR})


def add_legend(file: Path, colours: Mapping[str, str], below: Mapping[str, str] | None = None) -> None:
    """Put a legend in black letters under a picture; ``below``: a second line of it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch

    pixels = plt.imread(file)
    height, width = pixels.shape[:2]
    lines = [line for line in (below, colours) if line]  # from the bottom up
    room = 60 * len(lines)
    figure = plt.figure(figsize=(width / 150, (height + room) / 150), dpi=150)
    figure.figimage(pixels, 0, room)
    for k, line in enumerate(lines):
        handles = [Patch(facecolor=colour, edgecolor="black", linewidth=0.4, label=name) for name, colour in line.items()]
        place = (0.5, 60 * k / (height + room))
        figure.add_artist(
            figure.legend(handles=handles, loc="lower center", bbox_to_anchor=place, ncol=len(line), frameon=False, fontsize=10)
        )
    temporary = file.with_name(f".part-{os.getpid()}-{file.name}")
    figure.savefig(temporary)
    plt.close(figure)
    temporary.replace(file)


def fibres(bundle: Bundle, file: Path) -> None:
    """Fibres of the inner and the outer half of the wall as strokes."""
    import pyvista as pv

    if bundle.fibre is None or bundle.transmural is None:
        return
    fibre = bundle.fibre
    corner = bundle.tets[:, :4]
    centre = bundle.points[corner].mean(axis=1)
    depth = bundle.transmural[corner].mean(axis=1)
    wall = is_wall(bundle.region)
    halves = {"outer half of the wall": (wall & (depth >= 0.5), EPI), "inner half of the wall": (wall & (depth < 0.5), ENDO)}
    middle = (bundle.points.max(axis=0) + bundle.points.min(axis=0)) / 2
    size = float(np.median(np.linalg.norm(bundle.points[corner[:, 0]] - bundle.points[corner[:, 1]], axis=1)))

    def drawing(mine: NDArray[np.bool_], side: int, up: FloatArray, bar: bool) -> Callable[[Any], None]:
        rings = is_ring(bundle.tags) if side == EPI else is_plane(bundle.tags)
        skin = _boundary(bundle, (bundle.tags == side) | rings)
        f = fibre[mine]
        # strokes lie just over the skin, on the side of the camera only
        lift = (centre[mine] - middle) / np.linalg.norm(centre[mine] - middle, axis=1)[:, None] * 0.8
        ends = np.vstack([centre[mine] - 0.45 * size * f + lift, centre[mine] + 0.45 * size * f + lift])
        lines = np.column_stack([np.full(len(f), 2), np.arange(len(f)), len(f) + np.arange(len(f))])
        strokes = pv.PolyData(ends, lines=lines.ravel())
        strokes.cell_data["direction"] = np.abs(f @ up)
        style = {
            "cmap": "viridis",
            "clim": (0, 1),
            "line_width": 2.0,
            "scalar_bar_args": _bar("fibre along the valve-to-roof axis, cosine (-)"),
        }

        def draw(plotter: Any) -> None:
            plotter.add_mesh(skin, color="#f2e9e4", smooth_shading=True)
            plotter.add_mesh(strokes, scalars="direction", show_scalar_bar=bar, **style)

        return draw

    panels = []
    for half, (mine, side) in halves.items():
        for look, (name, _, up) in enumerate(views(bundle)[:3]):
            panels.append((look, f"{half}, {name}", drawing(mine, side, up, bar=side == ENDO and look == 2)))
    _panels(file, bundle, panels, 3)


def thickness(bundle: Bundle, ids: NDArray[np.int64], values: FloatArray, file: Path) -> None:
    """Wall thickness (mm) on the endocardium, four views."""
    tris = bundle.triangles[bundle.tags == ENDO, :3]
    mesh = polydata(Surface(bundle.points, tris, np.zeros(len(tris), dtype=np.int64)))
    field = np.full(len(bundle.points), np.nan)
    field[ids] = values
    mesh.point_data["thickness"] = field
    low, high = np.percentile(values, [1, 99])
    if high - low < 0.2:
        low, high = low - 0.1, high + 0.1

    def draw(plotter: Any) -> None:
        plotter.add_mesh(
            mesh,
            scalars="thickness",
            cmap="viridis",
            clim=(float(low), float(high)),
            smooth_shading=True,
            scalar_bar_args=_bar("wall thickness (mm)"),
            **LIGHT,
        )

    _panels(file, bundle, _titled(bundle, range(4), "Thickness (eikonal)", draw), 2)


def cuts(bundle: Bundle, file: Path) -> None:
    """Three cuts through the wall, coloured by transmural coordinate."""
    import pyvista as pv

    corner = bundle.tets[:, :4]
    cells = np.column_stack([np.full(len(corner), 4), corner])
    grid = pv.UnstructuredGrid(cells.ravel(), np.full(len(corner), pv.CellType.TETRA), bundle.points)
    depth = bundle.transmural if bundle.transmural is not None else np.zeros(len(bundle.points))
    grid.point_data["transmural"] = depth
    grid.cell_data["region"] = bundle.region
    origin = bundle.points[np.unique(bundle.cavity_triangles())].mean(axis=0)

    def drawing(direction: FloatArray, bar: bool) -> Callable[[Any], None]:
        # a little behind the section, which it would hide in patches
        half = grid.clip(normal=direction, origin=origin - 0.3 * direction, crinkle=False).extract_surface(
            algorithm="dataset_surface"
        )
        section = grid.slice(normal=direction, origin=origin)
        style = {"cmap": "coolwarm", "clim": (0, 1), "line_width": 1, "show_edges": True, "lighting": False}

        def draw(plotter: Any) -> None:
            plotter.add_mesh(half, color="#f2e9e4", opacity=1.0)
            args = _bar("depth in the wall (-): 0 inside, 1 outside")
            plotter.add_mesh(section, scalars="transmural", show_scalar_bar=bar, scalar_bar_args=args, **style)

        return draw

    sides = views(bundle)
    panels = [(i, f"cut, seen {sides[i][0]}", drawing(sides[i][1], bar=i == 4)) for i in (0, 2, 4)]
    _panels(file, bundle, panels, 3, zoom=0.75)


def square(bundle: Bundle, file: Path) -> None:
    """The endocardium in the square of universal coordinates, coloured by region."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Patch

    if bundle.uac is None:
        return
    from lacli.anatomy.coordinates.describe import ENDO as inner
    from lacli.anatomy.coordinates.describe import cell_label, layer_of

    layer = layer_of(bundle, inner)
    label = cell_label(bundle, bundle.triangles[layer.source, :3])
    corner = bundle.uac[layer.triangles]
    whole = np.ptp(corner, axis=1).max(axis=1) < 0.25
    names = {v: n for n, v in REGIONS.items()} | {v: "rings" for v in RINGS.values()}
    colour = [REGION_COLOURS.get(names[int(v)], RING_COLOUR) for v in label[whole]]
    figure, axis = plt.subplots(figsize=(6.4, 6.0), dpi=150)
    axis.add_collection(PolyCollection(list(corner[whole]), facecolors=colour, edgecolors="#00000030", linewidths=0.3))
    for name in OPENINGS[1:]:
        mine = layer.vessel == name
        if mine.any():
            x, y = bundle.uac[np.unique(layer.triangles[mine])].mean(axis=0)
            text = "LAA" if name == "appendage" else name.upper()
            axis.text(
                x, y, text, ha="center", va="center", fontsize=8, bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none"}
            )
    axis.set(xlim=(-0.01, 1.01), ylim=(-0.01, 1.01), aspect="equal")
    axis.set_xlabel("alpha (-): 0 septal, 1 lateral; triangles across these two lines are left out")
    axis.set_ylabel("beta (-): 0 posterior mitral rim, 1 anterior mitral rim")
    legend = [Patch(color=c, label=n) for n, c in REGION_COLOURS.items()] + [Patch(color=RING_COLOUR, label="rings")]
    axis.legend(
        handles=legend, loc="upper center", bbox_to_anchor=(0.5, 1.1), ncol=6, frameon=False, fontsize=8, handlelength=1.0
    )
    figure.tight_layout()
    temporary = file.with_name(f".part-{os.getpid()}-{file.name}")
    figure.savefig(temporary)
    plt.close(figure)
    temporary.replace(file)
