"""What tracking's errors do to the stiffness: calibrated from the tracked motion, and from the true one of the same patient.

    python benchmarks/track_posterior.py FOLDER [--patients 1 2 3] [--cell-size-mm 8] [--cheap] [--frames 3] [--workers 2]
        [--json]

FOLDER is that of benchmarks/track.py, which made patients and registrations. Each patient's atrium is meshed with linear cells
of --cell-size-mm (--cheap: quadratic ones, whose few runs correct those of linear cells); its targets (all features at
end-systole and in so many frames before it) are those tracked, and the true ones with the same covariance; the annulus moves as
tracked, and as it truly did. Nothing else differs. Calibrations are kept in FOLDER/patientNN/calibration and gone on with.

A shift is that of the posterior's mean from true to tracked motion, in standard deviations of the posterior from the true one:
where the stated errors are right and the targets tell far more than the prior, it is drawn from a standard normal distribution,
and its root mean square is 1; what is asked, 0.5, holds only where the numerics' errors, which both share, outweigh those of
tracking. Whether the parameters themselves are found is told, but asks too much: what was imaged is the simulated motion
smoothed over 2 mm, which no parameters give exactly (up to .2 mm of a region's normal motion, 1 % of the volume).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from track import true_values

import lacli
from lacli.calibration.sequential.result import Sequential
from lacli.calibration.sequential.search import Settings
from lacli.cli.terminal.console import print_json, print_table
from lacli.contracts.bundle import Bundle, load, save
from lacli.contracts.motion import Motion, load_motion, save_motion
from lacli.contracts.scene import build_scene
from lacli.contracts.targets import Targets
from lacli.motion import frames as framing
from lacli.motion.annulus import annulus_points
from lacli.motion.patient import Settings as Tracking
from lacli.motion.patient import Tracked, track
from lacli.motion.targets import measured
from lacli.synthetic.atrium import synthesize

ASKED = 0.5
_NEAREST = 4


def carried(motion: Motion, bundle: Bundle, coarse: Bundle) -> Motion:
    """The annulus's motion at another mesh's points: weighed by the inverse distance to the nearest ones."""
    ids = annulus_points(coarse)
    distance, near = cKDTree(bundle.points[motion.wall_point]).query(coarse.points[ids], k=_NEAREST)
    weight = 1.0 / np.maximum(distance, 1e-6)
    weight /= weight.sum(axis=1, keepdims=True)
    moved = np.einsum("nk,fnki->fni", weight, motion.displacement()[:, near])
    return Motion(motion.times, ids, coarse.points[ids] + moved, motion.es_time)


def tracked_of(folder: Path, bundle: Bundle) -> Tracked:
    """The patient's motion from the registrations that are kept."""
    sources = framing.find([folder / "frames"])
    times, _ = framing.cycle_times(sources, None)
    return track(bundle, sources, times, Tracking(), folder / "registration-greedy", lambda *_: None)


def calibrated(
    folder: Path, coarse: Bundle, motion: Motion, targets: Targets, choice: argparse.Namespace, seed: int
) -> tuple[Sequential, str]:
    """One calibration of the coarse atrium, and why it is refused (empty: it is not)."""
    bundle = folder / "bundle"
    if not (bundle / "wall.vtu").is_file():
        save(coarse, bundle)
        save_motion(motion, bundle)
    scene = build_scene(
        {"anatomy": {"bundle": str(bundle)}},
        [f"numerics.order={2 if choice.cheap else 1}"],
        folder=folder,
        where="track_posterior",
    )
    answer = lacli.calibrate(
        scene,
        targets,
        folder / "posterior",
        method="sequential",
        settings=Settings(seed=seed),
        workers=choice.workers,
        cheap=["order=1"] if choice.cheap else [],
    )
    assert isinstance(answer.result, Sequential)
    return answer.result, answer.refused


def patient(folder: Path, choice: argparse.Namespace) -> dict[str, Any]:
    """A row: shifts by input, the truth's place in both intervals, runs."""
    info = json.loads((folder / "gated.json").read_text())
    bundle = load(folder / "bundle")
    tracked = tracked_of(folder, bundle)
    times = [float(t) for t in tracked.course.times if 0.0 < t < tracked.course.phases.es - 0.02][-choice.frames :]
    seen_targets = measured(tracked.course, tracked.model, times)
    names, sd = seen_targets.targets.names, seen_targets.targets.sd
    values = true_values(names, folder)
    coarse, _ = synthesize(
        info["seed"], **{**info["atrium"], "cell_size_mm": choice.cell_size_mm, "order": 2 if choice.cheap else 1}
    )
    ring = annulus_points(bundle)
    seen = Motion(tracked.course.times, ring, tracked.course.positions[:, ring], tracked.course.phases.es)
    arms = {
        "true": (load_motion(folder / "bundle"), Targets(names, values, sd, seen_targets.covariance)),
        "tracked": (seen, Targets(names, seen_targets.targets.mean, sd, seen_targets.covariance)),
    }
    place = folder / "calibration" / f"{choice.cell_size_mm:g}mm{'_cheap' if choice.cheap else ''}"
    answers = {
        arm: calibrated(place / arm, coarse, carried(motion, bundle, coarse), targets, choice, info["seed"])
        for arm, (motion, targets) in arms.items()
    }
    rows = {arm: {str(r["input"]): r for r in found.table} for arm, (found, _) in answers.items()}
    shift: dict[str, float] = {}
    inside: dict[str, dict[str, bool]] = {arm: {} for arm in arms}
    for name, row in rows["true"].items():
        shift[name] = (float(rows["tracked"][name]["mean"]) - float(row["mean"])) / float(row["sd"])
        for arm in arms:
            low, high = (float(rows[arm][name][end]) for end in ("low95", "high95"))
            inside[arm][name] = bool(low <= info["parameters"][name] <= high)
    return {
        "patient": info["seed"], "targets": len(values), "shift_sd": shift, "inside": inside,
        "sd": {arm: {name: float(r["sd"]) for name, r in table.items()} for arm, table in rows.items()},
        "runs": {arm: found.runs for arm, (found, _) in answers.items()},
        "cpu_s": {arm: found.cpu_s for arm, (found, _) in answers.items()},
        "refused": {arm: why for arm, (_, why) in answers.items()},
    }  # fmt: skip


def main() -> None:
    """Calibrate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--patients", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--cell-size-mm", type=float, default=8.0)
    parser.add_argument("--cheap", action="store_true", help="linear cells corrected by few runs of quadratic ones")
    parser.add_argument("--frames", type=int, default=3, help="before end-systole, whose features are targets too")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    rows = []
    for seed in choice.patients:
        rows.append(patient((choice.folder / f"patient{seed:02d}").resolve(), choice))
        print(json.dumps(rows[-1]), flush=True)
    if choice.json:
        print_json({"asked": ASKED, "rows": rows})
        return
    shifts = np.array([list(row["shift_sd"].values()) for row in rows])
    within = {arm: [good for row in rows for good in row["inside"][arm].values()] for arm in ("true", "tracked")}
    table = [
        ["shift of the posterior's mean, sd: rms", f"<= {ASKED}", f"{np.sqrt((shifts**2).mean()):.2f}"],
        ["  largest; share within", f"<= {ASKED}", f"{np.abs(shifts).max():.2f}; {(np.abs(shifts) <= ASKED).mean():.0%}"],
        *(["truth inside 95 %, " + arm, "93 - 97 %", f"{sum(good)} of {len(good)}"] for arm, good in within.items()),
    ]
    for name, column in zip(rows[0]["shift_sd"], shifts.T, strict=True):
        table.append([f"  {name}", "", f"{np.sqrt((column**2).mean()):.2f}"])
    print_table(f"{len(rows)} patients, tracked against true motion", ["what", "asked", "measured"], table)


if __name__ == "__main__":
    main()
