"""``lacli segment``: blood pool, wall and fat from a CT."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lacli.base.errors import UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table, progress

if TYPE_CHECKING:
    from lacli.anatomy.segmentation.pool import Crop
    from lacli.base.arrays import FloatArray


def command(
    ct: Annotated[
        Path,
        typer.Argument(metavar="CT", help="Contrast-enhanced CT at end-diastole, in Hounsfield units (.nrrd .nii .nii.gz .mha)."),
    ],
    labels: Annotated[Path, typer.Option("--labels", help="Rough label map on the CT's grid.")],
    la: Annotated[int, typer.Option("--la", help="Label of the left atrium's blood in it.")],
    myocardium: Annotated[
        int | None,
        typer.Option("--myocardium", help="Label of muscle to sample, 3 mm thick or more: the left ventricle's will do."),
    ] = None,
    lv: Annotated[
        int | None, typer.Option("--lv", help="Label of the left ventricle's blood; the atrium ends where it begins.")
    ] = None,
    blood_box: Annotated[
        str | None, typer.Option("--blood-box", metavar="X0,X1,Y0,Y1,Z0,Z1", help="Sample blood in this box, mm (LPS).")
    ] = None,
    myocardium_box: Annotated[
        str | None, typer.Option("--myocardium-box", metavar="X0,X1,Y0,Y1,Z0,Z1", help="Sample muscle in this box, mm (LPS).")
    ] = None,
    valve_plane: Annotated[
        str | None,
        typer.Option(
            "--valve-plane", metavar="X,Y,Z,NX,NY,NZ", help="The atrium ends at this plane, mm (LPS); normal to the ventricle."
        ),
    ] = None,
    valve_sphere: Annotated[
        str | None,
        typer.Option("--valve-sphere", metavar="X,Y,Z,RADIUS", help="What lies in this sphere is no atrium, mm (LPS)."),
    ] = None,
    voxel_mm: Annotated[float, typer.Option("--voxel-mm", help="Voxel size of the map that is written, mm.")] = 0.4,
    wall_label: Annotated[int | None, typer.Option("--wall-label", help="Label the wall gets; default: the first free.")] = None,
    fat_label: Annotated[int | None, typer.Option("--fat-label", help="Label fat gets; default: the next free.")] = None,
    anatomy: Annotated[
        Path | None, typer.Option("--anatomy", help="Bundle of the same patient: thickness by its regions, else by six sides.")
    ] = None,
    target: Annotated[
        Path, typer.Option("--out", "-o", help="Label map to write; .json, .vtp and .png are put beside it.")
    ] = Path("segmentation.nrrd"),
    picture: Annotated[bool, typer.Option(help="Draw slices with contours.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
) -> None:
    """Segment blood pool, wall and epicardial fat in a CT; wall thickness per region with its error.

    HU of blood and myocardium are sampled inside of the rough labels. The thickness is that of a blurred slab fitted along the
    normal, so walls of about two voxels are not overestimated. Where a neighbour as bright as the wall touches it, the
    thickness is bounded and flagged.

    Example: lacli segment ct.nii.gz --labels rough.nii.gz --la 2 --lv 3 --myocardium 5 --out atrium.nrrd
    """
    from lacli.anatomy.segmentation.road import Options
    from lacli.api import segmentation

    if not 0.1 <= voxel_mm <= 2.0:
        raise UsageError(f"--voxel-mm is {voxel_mm:g} mm; it must be 0.1 to 2 mm.")
    for name, value in (("--wall-label", wall_label), ("--fat-label", fat_label)):
        if value is not None and not 1 <= value <= 255:
            raise UsageError(f"{name} is {value}; it must be 1 to 255.")
    if not 0 < la <= 255 or (lv is not None and not 0 < lv <= 255):
        raise UsageError("--la and --lv must be 1 to 255, as they are in the map that is written.")
    options = Options(
        la, myocardium, lv, _box("--blood-box", blood_box), _box("--myocardium-box", myocardium_box),
        _crop(valve_plane, valve_sphere), voxel_mm, wall_label, fat_label,
    )  # fmt: skip
    with progress() as bar:
        task = bar.add_task("segmenting", total=segmentation.STEPS)
        found = segmentation.segment(
            ct, labels, target, options, anatomy=anatomy, picture=picture,
            progress=lambda p: bar.update(task, completed=p.done),
        )  # fmt: skip
    for note in found.notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    if as_json:
        print_json({**segmentation.report(found, ct, labels), "out": str(target)})
        return
    rows = [
        [r.name, r.mean_mm, r.sd_mm, r.spread_mm, r.area_cm2, 100 * r.touching, 100 * r.unclear, "a guess" if r.doubtful else ""]
        for r in found.thickness
    ]
    columns = ["region", "thickness mm", "its sd mm", "spread mm", "area cm2", "neighbour touches %", "not seen %", ""]
    print_table("Wall thickness", columns, rows)
    n = found.numbers
    volumes = ", ".join(
        f"{w} {found.volume_ml(v):.1f} mL (label {v})" for w, v in (("blood", n.la), ("wall", n.wall), ("fat", n.fat))
    )
    out.print(f"{volumes}; blur of the image {found.wall.blur_mm:.2f} mm", highlight=False, soft_wrap=True)
    ventricle = "" if n.lv is None else f" --lv {n.lv}"
    out.print(f"next: lacli mesh {target} --la {n.la}{ventricle} --wall {n.wall}", highlight=False, soft_wrap=True)


def _numbers(option: str, text: str, count: int) -> FloatArray:
    import numpy as np

    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.array([])
    if len(values) != count or not np.isfinite(values).all():
        raise UsageError(f"{option} is '{text}'; write {count} numbers with commas between, in mm (LPS).")
    return values


def _box(option: str, text: str | None) -> FloatArray | None:
    if text is None:
        return None
    box = _numbers(option, text, 6).reshape(3, 2)
    if (box[:, 0] >= box[:, 1]).any():
        raise UsageError(f"{option} is '{text}'; the first of each pair must be the smaller.")
    return box


def _crop(plane: str | None, sphere: str | None) -> Crop | None:
    import numpy as np

    from lacli.anatomy.segmentation.pool import Crop

    if plane is not None and sphere is not None:
        raise UsageError("Give --valve-plane or --valve-sphere, not both.")
    if plane is not None:
        values = _numbers("--valve-plane", plane, 6)
        if not np.linalg.norm(values[3:]) > 0:
            raise UsageError(f"--valve-plane is '{plane}'; its normal is zero.")
        return Crop(values[:3], values[3:])
    if sphere is not None:
        values = _numbers("--valve-sphere", sphere, 4)
        if values[3] <= 0:
            raise UsageError(f"--valve-sphere is '{sphere}'; its radius must be above 0.")
        return Crop(values[:3], None, float(values[3]))
    return None
