"""``lacli synthesize``: a parametric left atrium, or a cohort of them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError, InputError, UsageError
from lacli.base.files import write_json
from lacli.cli.terminal.console import print_json, print_table, progress

KEY = "synthesis"  # in anatomy.json: what a folder was made from, so that a rerun knows a finished one


def command(
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
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
) -> None:
    """Write a parametric left atrium from a seed: bundle (wall, boundary, regions, fibres), annulus motion, images if asked.

    A folder that was written with the same options is kept as it is.

    Example: lacli synthesize atrium --seed 3 --volume-ml 80

    Example: lacli synthesize cohort --cohort 10 --cell-size-mm 4

    Example: lacli synthesize patient --gated --frames 10 --voxel-mm 1.0
    """
    from lacli.base.files import check_folder

    if cohort < 0 or seed < 0:
        raise UsageError("--seed and --cohort must not be negative.")
    if not 0.2 <= voxel_mm <= 3.0:
        raise UsageError(f"--voxel-mm must lie between 0.2 and 3 mm, got {voxel_mm:g}.")
    wanted = {
        "volume_ml": volume_ml,
        "thickness_mm": thickness_mm,
        "cell_size_mm": cell_size_mm,
        "order": order,
        "frames": frames,
        "descent_mm": descent_mm,
    }
    if gated:
        from lacli.synthetic.gated import Acquisition

        acquisition = Acquisition(frames, (voxel_mm,) * 3, noise_hu, blur, motion_blur, contrast_drift_hu)
        _gated(seed, out, cohort, wanted, acquisition, heart_rate, parameter or [], as_json)
        return
    places = [(seed + i, out / f"la{seed + i:02d}" if cohort else out) for i in range(max(cohort, 1))]
    check_folder(out)
    rows = []
    with progress() as bar:
        task = bar.add_task("synthesizing", total=len(places))
        for number, folder in places:
            rows.append(_one(number, folder, wanted, voxel_mm if image else None))
            bar.advance(task)
    if as_json:
        print_json(rows)
        return
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


def _gated(
    seed: int, out: Path, cohort: int, wanted: dict[str, Any], acquisition: Any, rate: float, given: list[str], as_json: bool
) -> None:
    """Write synthetic patients; those that are there already, made from the same, are kept."""
    from dataclasses import asdict

    from lacli.base.files import check_folder
    from lacli.synthetic import gated_case
    from lacli.synthetic.cycle import draw_parameters

    wanted = {name: value for name, value in wanted.items() if name != "frames"}
    acquisition.check()
    if not 20.0 <= rate <= 250.0:
        raise UsageError(f"--heart-rate is {rate:g}; it must be 20 to 250 beats per minute.")
    check_folder(out)
    rows = []
    with progress() as bar:
        task = bar.add_task("synthesizing", total=1)
        for number in range(seed, seed + max(cohort, 1)):
            folder = out / f"la{number:02d}" if cohort else out
            parameters = {**draw_parameters(number), **_parameters(given)}
            made_from = {"seed": number, "atrium": wanted, "acquisition": asdict(acquisition), "parameters": parameters}
            info = gated_case.finished(folder, made_from)
            if info is None:

                def monitor(what: str, done: int, total: int, name: str = folder.name) -> None:
                    bar.update(task, description=f"{name}: {what}", completed=done, total=total)

                info = gated_case.write_case(folder, number, wanted, parameters, acquisition, rate, monitor)
            rows.append({"folder": str(folder), **info})
    if as_json:
        print_json(rows)
        return
    print_table(
        f"synthetic patients in {out}",
        ["folder", "EDV mL", "ESV mL", "ES time", "d_global mm at ES"],
        [[r["folder"], r["edv_ml"], r["esv_ml"], r["es_time"], r["d_global_mm"]] for r in rows],
    )


def _parameters(given: list[str]) -> dict[str, float]:
    from lacli.contracts.parameters import parameter_box

    result = {}
    for text in given:
        name, equals, value = text.partition("=")
        parameter_box([name])
        try:
            result[name] = float(value)
        except ValueError:
            raise UsageError(f"--parameter {text}: write it as name=number, for example alpha_roof=2.") from None
        if not equals or not result[name] >= 0:
            raise UsageError(f"--parameter {text}: write it as name=number, not negative.")
    return result


def _one(seed: int, folder: Path, wanted: dict[str, Any], voxel_mm: float | None) -> dict[str, Any]:
    """Write one atrium under a temporary name, then rename; return its row."""
    from dataclasses import replace

    from lacli.contracts.bundle import check, check_replaceable, save
    from lacli.contracts.motion import save_motion
    from lacli.synthetic.atrium import synthesize
    from lacli.synthetic.kept import FILES, digests

    made_from = {"seed": seed, **wanted, "voxel_mm": voxel_mm}
    info = _finished(folder, made_from)
    if info is None:
        check_replaceable(folder)
        bundle, motion = synthesize(seed, **wanted)
        check(bundle, f"seed {seed}")
        info = {
            **bundle.info,
            KEY: made_from,
            "wall_volume_ml": bundle.wall_volume_ml(),
            "cells": len(bundle.tets),
            "points": len(bundle.points),
        }
        partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
        try:
            if voxel_mm is not None:
                info["image"] = _images(seed, wanted, voxel_mm, partial)
            save(replace(bundle, info=info), partial)
            save_motion(motion, partial)
            info[FILES] = digests(partial, "anatomy.json")
            write_json(partial / "anatomy.json", info)
            if folder.exists():
                shutil.rmtree(folder)
            partial.replace(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    shell = info["shell"]
    return {
        "seed": seed,
        "folder": str(folder),
        "cavity_volume_ml": info["cavity_volume_ml"],
        "wall_volume_ml": info["wall_volume_ml"],
        "cells": info["cells"],
        "points": info["points"],
        "scaled_jacobian_min": shell["scaled_jacobian_min"],
        "share_below_02": shell["scaled_jacobian_share_below_02"],
        "curved_jacobian_min": shell["curved_jacobian_min"],
        **{f"image_{name}": value for name, value in info.get("image", {}).items()},
    }


def _images(seed: int, wanted: dict[str, Any], voxel_mm: float, folder: Path) -> dict[str, float]:
    """Label map and CT of the same atrium, veins going on past their cuts; what is in them, mL."""
    from lacli.anatomy.inputs.image import write
    from lacli.synthetic.image import images

    folder.mkdir(parents=True, exist_ok=True)
    made = images(seed, wanted["volume_ml"], (voxel_mm,) * 3, wanted["thickness_mm"])
    write(made.labels, folder / "labels.nrrd")
    write(made.ct, folder / "ct.nrrd")
    return {"fat_ml": made.fat_ml, "pool_ml": made.pool_ml}


def _finished(folder: Path, made_from: dict[str, Any]) -> dict[str, Any] | None:
    """The description of a folder that was made from the same options; None where there is none.

    Raises AnatomyError where the folder holds something else, or was changed since: it is not ours to replace.
    """
    from lacli.synthetic import kept

    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return None
    try:
        info = read_json(folder / "anatomy.json")
        same = info[KEY] == made_from
    except (InputError, KeyError, TypeError) as error:
        raise AnatomyError(
            f"{folder} exists and was not written by `lacli synthesize`; choose another folder or remove it."
        ) from error
    complete = all((folder / name).is_file() for name in ("wall.vtu", "boundary.vtp", "motion.npz"))
    if not (same and complete):
        return None
    kept.check(folder, info)
    return dict(info)
