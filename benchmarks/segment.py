"""Wall thickness by segmentation of synthetic CT whose wall is known: asked beside measured.

    python benchmarks/segment.py [--seeds 1 2] [--voxels-mm 0.45 0.8] [--walls 1.5 4 1.5-4]

Noise of sd 25 HU, blur of .5 mm, fat, an aorta and a muscle that touch. Regions are the patient's six sides and the whole wall:
the mean that is reported against the mean of the truth at the same places, flagged ones included; regions that are said to be a
guess are counted apart. A row a case as it is done, and the table at the end; exit code 1 where a figure is missed.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy.segmentation import road
from lacli.anatomy.segmentation.regional import SIDES, WHOLE, sides
from lacli.anatomy.segmentation.wall import OPEN, SEEN
from lacli.synthetic.walled import LA, LV, MUSCLE, walled

MEAN_ERROR_MM, BIAS_MM = 0.25, 0.15
APART_MM = 6.0  # from a neighbour, beyond which nothing should be flagged
COLUMNS = ("seed", "voxel mm", "wall mm", "regions", "error mm", "worst", "bias mm", "within 2 sd",
           "touching flagged", "unflagged error mm", "free flagged", "CPU s")  # fmt: skip


def case(seed: int, voxel: float, wall: tuple[float, float]) -> dict[str, float | str]:
    """Write, segment and compare one atrium."""
    made = walled(seed, wall, (voxel,) * 3)
    start = time.process_time()
    found = road.segment(made.ct, made.rough, road.Options(LA, muscle=MUSCLE, lv=LV))
    cpu = time.process_time() - start
    away, nearest = cKDTree(made.points).query(found.wall.surface.points)
    truth = made.thickness[nearest]
    here = (found.wall.flag != OPEN) & (away < 3.0) & (truth < 8.5)  # a ray into the next vessel finds no outside
    side = sides(found.wall.normal)
    error, inside, doubtful = [], [], 0
    for region in found.thickness:
        mine = here if region.name == WHOLE else here & (side == 1 + SIDES.index(region.name))
        if region.doubtful:
            doubtful += 1
            continue
        true = float(np.average(truth[mine], weights=found.wall.area[mine]))
        error.append(region.mean_mm - true)
        inside.append(abs(error[-1]) <= 2.0 * region.sd_mm)
    body, touching = made.body[nearest] & here, made.touching[nearest]
    flagged = found.wall.flag != SEEN
    left = body & touching & ~flagged
    to_touching, _ = cKDTree(made.points[made.touching | ~made.body]).query(found.wall.surface.points)
    free = body & (to_touching > APART_MM)
    return {
        "seed": seed, "voxel mm": voxel, "wall mm": f"{wall[0]:g}-{wall[1]:g}", "regions": f"{len(error)} + {doubtful}",
        "error mm": float(np.mean(np.abs(error))), "worst": float(np.abs(error).max()), "bias mm": float(np.mean(error)),
        "within 2 sd": float(np.mean(inside)), "touching flagged": float(flagged[body & touching].mean()),
        "unflagged error mm": float(np.abs(found.wall.thickness - truth)[left].mean()) if left.any() else 0.0,
        "free flagged": float(flagged[free].mean()), "CPU s": cpu,
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--voxels-mm", type=float, nargs="+", default=[0.45, 0.8])
    parser.add_argument("--walls", nargs="+", default=["1.5", "4", "1.5-4"], help="thickness, or thinnest-thickest, mm")
    arguments = parser.parse_args()
    rows = []
    print(" | ".join(COLUMNS), flush=True)
    for seed in arguments.seeds:
        for voxel in arguments.voxels_mm:
            for text in arguments.walls:
                low, _, high = text.partition("-")
                rows.append(case(seed, voxel, (float(low), float(high or low))))
                print(" | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in rows[-1].values()), flush=True)
    error = float(np.mean([row["error mm"] for row in rows]))
    bias = float(np.mean([row["bias mm"] for row in rows]))
    flagged = float(np.mean([row["touching flagged"] for row in rows]))
    inside = float(np.mean([row["within 2 sd"] for row in rows]))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"\nmean error of regions {error:.3f} mm (asked {MEAN_ERROR_MM}), bias {bias:+.3f} mm (asked {BIAS_MM}); within 2 sd "
          f"{100 * inside:.0f} %; of the wall that is touched {100 * flagged:.0f} % flagged; {memory:.2f} GB")  # fmt: skip
    return 0 if error <= MEAN_ERROR_MM and abs(bias) <= BIAS_MM else 1


if __name__ == "__main__":
    raise SystemExit(main())
