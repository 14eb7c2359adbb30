"""Tracking against synthetic gated CT whose motion is known: asked beside measured.

    python benchmarks/track.py FOLDER [--patients 10] [--voxel-mm 1.0 1.0 1.0] [--order 1] [--from-seed 1] [--used-frames 4]

Patients and registrations that FOLDER holds already are used as they are: it goes on where it was ended. Prints a row a patient
as it is done, and the table at the end. --there: only patients that are there already.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lacli.anatomy.surface_features import Endocardium
from lacli.contracts.bundle import load
from lacli.contracts.features import family, kind_of, parse
from lacli.motion import frames as framing
from lacli.motion.errors import uncertainty
from lacli.motion.errors.shrinkage import shrinkage_of
from lacli.motion.patient import Settings, Tracked, track
from lacli.motion.targets import measured
from lacli.synthetic.cycle import draw_parameters
from lacli.synthetic.gated import Acquisition
from lacli.synthetic.gated_case import write_case


def patient(folder: Path, seed: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """Write, track and compare one patient."""
    if not (folder / "gated.json").is_file():
        atrium = {
            "volume_ml": arguments.volume_ml,
            "thickness_mm": 2.0, "cell_size_mm": arguments.cell_size_mm, "order": arguments.order,
            "descent_mm": 8.0,
        }  # fmt: skip
        acquisition = Acquisition(arguments.frames, tuple(arguments.voxel_mm))
        write_case(folder, seed, atrium, draw_parameters(seed), acquisition, 65.0, lambda *_: None)
    bundle = load(folder / "bundle")
    with np.load(folder / "truth" / "points.npz") as truth:
        point, positions = truth["point"], truth["positions"]
    sources = framing.find([folder / "frames"])
    times, _ = framing.cycle_times(sources, None)
    used = slice(None, arguments.used_frames)
    sources, times, positions = sources[used], times[used], positions[used]
    settings = Settings(arguments.engine, arguments.work_mm, known_motions=arguments.known_motions)
    start, wall = time.process_time(), time.monotonic()
    tracked = track(bundle, sources, times, settings, folder / f"registration-{arguments.engine}", lambda *_: None)
    found = measured(tracked.course, tracked.model)
    own = time.process_time() - start
    row = errors(tracked, point, positions, Endocardium.of(bundle))
    row |= {"seed": seed, "cpu_s": own + tracked.info["registration_cpu_s"], "wall_s": time.monotonic() - wall}
    row |= {"peak_mb": tracked.info["peak_memory_mb"], "between": float(np.mean(tracked.model.between))}
    row |= volume_error(tracked, folder)
    off = found.targets.mean - true_values(found.targets.names, folder)
    row["z"] = dict(zip(found.targets.names, (off / found.targets.sd).tolist(), strict=True))
    row["shrinkage"] = shrinkage(tracked, folder)
    row["chi2"] = float(off @ np.linalg.solve(found.covariance, off)) / len(off)
    return row


def errors(tracked: Tracked, point: Any, positions: Any, surface: Endocardium) -> dict[str, float]:
    """Mean error of the endocardium's points at the frame nearest ES and the worst over frames, mm; known motion's beside it."""
    means = []
    for x, truth in zip(tracked.course.positions, positions, strict=True):
        e = np.zeros_like(x)
        e[point] = x[point] - truth
        means.append(uncertainty.surface_error(surface, e))
    es = int(np.argmin(np.abs(tracked.course.times - tracked.course.phases.es)))

    def ratio(part: str) -> float:
        stated = np.mean([getattr(k, part)["global"] for _, k in tracked.known])
        return float(np.mean([getattr(m, part)["global"] for m in means[1:]]) / stated)

    return {
        "es": means[es].whole["global"], "es_normal": means[es].normal["global"], "es_tangential": means[es].tangential["global"],
        "worst": max(m.whole["global"] for m in means),
        "true_over_stated_normal": ratio("normal"), "true_over_stated_tangential": ratio("tangential"),
    }  # fmt: skip


def volume_error(tracked: Tracked, folder: Path) -> dict[str, float]:
    """Root mean square and largest error of the volume over frames, and of ESV, as shares of the EDV."""
    truth = pd.read_csv(folder / "truth" / "transients.csv")["volume_ml"].to_numpy()
    got = np.array([row["volume_ml"] for row in tracked.course.features])
    truth = truth[: len(got)]
    error = (got - truth) / truth[0]
    es = json.loads((folder / "truth" / "es.json").read_text())
    return {
        "volume_rms": float(np.sqrt(np.mean(error**2))),
        "volume_max": float(np.abs(error).max()),
        "esv": (tracked.course.phases.es_volume_ml - es["volume_ml"]) / truth[0],
        "es_time": tracked.course.phases.es - es["es_time"],
    }


def true_values(names: Sequence[str], folder: Path) -> NDArray[np.float64]:
    """(p,): the features' values of the true motion, at its own end-systole and at the frames' times."""
    frames = pd.read_csv(folder / "truth" / "transients.csv").set_index("time")
    es = json.loads((folder / "truth" / "es.json").read_text())
    values = []
    for name in names:
        key, (_, moment) = family(name), parse(name)
        values.append(es[key] if moment is None else frames.iloc[int(np.argmin(np.abs(frames.index - moment)))][key])
    return np.array(values, dtype=float)


def shrinkage(tracked: Tracked, folder: Path) -> dict[str, tuple[float, float]]:
    """By kind of feature: the share of a change that was found too much, truly and as known motions say."""
    said = tracked.model.shrinkage
    assert said is not None
    truth = pd.read_csv(folder / "truth" / "transients.csv")[list(said.keys)].to_numpy(float)
    surface = tracked.course.surface
    raw = np.array([[surface.features(x)[key] for key in said.keys] for x in tracked.course.positions])
    true = shrinkage_of(said.keys, raw[1:] - truth[1 : len(raw)], truth[1 : len(raw)] - truth[0])
    return {kind_of(key)[0]: (float(a), float(b)) for key, a, b in zip(said.keys, true.share, said.share, strict=True)}


def table(rows: list[dict[str, Any]]) -> None:
    """Asked beside measured."""
    z = pd.concat([pd.Series(row["z"], name=row["seed"]) for row in rows], axis=1)
    regional = z[[parse(name)[0].region is not None for name in z.index]]
    inside = float((regional.abs() <= 2).to_numpy().mean())
    kind = pd.Series({name: kind_of(parse(name)[0].key)[0] for name in z.index})

    def over(name: str, how: Any = np.max) -> float:
        return float(how([row[name] for row in rows]))

    print(f"{len(rows)} patients")
    for what, asked, got in (
        ("mean error at ES, mm (mean / worst patient)", "<= 0.3", f"{over('es', np.mean):.3f} / {over('es'):.3f}"),
        ("  along the normal, mm", "<= 0.1", f"{over('es_normal', np.mean):.3f} / {over('es_normal'):.3f}"),
        ("  tangential, mm", "<= 0.3", f"{over('es_tangential', np.mean):.3f} / {over('es_tangential'):.3f}"),
        ("worst frame's mean error, mm", "<= 0.25 at 0.45 mm", f"{over('worst', np.mean):.3f} / {over('worst'):.3f}"),
        ("regional targets within 2 sd", "93 - 97 %", f"{100 * inside:.1f} %"),
        ("chi^2 of all targets over their number", "1", f"{over('chi2', np.mean):.2f} / {over('chi2'):.2f}"),
        ("volume transient, rms / largest, % of EDV", "<= 1", f"{100 * over('volume_rms'):.2f} / {100 * over('volume_max'):.2f}"),
        ("CPU s / peak MB of an engine", "<= 300 / 3000 at 0.45 mm", f"{over('cpu_s'):.0f} / {over('peak_mb'):.0f}"),
        ("true over stated error, normal (mean)", "1", f"{over('true_over_stated_normal', np.mean):.2f}"),
        ("true over stated error, tangential (mean)", "1", f"{over('true_over_stated_tangential', np.mean):.2f}"),
    ):
        print(f"{what:48s} {asked:26s} {got}")
    print("share of a change that registration finds too much, %: truly, and as known motions say (means)")
    for name in rows[0]["shrinkage"]:
        true, said = np.mean([row["shrinkage"][name] for row in rows], axis=0)
        print(f"  {name:14s} {100 * true:.1f}  {100 * said:.1f}")
    print("rms of (value - truth) / sd and share within 2 sd, by kind of target:")
    for name, group in z.groupby(kind):
        values = group.to_numpy()
        print(f"  {name:14s} {np.sqrt((values**2).mean()):.2f}  {100 * (np.abs(values) <= 2).mean():.1f} %")


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--patients", type=int, default=10)
    parser.add_argument("--from-seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--voxel-mm", type=float, nargs=3, default=(1.0, 1.0, 1.0))
    parser.add_argument("--cell-size-mm", type=float, default=4.0)
    parser.add_argument("--volume-ml", type=float, help="of every atrium; default: each seed's own")
    parser.add_argument("--order", type=int, default=2)
    parser.add_argument("--engine", default="greedy")
    parser.add_argument("--work-mm", type=float, default=Settings.work_mm, help="voxels that are registered")
    parser.add_argument("--used-frames", type=int, help="only the first so many of each patient's")
    parser.add_argument("--known-motions", type=int, default=Settings.known_motions)
    parser.add_argument("--there", action="store_true", help="make no patient")
    arguments = parser.parse_args()
    rows = []
    for seed in range(arguments.from_seed, arguments.from_seed + arguments.patients):
        if arguments.there and not (arguments.folder / f"patient{seed:02d}" / "gated.json").is_file():
            continue
        rows.append(patient(arguments.folder / f"patient{seed:02d}", seed, arguments))
        shown = {k: round(v, 4) for k, v in rows[-1].items() if k not in ("z", "shrinkage")}
        print(json.dumps(shown), flush=True)
    table(rows)


if __name__ == "__main__":
    main()
