"""A parametric left atrium in a folder: bundle, motion of its annulus, images; written whole, and kept where it is finished."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from lacli.anatomy.bundle_folder import check_replaceable
from lacli.anatomy.inputs.image import write
from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError, InputError
from lacli.base.files import write_json
from lacli.contracts.bundle import check, save
from lacli.contracts.motion import save_motion
from lacli.synthetic import kept
from lacli.synthetic.atrium import synthesize
from lacli.synthetic.image import images

KEY = "synthesis"  # in anatomy.json: what a folder was made from, so that a rerun knows a finished one


def write_atrium(seed: int, folder: Path, wanted: dict[str, Any], voxel_mm: float | None) -> dict[str, Any]:
    """What was written, by name: volumes (mL), cells, quality; a folder that was made from the same is kept as it is.

    wanted: arguments of ``synthesize``; voxel_mm: of a label map and a CT beside the bundle (None: no images). The folder is
    written under a temporary name, then renamed. Raises AnatomyError where it holds something else.
    """
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
            info[kept.FILES] = kept.digests(partial, "anatomy.json")
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
    folder.mkdir(parents=True, exist_ok=True)
    made = images(seed, wanted["volume_ml"], (voxel_mm,) * 3, wanted["thickness_mm"])
    write(made.labels, folder / "labels.nrrd")
    write(made.ct, folder / "ct.nrrd")
    return {"fat_ml": made.fat_ml, "pool_ml": made.pool_ml}


def _finished(folder: Path, made_from: dict[str, Any]) -> dict[str, Any] | None:
    """The description of a folder that was made from the same options; None where there is none.

    Raises AnatomyError where the folder holds something else, or was changed since: it is not ours to replace.
    """
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
