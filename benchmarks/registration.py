"""What greedy's settings buy: tracked points of synthetic gated patients against their true motion, one setting beside another.

    python benchmarks/registration.py FOLDER... [--frames 2 4] [--settings PATCH,ITERATIONS,UPDATE,WHOLE ...]

Each FOLDER is a patient that ``benchmarks/track.py`` or ``lacli synthesize --gated`` wrote (bundle, frames, truth). A setting is
the patch (2x2x2), iterations by level (60x40x60), and the widths, in voxels, by which an update and the whole are smoothed.
Errors are of the frames asked for, in mm: of the wall, means along its normal and along itself; of the mitral annulus along its
way, its tilt (root mean square of what is linear over it), and a point's root mean square. Falls: the share of a frame's way
that is lost (annulus, and the wall along itself).
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.cli.terminal.console import print_table
from lacli.contracts.bundle import load
from lacli.motion import frames as framing
from lacli.motion.axes import wall_normals
from lacli.motion.registration import GREEDY, greedy

USED = ",".join((GREEDY[2], GREEDY[4], GREEDY[6].removesuffix("vox"), GREEDY[7].removesuffix("vox")))
DEFAULT = (
    USED, "3x3x3,60x40x30,4.0,1.0", "3x3x3,60x40x60,4.0,0.7", "2x2x2,60x40x60,5.0,1.0", "2x2x2,60x40x30,5.0,0.7",
    "2x2x2,60x40x60,5.0,0.5",
)  # fmt: skip
ON_WALL_MM = 1.5  # of the endocardium: the truth's points that are the wall's


def command(setting: str) -> tuple[str, ...]:
    """Greedy's own words for a setting."""
    patch, iterations, update, whole = setting.split(",")
    return ("-m", "NCC", patch, "-n", iterations, "-s", f"{float(update)}vox", f"{float(whole)}vox", "-noise", "0")


def annulus(error: FloatArray, moved: FloatArray, rest: FloatArray) -> dict[str, float]:
    """What the annulus errs by, from errors and displacements (n, 3) mm of its points, which rest at (n, 3) mm."""
    way = moved.mean(axis=0)
    axis = way / np.linalg.norm(way)
    along = error @ axis
    arms = rest - rest.mean(axis=0)
    arms = arms - np.outer(arms @ axis, axis)
    design = np.column_stack([np.ones(len(arms)), arms])
    tilt = design[:, 1:] @ np.linalg.lstsq(design, along, rcond=None)[0][1:]
    return {
        "annulus along its way [mm]": float(along.mean()),
        "tilt [mm]": float(np.sqrt((tilt**2).mean())),
        "a point [mm]": float(np.sqrt((error**2).sum(axis=1).mean())),
        "falls, annulus [%]": -100.0 * float(along.mean()) / float(np.linalg.norm(way)),
    }


def wall(error: FloatArray, moved: FloatArray, normal: FloatArray) -> dict[str, float]:
    """What the wall errs by, from errors and displacements (n, 3) mm of its points with these normals."""
    along = (error * normal).sum(axis=1)
    tangential = error - along[:, None] * normal
    true = moved - (moved * normal).sum(axis=1)[:, None] * normal
    return {
        "normal [mm]": float(np.abs(along).mean()),
        "along the wall [mm]": float(np.linalg.norm(tangential, axis=1).mean()),
        "falls, along the wall [%]": -100.0 * float((tangential * true).sum() / (true**2).sum()),
    }


def quiet(fixed: Image, moving: Image, setting: str) -> tuple[Any, float]:
    """The field and the CPU seconds; what the library prints is kept off the terminal."""
    saved, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        start = time.process_time()
        field = greedy(fixed, moving, command(setting))
        return field, time.process_time() - start
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)


def patient(folder: Path, frames: list[int], settings: list[str]) -> list[dict[str, Any]]:
    """A row for each frame and setting."""
    bundle = load(folder / "bundle")
    surface = Endocardium.of(bundle)
    sources = framing.find([folder / "frames"])
    images = {k: framing.around(framing.read(sources[k]), surface.ed, framing.WORK_MM) for k in (0, *frames)}
    with np.load(folder / "truth" / "points.npz") as truth:
        positions, ring = truth["positions"], np.isin(truth["point"], truth["annulus"])
    on_wall = cKDTree(surface.ed).query(positions[0])[0] < ON_WALL_MM
    normal = wall_normals(bundle, surface)[cKDTree(bundle.points).query(positions[0])[1]]
    rows = []
    for setting in settings:
        for k in frames:
            field, seconds = quiet(images[0], images[k], setting)
            moved = positions[k] - positions[0]
            error = field.at(positions[0]) - moved
            row: dict[str, Any] = {"setting": setting, "voxel [mm]": round(float(images[0].spacing[0]), 2), "frame": k}
            row |= wall(error[on_wall], moved[on_wall], normal[on_wall]) | annulus(error[ring], moved[ring], positions[0][ring])
            rows.append(row | {"CPU s": seconds})
    return rows


def main() -> None:
    """Parse, run, print means over patients."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--settings", nargs="+", default=list(DEFAULT))
    chosen = parser.parse_args()
    rows = [row for folder in chosen.folder for row in patient(folder, chosen.frames, chosen.settings)]
    means = pd.DataFrame(rows).groupby(["voxel [mm]", "frame", "setting"], sort=False).mean().reset_index().round(2)
    print_table(f"{len(chosen.folder)} patients, means", list(means.columns), means.to_numpy().tolist())


if __name__ == "__main__":
    main()
