"""``lacli mesh``: a label map or a surface to an anatomy bundle."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lacli.api import anatomy
from lacli.base.errors import UsageError
from lacli.cli.terminal.console import err, one_bar, out, print_json, print_table


def command(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="INPUT", help="Label map (.nrrd .nii .nii.gz .mha .mhd) or surface (.vtp .vtk .stl .ply .obj, CARP .elem)."
        ),
    ] = None,
    folder: Annotated[Path, typer.Option("--out", "-o", help="Folder of the bundle.")] = Path("anatomy"),
    la: Annotated[
        int | None, typer.Option("--la", help="Label of the left atrium's blood; needed if the map has several labels.")
    ] = None,
    lv: Annotated[
        int | None, typer.Option("--lv", help="Label of the left ventricle's blood; its contact gives the mitral plane.")
    ] = None,
    wall: Annotated[
        int | None, typer.Option("--wall", help="Label of the atrial wall; without it the wall has the thickness below.")
    ] = None,
    labels: Annotated[
        str | None,
        typer.Option("--labels", help="All labels at once: la=2,lv=3,wall=9,laa=61,pv=53 (or rspv=, ripv=, lspv=, lipv=)."),
    ] = None,
    preset: Annotated[
        str | None, typer.Option("--preset", help="Labels by the name of a published set; --presets prints them.")
    ] = None,
    presets: Annotated[bool, typer.Option("--presets", help="Print the sets that --preset knows, and end.")] = False,
    cell_size_mm: Annotated[
        float,
        typer.Option("--cell-size-mm", help="Edge length of the cells, mm; how accuracy and cost depend on it: README."),
    ] = 3.5,
    thickness_mm: Annotated[float, typer.Option("--thickness-mm", help="Uniform wall thickness, mm.")] = 2.0,
    order: Annotated[
        int, typer.Option("--order", help="1: straight cells; 2: 10-node cells, edge middles on the smooth surface.")
    ] = 2,
    layers: Annotated[
        int | None, typer.Option("--layers", help="Cells through the wall; default: thickness over cell size, at least 1.")
    ] = None,
    ring_width_mm: Annotated[float, typer.Option("--ring-width-mm", help="Width of the rings along the cuts, mm.")] = 2.5,
    smoothing_mm: Annotated[
        float | None, typer.Option("--smoothing-mm", help="Smoothing of the voxels, mm; default 1.25 coarsest spacings.")
    ] = None,
    wave_mm: Annotated[
        float | None,
        typer.Option(
            "--wave-mm",
            help="Shorter waves of the wall's surface are taken out, mm; 0: none. Default: 6.5 voxels of a label map, within "
            "8 to 12 mm; of a surface none.",
        ),
    ] = None,
    landmarks_file: Annotated[Path | None, typer.Option("--landmarks", help="landmarks.toml; what stands there wins.")] = None,
    fibres: Annotated[
        str,
        typer.Option(
            "--fibres", help="'laplace-dirichlet', 'uac', or a file with fibres of your own (.lon with .pts/.elem, .vtk, .vtu)."
        ),
    ] = "laplace-dirichlet",
    frame: Annotated[
        str, typer.Option("--frame", help="Axes of a surface: 'lps', 'ras', or 'unknown' (told from the shape).")
    ] = "unknown",
    unit: Annotated[
        str | None, typer.Option("--unit", help="Unit of a mesh file: 'mm', 'um', 'cm' or 'm'; default: told from its size.")
    ] = None,
    accept_low_confidence: Annotated[
        bool, typer.Option("--accept-low-confidence", help="Go on where the names of the openings are not certain.")
    ] = False,
    also: Annotated[
        list[Path] | None,
        typer.Option("--also", help="Write the wall to this file too (.pts CARP, .vtk, .vtu, .msh); repeatable."),
    ] = None,
    pictures: Annotated[bool, typer.Option(help="Draw regions, fibres, thickness, cuts and the coordinate square.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
) -> None:
    """Turn a label map or a surface into an anatomy bundle that `lacli simulate` takes.

    Images are in ITK's LPS millimetres. The openings found are written to landmarks.toml in the bundle's folder: look at
    the pictures, edit it, and give it back with --landmarks.

    Example: lacli mesh heart.nii.gz --la 2 --lv 3 --cell-size-mm 4 --out anatomy
    """
    if presets:
        _show_presets(as_json)
        return
    if source is None:
        raise UsageError("give an INPUT: a label map or a surface. `lacli mesh --help` says which files are read.")
    with one_bar("reading") as show:
        made = anatomy.mesh(
            source, folder, la=la, lv=lv, wall=wall, labels=labels, preset=preset,
            cell_size_mm=cell_size_mm, thickness_mm=thickness_mm, order=order, layers=layers,
            ring_width_mm=ring_width_mm, smoothing_mm=smoothing_mm, wave_mm=wave_mm, landmarks=landmarks_file, fibres=fibres,
            frame=frame, unit=unit, accept_low_confidence=accept_low_confidence, also=also or (), figures=pictures, progress=show,
        )  # fmt: skip
    for text in made.warnings:
        err.print(text)
    if as_json:
        print_json({**made.report, "folder": str(folder), "pictures": list(made.pictures)})
    else:
        _show(made.report, folder, list(made.pictures))


def _show_presets(as_json: bool) -> None:
    from lacli.anatomy.inputs.labelled import PRESETS

    if as_json:
        print_json({name: {"labels": labels, "of": of} for name, (labels, of) in PRESETS.items()})
        return
    for name, (labels, of) in PRESETS.items():
        out.print(f"{name}: {labels}\n    {of}", highlight=False, soft_wrap=True)


def _show(report: dict[str, Any], folder: Path, drawn: list[str]) -> None:
    rows = [[n, f"{o['diameter_mm']:.1f}", f"{o['confidence']:.2f}", o["source"]] for n, o in report["openings"].items()]
    print_table("Openings", ["name", "diameter (mm)", "confidence (-)", "source"], rows)
    rows = [
        [n, f"{t['eikonal']:.2f}", f"{t['laplace']:.2f}", f"{report['region_volume_ml'].get(n, 0.0):.2f}"]
        for n, t in report["thickness_mm"].items()
    ]
    print_table("Regions", ["region", "thickness, eikonal (mm)", "thickness, Laplace (mm)", "wall volume (mL)"], rows)
    out.print(
        f"cavity {report['cavity_volume_ml']:.2f} mL, {report['cells']} cells, "
        f"smallest scaled Jacobian {report['scaled_jacobian_min']:.3f}, "
        f"{100 * report['scaled_jacobian_share_below_0.2']:.2f} % below 0.2, {report['cpu_s']:.0f} s",
        highlight=False,
    )
    for note in report["notes"]:
        out.print(f"note: {note}", highlight=False)
    doubtful = [n for n, o in report["openings"].items() if o["confidence"] < 0.6]
    if doubtful:
        err.print(
            f"Look at {', '.join(doubtful)}: found with little confidence. "
            f"Correct {folder / 'landmarks.toml'} and give it back with --landmarks."
        )
    out.print(
        f"written: {folder} ({', '.join(['wall.vtu', 'boundary.vtp', 'anatomy.json', 'landmarks.toml', 'quality.txt', *drawn])})",
        highlight=False,
    )
