"""Does the way to a state decide which equilibrium is found? The same scenes solved along several ways, and what differs.

    python benchmarks/branches.py [--anatomies real wall1 wall2] [--points 8] [--cell-size-mm 4] [--order 2] [--record FILE]

Points: a Sobol' sequence over the calibration's box with every stiffness in the softer half of its range, where walls give way in
places and end-diastole may be unstable. Ways: the deck's own, to end-systole at once and to three frames from it backward; the
same from an end-diastole that was settled into a stable shape first; upward from end-diastole in four parts, and in eight. Beside
them the deck's own with ``outputs.equilibria``, which looks for a second end-systole itself.
Printed by point: unstable modes at end-diastole, the spread (largest difference between ways) of the features at end-systole,
what the run told of it, and the spread in the frames that all share.

Asked: the spread told, and what frames can be trusted.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import records
from extremes import ANATOMIES, made
from scipy.stats import qmc

from lacli.contracts.case import Plan
from lacli.contracts.features import at_time
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.parameters import parameter_box
from lacli.contracts.scene import build_scene, with_parameters
from lacli.inference.box import CALIBRATION_INPUTS
from lacli.mechanics import plan
from lacli.mechanics.results import features_at_times
from lacli.mechanics.simulation import run_scene

# what a scene is asked, and whether it is solved upward
WAYS = {
    "own": (("outputs.frames=4",), False),
    "settled": (("outputs.frames=4", "numerics.settle_ed=true"), False),
    "four up": (("outputs.frames=4",), True),
    "eight up": (("outputs.frames=8",), True),
    "told": (("outputs.frames=4", "outputs.equilibria=true"), False),
}
TOLD = "told"  # what the other ways are held against
KEYS = ("d_global_mm", *(f"{kind}_{region}_mm" for kind in "dnab" for region in BODY_REGIONS))
SHARED = (0.25, 0.5, 0.75)  # of end-systole's time: the frames of all ways
SAME_MM = 0.001


@dataclass(frozen=True)
class Row:
    """A run: anatomy, point, way; how it ended; cost, systems; unstable modes at end-diastole; ESV (mL); features (mm) at
    end-systole, and in the frames by ``key@time``; of a run that sought two equilibria how many it found, and how far apart (mm,
    mL)."""

    anatomy: str
    number: int
    way: str
    end: str
    cpu_s: float
    systems: int
    modes: int
    esv_ml: float
    es: dict[str, float]
    frames: dict[str, float]
    found: int = -1
    told_mm: float = float("nan")
    told_ml: float = float("nan")


@contextlib.contextmanager
def upward() -> Iterator[None]:
    """Plans whose phases go through the states in order of time, each from the one before; for the time being."""
    made = plan.make_plan

    def forward(*given: Any) -> Plan:
        whole = made(*given)
        load = [phase for phase in whole.phases if phase.name == "load"]
        states = sorted(whole.stretches(), key=lambda phase: phase.time_to)
        ways = [
            replace(one, start=before.file, pressure_from=before.pressure_to, time_from=before.time_to)
            for before, one in itertools.pairwise([*load, *states])
        ]
        return replace(whole, phases=(*load, *ways))

    plan.make_plan = forward  # type: ignore[assignment]
    try:
        yield
    finally:
        plan.make_plan = made


def soft(count: int) -> list[dict[str, float]]:
    """The inputs by name."""
    box = parameter_box(list(CALIBRATION_INPUTS))
    low, high = np.array(list(box.values())).T
    stiff = np.array([name.startswith("alpha_") for name in box])
    high = np.where(stiff, low + 0.5 * (high - low), high)
    unit = qmc.Sobol(len(box), seed=3).random(1 << (count - 1).bit_length())[:count]
    return [dict(zip(box, map(float, row), strict=True)) for row in low + unit * (high - low)]


def spread(rows: list[dict[str, float]]) -> tuple[float, str]:
    """The largest difference between any two, mm, and of which feature; NaN of fewer than two."""
    names = sorted(set.intersection(*(set(row) for row in rows))) if len(rows) > 1 else []
    if not names:
        return float("nan"), ""
    wide = np.ptp([[row[name] for name in names] for row in rows], axis=0)
    return float(wide.max()), names[int(wide.argmax())]


def summary(rows: list[Row]) -> None:
    """By point, then over all."""
    heads = (("ES spread mm", 13), ("ESV mL", 8), ("told mm", 9), ("mL", 8), ("frames mm", 10))
    print(f"{'anatomy':8s}{'point':>6s}{'ED modes':>9s}" + "".join(f"{word:>{width}s}" for word, width in heads) + "  widest")
    of_es, of_frames, told = [], [], []
    for (anatomy, number), group in itertools.groupby(rows, key=lambda r: (r.anatomy, r.number)):
        mine = list(group)
        done = [r for r in mine if r.end == "done" and r.way != TOLD]
        es, _ = spread([r.es for r in done])
        frames, name = spread([r.frames for r in done if r.frames])
        volume = float(np.ptp([r.esv_ml for r in done])) if len(done) > 1 else float("nan")
        failed = ", ".join(f"{r.way}: {r.end}" for r in mine if r.end != "done")
        asked = next((r for r in mine if r.way == TOLD and r.end == "done"), None)
        mm, ml = (asked.told_mm, asked.told_ml) if asked else (float("nan"), float("nan"))
        print(f"{anatomy:8s}{number:6d}{max(r.modes for r in mine):9d}{es:13.4f}{volume:8.4f}{mm:9.4f}{ml:8.4f}{frames:10.4f}  "
              f"{name} {failed}")  # fmt: skip
        if asked and np.isfinite(es):
            told.append((es > SAME_MM, asked.found == 2, asked.found == 0))
        of_es.append(es)
        of_frames.append(frames)
    for what, found in (("end-systole", np.array(of_es)), ("frames", np.array(of_frames))):
        known = found[np.isfinite(found)]
        if len(known):
            differ = int((known > SAME_MM).sum())
            print(f"{what}: the way decides at {differ} of {len(known)} points, by {known.max():.3f} mm at most")
    if told:
        apart, two, nowhere = np.array(told).T
        found_there, found_else = int((apart & two).sum()), int((two & ~apart).sum())
        print(
            f"told by the run itself: {found_there} of {int(apart.sum())} points where ways differ, {found_else} of "
            f"{int((~apart).sum())} others; {int(nowhere.sum())} second ways ended nowhere"
        )
    for anatomy in dict.fromkeys(r.anatomy for r in rows):
        of = {way: [r for r in rows if (r.anatomy, r.way) == (anatomy, way)] for way in WAYS}
        words = [f"{way} {sum(r.systems for r in m)} ({sum(r.cpu_s for r in m):.0f})" for way, m in of.items()]
        print(f"{anatomy}: systems (CPU s): " + ", ".join(words))


def main() -> None:
    """Run what is not in the record yet, and sum up all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomies", nargs="+", choices=[*ANATOMIES, "real"], default=["real", "wall1", "wall2"])
    parser.add_argument("--points", type=int, default=8)
    parser.add_argument("--cell-size-mm", type=float, default=4.0)
    parser.add_argument("--order", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("results/branches"))
    parser.add_argument("--record", type=Path, help="file of rows, to go on with")
    choice = parser.parse_args()
    rows = records.read(choice.record, Row)
    for anatomy in choice.anatomies:
        folder = made(anatomy, choice.cell_size_mm, choice.out)
        jobs = [job for job in itertools.product(range(choice.points), WAYS) if not any(_is(r, anatomy, *job) for r in rows)]
        values = soft(choice.points)
        settings = [f"numerics.order={choice.order}", "outputs.fields=none", "outputs.unloaded=false", "numerics.timeout_s=1800"]
        for number, way in jobs:
            asked, up = WAYS[way]
            document = {"anatomy": {"bundle": str(folder.resolve())}}
            base = build_scene(document, [*settings, *asked], folder=folder, where="branches")
            with upward() if up else contextlib.nullcontext():
                result = run_scene(with_parameters(base, values[number]), choice.out / ("up" if up else "runs"))
            f = result.features
            frames: dict[str, float] = {}
            if f:
                found, es = features_at_times(result.folder)
                frames = {name: found[name] for key in KEYS for t in SHARED if (name := at_time(key, t * es)) in found}
            row = Row(anatomy, number, way, result.kind or "done", float(result.manifest.get("cpu_s", np.nan)),
                      int(f.get("factorisations", f.get("newton_iterations", 0))),
                      int(f.get("ed_unstable_modes", 0)), float(f.get("esv_ml", np.nan)),
                      {key: float(f[key]) for key in KEYS if key in f}, frames, *_told(f))  # fmt: skip
            rows.append(row)
            records.add(choice.record, row)
            print(f"{anatomy} {number} {way}: {row.end}, {row.cpu_s:.0f} CPU s, ESV {row.esv_ml:.4f} mL", flush=True)
    order = [*ANATOMIES, "real"]
    summary(sorted(rows, key=lambda r: (order.index(r.anatomy), r.number)))


def _told(features: dict[str, Any]) -> tuple[int, float, float]:
    """How many equilibria the run says that it found (-1: not asked), and how far they are apart in KEYS (mm) and volume (mL)."""
    spread = features.get("equilibria_spread", {})
    known = [spread[key] for key in KEYS if key in spread]
    return (
        int(features.get("equilibria", {}).get("found", -1)),
        max(known, default=float("nan")),
        spread.get("esv_ml", float("nan")),
    )


def _is(row: Row, anatomy: str, number: int, way: str) -> bool:
    return (row.anatomy, row.number, row.way) == (anatomy, number, way)


if __name__ == "__main__":
    main()
