"""``lacli fat``: epicardial fat in a CT volume."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from lacli.base.errors import AnatomyError, UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table, progress


def command(
    ct: Annotated[Path, typer.Argument(metavar="CT", help="CT volume in Hounsfield units (.nrrd .nii .nii.gz .mha).")],
    bundle: Annotated[
        Path | None,
        typer.Option("--anatomy", help="Bundle of the same patient: its cavity is the blood pool, its regions count."),
    ] = None,
    labels: Annotated[
        Path | None, typer.Option("--labels", help="Label map of the same patient: its label --la is the blood pool.")
    ] = None,
    la: Annotated[int | None, typer.Option("--la", help="Label of the left atrium's blood in --labels.")] = None,
    reach_mm: Annotated[float, typer.Option("--within-mm", help="How far from the blood pool fat counts, mm.")] = 5.0,
    folder: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for fat.vtp (surface), fat.vtu (voxels with regions), fat.json.")
    ] = Path("fat"),
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
) -> None:
    """Segment epicardial fat around the atrium's blood pool; volume per region, in both published windows, and its mesh.

    Voxels at the border count by their share of fat; the plain count of voxels in the window is given beside it.

    Example: lacli fat ct.nii.gz --anatomy anatomy --labels heart.nii.gz --la 2 --out fat
    """
    from lacli.anatomy.inputs import image
    from lacli.anatomy.meshing import naming, storing
    from lacli.anatomy.wall import fat
    from lacli.base.files import check_folder
    from lacli.contracts.bundle import load

    if bundle is None and labels is None:
        raise UsageError(
            "Give the blood pool: --anatomy BUNDLE, or --labels MAP with --la LABEL, or both (regions come from the bundle)."
        )
    if not 0.5 <= reach_mm <= 20.0:
        raise UsageError(f"--within-mm is {reach_mm:g} mm; it must be 0.5 to 20 mm.")
    check_folder(folder)
    with progress() as bar:
        task = bar.add_task("reading", total=2 + len(fat.WINDOWS))
        volume = image.read(ct)
        anatomy = None if bundle is None else load(bundle)
        bar.update(task, advance=1, description="blood pool")
        pool, notes = _pool(labels, la, anatomy)
        notes = [*(f"{ct}: {note}" for note in volume.doubts(pool.points.mean(axis=0))), *notes]
        found = {}
        for window in fat.WINDOWS:
            bar.update(task, advance=1, description=f"fat, {window} window")
            with naming(ct):
                found[window] = fat.segment(volume, pool, anatomy, window, reach_mm)
        bar.update(task, advance=1, description="mesh")
        with storing(folder):
            report = _save(found, folder, ct, reach_mm, notes)
    for note in notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    if as_json:
        print_json({**report, "folder": str(folder)})
        return
    names = list(next(iter(found.values())).per_region_ml)
    rows = [
        [
            f"{w} {fat.WINDOWS[w][0]:.0f} .. {fat.WINDOWS[w][1]:.0f} HU",
            f.volume_ml,
            f.window_ml,
            *[f.per_region_ml[n] for n in names],
        ]
        for w, f in found.items()
    ]
    print_table("Epicardial fat", ["window", "fat (mL)", "voxels in window (mL)", *[f"{n} (mL)" for n in names]], rows)
    out.print(f"written: {folder} ({', '.join(report['files'])})", highlight=False)


def _pool(labels: Path | None, la: int | None, anatomy: Any) -> tuple[Any, list[str]]:
    """The blood pool's surface, and notes on its image."""
    import numpy as np

    from lacli.anatomy.inputs import extraction, image
    from lacli.geometry.surface import Surface, compact

    if labels is not None:
        from lacli.anatomy.meshing import la_label, naming

        map_ = image.read_labels(labels)
        with naming(labels):
            label = la_label(labels, image.label_volumes(map_), la)
            blood = extraction.blood_pool(map_, label)
            return extraction.surface_of(blood.mask), [f"{labels}: {note}" for note in blood.notes]
    from lacli.geometry.subdivision import straight

    triangles = straight(anatomy.cavity_triangles())[:, ::-1].copy()
    return compact(Surface(anatomy.points, triangles, np.zeros(len(triangles), dtype=np.int64))), []


def _save(found: dict[str, Any], folder: Path, ct: Path, reach: float, notes: list[str]) -> dict[str, Any]:
    import json

    import meshio

    from lacli.anatomy import pictures
    from lacli.anatomy.wall import fat

    standard = found["standard"]
    if not standard.mask.array.any():
        raise AnatomyError(f"{ct}: no fat within {reach:g} mm of the blood pool; do CT and blood pool share a frame (LPS mm)?")
    report: dict[str, Any] = {
        "ct": str(ct),
        "within_mm": reach,
        "notes": notes,
        "windows": {
            w: {
                "hu": list(fat.WINDOWS[w]),
                "fat_ml": f.volume_ml,
                "voxels_in_window_ml": f.window_ml,
                "per_region_ml": f.per_region_ml,
            }
            for w, f in found.items()
        },
    }
    points, cells, region = fat.cells(standard)
    surface = pictures.polydata(fat.surface_of(standard))
    voxels = meshio.Mesh(points, [("hexahedron", cells)], cell_data={"region": [region.astype("int32")]})
    report["files"] = ["fat.vtu", "fat.vtp", "fat.json"]
    folder.mkdir(parents=True, exist_ok=True)
    part = {name: folder / f".part-{os.getpid()}-{name}" for name in report["files"]}
    try:  # all of them, then their names
        voxels.write(part["fat.vtu"])
        surface.save(part["fat.vtp"])
        part["fat.json"].write_text(json.dumps(report, indent=2) + "\n")
        for name, temporary in part.items():
            temporary.replace(folder / name)
    finally:
        for temporary in part.values():
            temporary.unlink(missing_ok=True)
    return report
