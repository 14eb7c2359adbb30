"""What is lost between an atrium and the wall that `lacli mesh` makes of its label map, and what a simulation shows of it.

    python benchmarks/labelled.py [--seeds 1 2 3] [--voxels-mm 1.5 0.75] [--waves-mm default 0] [--set K=V]

Synthetic atria, whose true shape is meshed with the same cells. Of each label map: height of the mitral annulus above the true
one (mm) and its area over the true one's; thickness over 2 mm, of the thinnest and the thickest region; and displacements at .25,
.5, .75 and 1 of end-systole's time against those of the true shape, by the same annulus's motion: the worst region's (mm).
``--waves-mm``: what `mesh --wave-mm` takes out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy import build
from lacli.anatomy.wall.thickness import of_bundle
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle
from lacli.contracts.features import at_time
from lacli.contracts.labels import PLANES, REGIONS
from lacli.contracts.motion import Motion, save_motion
from lacli.contracts.scene import build_scene
from lacli.mechanics.results import features_at_times
from lacli.mechanics.simulation import run_scene
from lacli.motion.annulus import annulus_points, descend
from lacli.synthetic import image as label_image
from lacli.synthetic.atrium import sized, synthesize

PARTS = (0.25, 0.5, 0.75, 1.0)  # of end-systole's time
FEATURES = [f"d_{name}_mm" for name in ("global", *REGIONS)]


def annulus(bundle: Bundle) -> tuple[np.ndarray, float]:
    """Middle (3,) mm and area (mm2) of the mitral opening."""
    corner = bundle.points[bundle.triangles[bundle.tags == PLANES["mv"]][:, :3]]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2.0
    return np.average(corner.mean(axis=1), axis=0, weights=area), float(area.sum())


def simulated(bundle: Bundle, motion: Motion, folder: Path, settings: list[str], out: Path) -> np.ndarray:
    """(4, 6) mm: FEATURES at PARTS; NaN where the scene has no answer."""
    bundles.save(bundle, folder)
    ids = annulus_points(bundle)
    _, near = cKDTree(motion.positions[0]).query(bundle.points[ids])
    save_motion(Motion(motion.times, ids, bundle.points[ids] + motion.displacement()[:, near], motion.es_time), folder)
    times = [round(part * motion.es_time, 4) for part in PARTS[:-1]]
    document = {"anatomy": {"bundle": str(folder.resolve())}, "outputs": {"times": times, "fields": "none", "conduit": False}}
    result = run_scene(build_scene(document, settings, folder=folder, where="labelled"), out / "runs")
    if result.status != "done":
        print(f"{folder}: {result.kind} ({result.message})", flush=True)
        return np.full((len(PARTS), len(FEATURES)), np.nan)
    frames, _ = features_at_times(result.folder)
    rows = [[frames[at_time(key, time)] for key in FEATURES] for time in times]
    return np.array([*rows, [float(result.features[key]) for key in FEATURES]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--voxels-mm", type=float, nargs="+", default=[1.5, 0.75])
    parser.add_argument("--waves-mm", nargs="+", default=["default", "0"])
    parser.add_argument("--cell-size-mm", type=float, default=4.0)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--out", type=Path, default=Path("results/labelled"))
    choice = parser.parse_args()
    settings = ["outputs.unloaded=false", "numerics.timeout_s=3600", *choice.overrides]
    print(f"{'seed':>4s} {'voxel mm':>8s} {'waves mm':>8s} {'annulus mm':>10s} {'area':>6s} {'wall':>11s}  "
          f"worst region off, mm, at {', '.join(map(str, PARTS))}  (true: whole body)")  # fmt: skip
    for seed in choice.seeds:
        shape = sized(seed).at_ostia()
        cut = next(c for c in shape.cuts() if c.label == PLANES["mv"])
        true, _ = synthesize(seed, None, cell_size_mm=choice.cell_size_mm, at_ostia=True)
        motion = descend(true)
        exact = simulated(true, motion, choice.out / f"true_{seed}", settings, choice.out)
        _, width = annulus(true)
        for voxel in choice.voxels_mm:
            made = label_image.images(seed, None, (voxel,) * 3)
            for wave in choice.waves_mm:
                options = build.Options(choice.cell_size_mm, wave_mm=None if wave == "default" else float(wave))
                bundle = build.from_labels(made.labels, label_image.LA, label_image.LV, options, say=lambda words: None,
                                           wall=label_image.WALL).bundle  # fmt: skip
                place, area = annulus(bundle)
                found = simulated(bundle, motion, choice.out / f"labels_{seed}_{voxel:g}_{wave}", settings, choice.out)
                thick = [eikonal / 2.0 for eikonal, _ in of_bundle(bundle).per_region.values()]
                off = np.abs(found - exact).max(axis=1)
                print(f"{seed:4d} {voxel:8.2f} {wave:>8s} {(place - cut.centre) @ cut.direction:10.2f} {area / width:6.3f} "
                      f"{min(thick):5.3f}-{max(thick):5.3f}  {'  '.join(f'{v:5.2f}' for v in off)}  "
                      f"({', '.join(f'{v:.2f}' for v in exact[:, 0])})", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
