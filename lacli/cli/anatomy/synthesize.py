"""``lacli synthesize``: a parametric left atrium, or a cohort of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lacli.api import anatomy
from lacli.base.errors import UsageError
from lacli.cli.terminal.console import one_bar, print_json, print_table
from lacli.cli.terminal.modes import refuse
from lacli.contracts.labels import BODY_REGIONS


def command(
    ctx: typer.Context,
    out: Annotated[Path, typer.Argument(help="Folder to write (the bundle; with --cohort one folder per atrium in it).")],
    seed: Annotated[int, typer.Option(help="Seed of the shape; a cohort takes this one and the following.")] = 1,
    volume_ml: Annotated[float | None, typer.Option(help="Cavity volume, mL. Default: the seed's own, 47 - 135 mL.")] = None,
    thickness_mm: Annotated[float, typer.Option(help="Wall thickness, mm.")] = 2.0,
    cell_size_mm: Annotated[float, typer.Option(help="Edge length of the cells along the wall, mm.")] = 4.0,
    order: Annotated[int, typer.Option(help="1: 4-node cells, 2: 10-node cells with curved edges.")] = 2,
    frames: Annotated[int, typer.Option(help="Frames of the annulus' motion over the cycle.")] = 10,
    descent_mm: Annotated[float, typer.Option(help="How far the annulus descends, mm.")] = 8.0,
    cohort: Annotated[int, typer.Option(help="Number of atria; 0: one, written into OUT itself.")] = 0,
    image: Annotated[
        bool, typer.Option("--image", help="Also labels.nrrd (LA 2, LV 3, wall 4) and a noisy ct.nrrd with fat.")
    ] = False,
    voxel_mm: Annotated[float, typer.Option(help="Voxel size of the images, mm.")] = 0.6,
    gated: Annotated[
        bool,
        typer.Option("--gated", help="A synthetic patient: bundle/, a gated CT in frames/ of a simulated cycle, its truth/."),
    ] = False,
    noise_hu: Annotated[float, typer.Option(help="With --gated: standard deviation of the noise, HU.")] = 25.0,
    blur: Annotated[float, typer.Option(help="With --gated: blur of the image, standard deviation in voxels.")] = 0.6,
    heart_rate: Annotated[float, typer.Option(help="With --gated: beats per minute (the frames' times in ms).")] = 65.0,
    motion_blur: Annotated[
        float, typer.Option(help="With --gated: exposure of one frame, as a fraction of the RR interval.")
    ] = 0.0,
    contrast_drift_hu: Annotated[float, typer.Option(help="With --gated: fall of the blood's HU over the cycle.")] = 0.0,
    parameter: Annotated[
        list[str] | None,
        typer.Option("--parameter", metavar="NAME=VALUE", help="With --gated: a known parameter (alpha_roof=2, edp_mmhg=7)."),
    ] = None,
    arm: Annotated[
        str | None,
        typer.Option(
            help="With --cohort: patients for `lacli cohort`, targets simulated on a finer mesh; heterogeneous (every region its"
            " own stiffness), control (one everywhere) or thickness (one, in a wall of varying thickness)."
        ),
    ] = None,
    targets: Annotated[
        str,
        typer.Option(
            help="With --arm: published (7 targets); motion: also components and area strain of each region (27); course: these"
            " and volumes in three frames of the reservoir phase too (90)."
        ),
    ] = "published",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
) -> None:
    """Write a parametric left atrium from a seed: bundle (wall, boundary, regions, fibres), annulus motion, images if asked.

    A folder that was written with the same options is kept as it is.

    Example: lacli synthesize atrium --seed 3 --volume-ml 80

    Example: lacli synthesize cohort --cohort 10 --cell-size-mm 4

    Example: lacli synthesize patients --cohort 10 --arm heterogeneous

    Example: lacli synthesize patient --gated --frames 10 --voxel-mm 1.0
    """
    _refuse_ignored(ctx, image, gated, arm)
    with one_bar("synthesizing") as show:
        made = anatomy.synthesize(
            out, seed=seed, volume_ml=volume_ml, thickness_mm=thickness_mm, cell_size_mm=cell_size_mm, order=order, frames=frames,
            descent_mm=descent_mm, cohort=cohort, image=image, voxel_mm=voxel_mm, gated=gated, noise_hu=noise_hu, blur=blur,
            motion_blur=motion_blur, contrast_drift_hu=contrast_drift_hu, heart_rate=heart_rate,
            parameters=_parameters(parameter or []), arm=arm, targets=targets, progress=show,
        )  # fmt: skip
    rows = [one.report for one in made]
    if as_json:
        print_json(rows)
    elif arm is not None:
        print_table(
            f"alpha by region of the synthetic patients in {out}, arm {arm} (participants.csv, truths.csv)",
            ["folder", "EDV mL", *BODY_REGIONS, "CPU s"],
            [
                [
                    Path(r["folder"]).name,
                    r["edv_ml"],
                    *(r["parameters"][f"alpha_{region}"] for region in BODY_REGIONS),
                    r["truth_cpu_s"],
                ]
                for r in rows
            ],
        )
    elif gated:
        print_table(
            f"synthetic patients in {out}",
            ["folder", "EDV mL", "ESV mL", "ES time", "d_global mm at ES"],
            [[r["folder"], r["edv_ml"], r["esv_ml"], r["es_time"], r["d_global_mm"]] for r in rows],
        )
    else:
        _show(out, rows)


def _refuse_ignored(ctx: typer.Context, image: bool, gated: bool, arm: str | None) -> None:
    acquisition = ("--noise-hu", "--blur", "--heart-rate", "--motion-blur", "--contrast-drift-hu", "--parameter")
    if not gated:
        refuse(ctx, "without --gated", *acquisition)
    elif arm is None:
        refuse(ctx, "with --gated, whose frames are images", "--image")
    if not gated and not image:
        refuse(ctx, "without --image or --gated", "--voxel-mm")
    if arm is None:
        refuse(ctx, "without --arm", "--targets")


def _show(out: Path, rows: list[dict[str, Any]]) -> None:
    print_table(
        f"parametric left atria in {out}",
        ["seed", "folder", "cavity mL", "wall mL", "cells", "points", "worst cell", "cells < 0.2"],
        [
            [
                r[name]
                for name in (
                    "seed",
                    "folder",
                    "cavity_volume_ml",
                    "wall_volume_ml",
                    "cells",
                    "points",
                    "scaled_jacobian_min",
                    "share_below_02",
                )
            ]
            for r in rows
        ],
    )


def _parameters(given: list[str]) -> dict[str, float]:
    result = {}
    for text in given:
        name, _, value = text.partition("=")
        try:
            result[name] = float(value)
        except ValueError:
            raise UsageError(f"--parameter {text}: write it as name=number, for example alpha_roof=2.") from None
    return result
