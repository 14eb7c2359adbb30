"""``lacli fat``: epicardial fat in a CT volume."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.api import anatomy
from lacli.cli.terminal.console import err, one_bar, out, print_json, print_table


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
    with one_bar("reading") as bar:
        made = anatomy.fat(ct, folder, bundle=bundle, labels=labels, la=la, reach_mm=reach_mm, progress=bar)
    for note in made.notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    if as_json:
        print_json({**made.report, "folder": str(folder)})
        return
    names = list(next(iter(made.windows.values())).per_region_ml)
    hu = {w: "{:.0f} .. {:.0f}".format(*told["hu"]) for w, told in made.report["windows"].items()}
    rows = [[f"{w} {hu[w]} HU", f.volume_ml, f.window_ml, *[f.per_region_ml[n] for n in names]] for w, f in made.windows.items()]
    print_table("Epicardial fat", ["window", "fat (mL)", "voxels in window (mL)", *[f"{n} (mL)" for n in names]], rows)
    out.print(f"written: {folder} ({', '.join(made.report['files'])})", highlight=False)
