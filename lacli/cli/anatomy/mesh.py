"""``lacli mesh``: a label map or a surface to an anatomy bundle."""

from __future__ import annotations

import glob
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from lacli.base.errors import AnatomyError, StorageError, UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table, progress

STEPS = 6


def command(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="INPUT", help="Label map (.nrrd .nii .nii.gz .mha .mhd) or surface (.vtp .vtk .stl .ply .obj, CARP .elem)."
        ),
    ],
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
    from lacli.anatomy.build import Options
    from lacli.anatomy.inputs import meshfile
    from lacli.base.files import check_folder

    _check(cell_size_mm, thickness_mm, ring_width_mm, order, layers, frame)
    rules = ("laplace-dirichlet", "uac")
    own = None if fibres in rules else Path(fibres)
    if unit is not None and unit not in ("mm", "um", "cm", "m"):
        raise UsageError(f"--unit is '{unit}'; it must be mm, um, cm or m.")
    rule = rules[0] if own else fibres
    options = Options(cell_size_mm, thickness_mm, order, ring_width_mm, rule, smoothing_mm, layers, accept_low_confidence)
    check_folder(folder)
    _check_new(folder, also or [])
    own_fibres = None if own is None else meshfile.read_fibres(own)
    start = time.process_time()
    with progress() as bar:
        task = bar.add_task("reading", total=STEPS)

        def say(words: str) -> None:
            bar.update(task, advance=1, description=words)

        with naming(source):
            built = _build(source, la, lv, wall, options, landmarks_file, frame, say, unit)
        bundle = built.bundle
        if own_fibres is not None:
            bundle = replace(bundle, fibre=meshfile.carry_fibres(bundle, *own_fibres))
    with storing(folder):
        report = _save(source, folder, replace(built, bundle=bundle), options, also or [], start, str(own or fibres))
    drawn = _draw(folder) if pictures else []
    if as_json:
        print_json({**report, "folder": str(folder), "pictures": drawn})
    else:
        _show(report, folder, drawn)


def _check(cell: float, thickness: float, ring: float, order: int, layers: int | None, frame: str) -> None:
    for name, value, low, high in (
        ("--cell-size-mm", cell, 0.2, 10.0),
        ("--thickness-mm", thickness, 0.2, 8.0),
        ("--ring-width-mm", ring, 0.5, 10.0),
    ):
        if not low <= value <= high:
            raise UsageError(f"{name} is {value:g} mm; it must be {low:g} to {high:g} mm.")
    if order not in (1, 2):
        raise UsageError(f"--order is {order}; it must be 1 or 2.")
    if layers is not None and not 1 <= layers <= 20:
        raise UsageError(f"--layers is {layers}; it must be 1 to 20.")
    if frame not in ("lps", "ras", "unknown"):
        raise UsageError(f"--frame is '{frame}'; it must be lps, ras or unknown.")


@contextmanager
def naming(source: Path) -> Iterator[None]:
    """What is wrong with the anatomy, with the name of the file it is in."""
    try:
        yield
    except AnatomyError as error:
        if str(error).startswith(f"{source}:"):
            raise
        raise AnatomyError(f"{source}: {error}") from error


@contextmanager
def storing(folder: Path) -> Iterator[None]:
    """What the system says while writing, as a StorageError."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise StorageError(f"{folder}: cannot be written ({reason}: {error.filename}); nothing was left there.") from error


def _check_new(folder: Path, also: list[Path]) -> None:
    """Before the work: nothing else stands in the bundle's place, and the other files can be written."""
    from lacli.anatomy.inputs import meshfile
    from lacli.contracts.bundle import check_replaceable

    if folder.exists() and any(folder.iterdir()) and not (folder / "wall.vtu").is_file():
        raise UsageError(f"{folder}: the folder exists and holds something else than a bundle; choose another --out.")
    check_replaceable(folder)
    for path in also:
        meshfile.check_ending(path)
        if not path.absolute().parent.is_dir() or not os.access(path.absolute().parent, os.W_OK | os.X_OK):
            raise StorageError(f"{path}: cannot be written, its folder does not exist or gives no permission; change --also.")


def _build(
    source: Path,
    la: int | None,
    lv: int | None,
    wall: int | None,
    options: Any,
    file: Path | None,
    frame: str,
    say: Any,
    unit: str | None,
) -> Any:
    import numpy as np

    from lacli.anatomy import build
    from lacli.anatomy.inputs import anything, image, meshfile, surfacefile
    from lacli.anatomy.openings import landmarks

    meshfile.check_surface(source)
    given = None if file is None else landmarks.read(file)
    if image.is_image(source):
        labels = image.read_labels(source)
        volumes = image.label_volumes(labels)
        return build.from_labels(labels, la_label(source, volumes, la), lv, options, given, say, wall)
    if not anything.is_mesh(source):
        known = ", ".join((*image.SUFFIXES, *surfacefile.SUFFIXES, ".elem"))
        raise UsageError(f"{source}: the ending is not one of {known}.")
    mesh = anything.read(source)
    axes = {
        "lps": landmarks.LPS,
        "ras": landmarks.Axes(np.array([-1.0, 0, 0]), np.array([0, -1.0, 0]), np.array([0, 0, 1.0]), True),
        "unknown": None,
    }[frame]
    return build.from_mesh(mesh, options, given, axes, say, unit)


def la_label(source: Path, volumes: dict[int, float], la: int | None) -> int:
    if not volumes:
        raise AnatomyError(f"{source}: every voxel is 0; the label map is empty.")
    listing = ", ".join(f"{label} ({ml:.3g} mL)" for label, ml in sorted(volumes.items()))
    if la is not None:
        if la not in volumes:
            raise AnatomyError(f"{source}: label {la} has no voxel; the labels are {listing}.")
        return la
    if len(volumes) > 1:
        raise UsageError(
            f"{source}: several labels: {listing}. Say which is the left atrium's blood with --la "
            "(and the left ventricle's with --lv)."
        )
    return next(iter(volumes))


def _save(source: Path, folder: Path, built: Any, options: Any, also: list[Path], start: float, fibres: str) -> dict[str, Any]:
    """Write everything under a temporary name, then swap it in."""
    from lacli import __version__
    from lacli.anatomy import quality
    from lacli.anatomy.inputs import meshfile
    from lacli.anatomy.openings import landmarks
    from lacli.base.processes.locks import lock
    from lacli.contracts import bundle as contract

    report, _ = quality.measure(built.bundle)
    report["measures"] = built.measures
    report["notes"] = list(built.notes)
    report["openings"] = {
        name: {"diameter_mm": o.diameter_mm, "confidence": o.confidence, "source": o.source}
        for name, o in built.landmarks.openings.items()
    }
    report["cpu_s"] = time.process_time() - start
    info = {
        "source": str(source),
        "lacli": __version__,
        "frame": "as the input; images: LPS, mm",
        "options": {**options.__dict__, "fibres": fibres},
        "landmarks": {
            name: {"centre": o.centre.tolist(), "normal": o.normal.tolist()} for name, o in built.landmarks.openings.items()
        },
        "thickness_mm": report["thickness_mm"],
        "volumes_ml": {"cavity": report["cavity_volume_ml"], "wall": report["wall_volume_ml"], **report["region_volume_ml"]},
        "notes": report["notes"],
        **built.bundle.info,
    }
    done = replace(built.bundle, info=info)
    contract.check(done, str(folder))
    folder.absolute().parent.mkdir(parents=True, exist_ok=True)
    with lock(folder.with_name(f".lock-{folder.name}"), "which writes the same bundle"):
        for left in folder.parent.glob(f".*-*-{glob.escape(folder.name)}"):  # by a process that was killed: the lock is ours
            if left.name.startswith((".part-", ".old-")):
                shutil.rmtree(left, ignore_errors=True)
        part, old = (folder.with_name(f".{word}-{os.getpid()}-{folder.name}") for word in ("part", "old"))
        try:
            part.mkdir()
            contract.save(done, part)
            landmarks.write(built.landmarks, part / "landmarks.toml")
            quality.write(report, part)
            if folder.exists():
                folder.replace(old)
            part.replace(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
    for path in also:
        meshfile.write(done, path)
    return report


def _draw(folder: Path) -> list[str]:
    """Pictures in a process of their own: a broken graphics driver must not end the command."""
    from lacli.base.processes.process import answer_of

    try:
        done = answer_of([sys.executable, "-m", "lacli.anatomy.quality", str(folder)], timeout_s=300)
    except subprocess.TimeoutExpired:
        err.print("The pictures took longer than five minutes and were left out.")
        return []
    drawn = [line for line in done.stdout.splitlines() if line.endswith(".png")]
    if done.returncode != 0:
        err.print(
            f"Some pictures could not be drawn: {', '.join(drawn) or 'none'} are there (VTK needs EGL, OSMesa or an X server)."
        )
    return drawn


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
