"""One patient from end to end with the truth known: targets with drawn, correlated noise; runs, posterior. Synthetic atrium.

    python benchmarks/patient.py [--cell-size-mm 6] [--order 1] [--seed 1] [--truths 1 2 3] [--few] [--out DIR] [--json]

Each truth is drawn from the inner part of the box and simulated; its 90 targets (magnitudes, components along normal and
universal coordinates, area strain and volume, at end-systole and in three frames) get errors of 0.2 mm, 5 % of the
end-diastolic volume and 0.02 of strain, correlated between frames (.5) and between features of a region's motion (.3), and are
calibrated against. Printed: asked beside measured.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from lacli.calibration.sequential.calibration import calibrate_sequentially
from lacli.calibration.sequential.result import Sequential
from lacli.calibration.sequential.search import Settings, Status
from lacli.calibration.simulator import SceneSimulator, simulator
from lacli.cli.terminal.console import err, print_json, print_table
from lacli.contracts import bundle as bundles
from lacli.contracts.features import at_time
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import build_scene
from lacli.contracts.targets import Targets
from lacli.inference.box import OUTPUTS, Box, published_box
from lacli.inference.runs import RunLog, runs_identity
from lacli.synthetic.atrium import synthesize

BETWEEN_FRAMES, BETWEEN_FEATURES = 0.5, 0.3
SD_MM, SD_VOLUME, SD_STRAIN = 0.2, 0.05, 0.02
ASKED = {"runs to the MAP": 20, "runs in all": 60, "largest sd of alpha": 0.35, "wall minutes": 5.0}
_INNER = 0.15  # truths keep so far from the ends of each range (of its logarithm)


def names_of(es: float) -> tuple[str, ...]:
    """The 90 targets: 21 features at end-systole and in three frames, volumes, and the published ones not among them."""
    keys = [f"{kind}_{region}_mm" for kind in "nab" for region in BODY_REGIONS] + [f"area_strain_{r}" for r in BODY_REGIONS]
    frames = [at_time(key, es * share) for share in (0.25, 0.5, 0.75) for key in (*keys, "volume_ml")]
    return (*OUTPUTS, *keys, *frames)


def error_covariance(names: tuple[str, ...], edv_ml: float) -> np.ndarray:
    """(p, p): sds as stated; correlation falls with the frames and where region or kind differ."""
    keys = [(n.partition("@")[0], n.partition("@")[2]) for n in names]
    sd = np.array([SD_MM if k.endswith("_mm") else SD_VOLUME * edv_ml if k.endswith("_ml") else SD_STRAIN for k, _ in keys])
    kinds = np.array([k.replace("esv_ml", "volume_ml") for k, _ in keys])
    times = np.array([t for _, t in keys])
    regions = np.array([next((r for r in BODY_REGIONS if r in k), "") for k in kinds])
    same_time, same_kind, same_region = (a[:, None] == a[None] for a in (times, kinds, regions))
    correlation = np.where(same_kind, 1.0, np.where(same_region, BETWEEN_FEATURES, 0.0))
    correlation = correlation * np.where(same_time, 1.0, BETWEEN_FRAMES)
    return np.asarray(correlation * np.outer(sd, sd))


def draw_truth(box: Box, rng: np.random.Generator) -> np.ndarray:
    """(d,) within the inner part of the ranges, wide ones by their logarithm."""
    share = _INNER + (1.0 - 2.0 * _INNER) * rng.random(box.d)
    wide = box.upper > 10.0 * box.lower
    return np.asarray(np.where(wide, box.lower * (box.upper / box.lower) ** share, box.from_unit(share)))


def calibrated(run: SceneSimulator, box: Box, targets: Targets, settings: Settings, folder: Path) -> tuple[Sequential, float]:
    """The calibration and its wall minutes."""
    log = RunLog(folder / "runs.csv", box.names, targets.names, runs_identity(run, box.names, targets.names))
    begin, stage = time.monotonic(), ""

    def show(status: Status) -> None:
        nonlocal stage
        if status.stage != stage:
            stage = status.stage
            err.print(f"{time.monotonic() - begin:6.0f} s  {status.runs:3d} runs  {stage}", highlight=False)

    found = calibrate_sequentially(run, box, targets, settings, folder, log, show)
    return found, (time.monotonic() - begin) / 60.0


def inside(found: Sequential, truth: np.ndarray) -> list[bool]:
    """By input: whether the truth is in the 95 % interval."""
    return [bool(float(r["low95"]) <= t <= float(r["high95"])) for r, t in zip(found.table, truth, strict=True)]


def one(run: SceneSimulator, box: Box, names: tuple[str, ...], number: int, folder: Path) -> dict[str, Any]:
    """Truth ``number``: simulated, blurred by its noise, calibrated against."""
    rng = np.random.default_rng(number)
    truth = draw_truth(box, rng)
    asked = (*names, "edv_ml")
    log = RunLog(folder / "truth.csv", box.names, asked, runs_identity(run, box.names, asked))
    log.run(run, truth[None])
    row = log.frame(truth[None]).iloc[0]
    if row["status"] != "done":
        return {"truth": number, "failed": str(row["kind"])}
    y = row[list(names)].to_numpy(float)
    covariance = error_covariance(names, float(row["edv_ml"]))
    noise = np.linalg.cholesky(covariance) @ rng.standard_normal(len(names))
    targets = Targets(names, y + noise, np.sqrt(np.diag(covariance)), covariance)
    found, minutes = calibrated(run, box, targets, Settings(seed=number), folder / "calibration")
    alpha = [float(r["sd"]) for r in found.table if str(r["input"]).startswith("alpha_")]
    within = inside(found, truth)
    return {
        "truth": number, "runs to the MAP": found.map_runs, "runs in all": found.runs, "failed runs": found.failed,
        "chi2": found.misfit, "targets": len(names), "left out": len(found.left_out),
        "largest sd of alpha": max(alpha), "inside": sum(within), "of": box.d,
        "outside": [name for name, good in zip(box.names, within, strict=True) if not good], "wall minutes": minutes,
        "cpu minutes": found.cpu_s / 60.0, "change": float(found.change.max()), "held out": found.held_out,
        "modes": len(found.minima), "elsewhere": found.sweep.elsewhere, "stages": found.stages, "refused": found.refused,
    }  # fmt: skip


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell-size-mm", type=float, default=6.0)
    parser.add_argument("--order", type=int, default=1, choices=(1, 2))
    parser.add_argument("--seed", type=int, default=1, help="of the atrium")
    parser.add_argument("--truths", type=int, nargs="*", default=[1], help="numbers of the truths")
    parser.add_argument("--few", action="store_true", help="against the seven published targets alone")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="where everything is kept (and found again); else it is thrown away")
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="lacli-patient-") as temporary:
        out = (choice.out or Path(temporary)).resolve()
        folder = out / f"bundle_{choice.seed}_{choice.cell_size_mm:g}mm"
        if not folder.is_dir():
            bundle, motion = synthesize(choice.seed, None, cell_size_mm=choice.cell_size_mm)
            bundles.save(bundle, folder)
            save_motion(motion, folder)
        box = published_box()
        scene = build_scene(
            {"anatomy": {"bundle": str(folder)}}, [f"numerics.order={choice.order}"], folder=folder, where="patient"
        )
        es = 0.4
        names = OUTPUTS if choice.few else names_of(es)
        run = simulator(scene, out / "runs", choice.workers, targets=names)
        rows = [one(run, box, names, number, out / f"{'few' if choice.few else 'many'}_{number}") for number in choice.truths]
    if choice.json:
        print_json({"asked": ASKED, "rows": rows})
        return
    for row in rows:
        table = [[key, ASKED.get(key, ""), str(value)] for key, value in row.items()]
        print_table(f"truth {row['truth']}", ["what", "asked", "measured"], table)


if __name__ == "__main__":
    main()
