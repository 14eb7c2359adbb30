"""Where end-diastole is unstable on real atria, what holds it, and which frames it spoils.

    python benchmarks/modes.py [--atria rodero 1 3] [--sizes 6 4] [--thickness-mm 2] [--set KEY=VALUE] [--record FILE]

An image's shape need not be a stable equilibrium under pressure alone. Each atrium (Rodero et al. 2021, case 01; numbers of the
shared files of `benchmarks/atria.py`) of each cell size and thickness is simulated with four frames as the deck does by default,
after end-diastole has settled into the nearest stable shape, and with springs on dents (``pericardium.dents``).
Printed: unstable modes by default and with springs on dents; how far the wall settles, root of the mean square and at most (mm);
which share of that (of its square, over the outer surface) lies where this is concave (springs on dents would be more than half
on) and within 5 mm of a rim, beside these places' shares of the area; and what settling first changes, in the worst region, of
the displacements at quarters of the filling and at end-systole (mm), next to what springs on dents change there.
"""

from __future__ import annotations

import argparse
import itertools
import json
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
import real_atrium
import records
from scipy.spatial import cKDTree

import lacli
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle
from lacli.contracts.features import at_time
from lacli.contracts.labels import EPI, REGIONS, is_plane
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import build_scene
from lacli.mechanics.inputs import dent_weight
from lacli.mechanics.results import features_at_times
from lacli.mechanics.simulation import RunResult, run_scene
from lacli.motion.annulus import descend

ATRIA = Path(__file__).resolve().parents[2] / "shared" / "data" / "atria"
WAYS = {"own": (), "settled": ("numerics.settle_ed=true",), "dents": ("pericardium.dents=true",)}
TIMES = (0.25, 0.5, 0.75, 1.0)  # of end-systole's
RIM_MM, HELD = 5.0, 0.5
FEATURES = [f"d_{name}_mm" for name in ("global", *REGIONS)]


@dataclass(frozen=True)
class Row:
    """An atrium at a cell size (mm) and thickness (mm); ways that ended; unstable modes; mm and shares as printed; the worst
    changes (mm) at each of TIMES; CPU s of each way; the --set."""

    atrium: str
    size_mm: float
    thickness_mm: float
    ends: dict[str, str]
    modes: dict[str, int]
    settled_mean_mm: float
    settled_max_mm: float
    in_dents: float
    dents_area: float
    at_rims: float
    rims_area: float
    settled_changes_mm: list[float]
    dents_changes_mm: list[float]
    cpu_s: dict[str, float]
    overrides: list[str]


def made(name: str, size: float, thickness: float, out: Path) -> Path:
    """The atrium's bundle, made once, with a mitral annulus that comes down by 8 mm."""
    folder = out / f"{name}_{size:g}mm_{thickness:g}"
    if folder.is_dir():
        return folder
    if name == "rodero":
        mesh, surfaces, names = (real_atrium.DATA / file for file in real_atrium.FILES)
        bundle = real_atrium.read_tagged(mesh, surfaces, names, size, order=2, thickness_mm=thickness)
        bundles.save(bundle, folder)
    else:
        truths = json.loads((ATRIA / "truth.json").read_text(encoding="utf-8"))
        (truth,) = (t for t in truths if Path(t["file"]).stem == f"atrium_{int(name):02d}")
        known = {key: value for key, value in truth["args"].items() if key in ("la", "lv")}
        unit = truth["args"].get("units")
        lacli.mesh(ATRIA / truth["file"], folder, cell_size_mm=size, thickness_mm=thickness, unit=unit, **known)
        bundle = bundles.load(folder)
    save_motion(descend(bundle, descent_mm=8.0, circumference_change=0.0), folder)
    return folder


def nodal_areas(bundle: Bundle) -> np.ndarray:
    """Area (n,) mm^2 of the outer surface that is nearest to each node, by its corner triangles."""
    outer = bundle.triangles[bundle.tags == EPI][:, :3]
    p = bundle.points[outer]
    third = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) / 6.0
    return np.bincount(outer.ravel(), np.repeat(third, 3), minlength=len(bundle.points))


def places(bundle: Bundle) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (n,) of the outer surface that are in a dent; nodes (n,) near a rim."""
    held = dent_weight(bundle)[bundle.tags == EPI].mean(axis=1) > HELD
    dents = np.zeros(len(bundle.points), dtype=bool)
    dents[bundle.triangles[bundle.tags == EPI][held][:, :3]] = True
    planes = np.unique(bundle.triangles[is_plane(bundle.tags)][:, :3])
    rim = np.intersect1d(planes, np.unique(bundle.triangles[~is_plane(bundle.tags)][:, :3]))
    distance, _ = cKDTree(bundle.points[rim]).query(bundle.points)
    return dents, distance < RIM_MM


def changes(one: RunResult, other: RunResult) -> list[float]:
    """The worst difference (mm) of the regions' displacements at each of TIMES."""
    (first, es), (second, _) = features_at_times(one.folder), features_at_times(other.folder)
    return [max(abs(first[name] - second[name]) for key in FEATURES if (name := at_time(key, t * es)) in first) for t in TIMES]


def measured(name: str, size: float, thickness: float, overrides: list[str], out: Path) -> Row:
    """All ways of one atrium, and what they tell."""
    folder = made(name, size, thickness, out)
    bundle = bundles.load(folder)
    runs = {}
    for way, words in WAYS.items():
        settings = [
            "outputs.frames=4",
            "outputs.fields=es",
            "outputs.unloaded=false",
            "numerics.timeout_s=3600",
            *words,
            *overrides,
        ]
        scene = build_scene({"anatomy": {"bundle": str(folder.resolve())}}, settings, folder=folder, where="modes")
        runs[way] = run_scene(scene, out / "runs")
    ended = {way: run for way, run in runs.items() if run.status == "done"}
    nothing, none = float("nan"), [float("nan")] * len(TIMES)
    area, (dents, rims) = nodal_areas(bundle), places(bundle)
    mean = most = in_dents = at_rims = nothing
    if "settled" in ended:
        there = meshio.read(ended["settled"].folder / "fields" / "ed.vtu").points
        moved = np.linalg.norm(there - bundle.points, axis=1) ** 2 * area
        mean, most = np.sqrt(moved.sum() / area.sum()), np.linalg.norm(there - bundle.points, axis=1).max()
        in_dents, at_rims = (moved[place].sum() / max(moved.sum(), 1e-30) for place in (dents, rims))
    return Row(
        name, size, thickness, {way: run.kind or "done" for way, run in runs.items()},
        {way: int(run.features.get("ed_unstable_modes", -1)) for way, run in ended.items()},
        float(mean), float(most), float(in_dents), float(area[dents].sum() / area.sum()),
        float(at_rims), float(area[rims].sum() / area.sum()),
        changes(ended["own"], ended["settled"]) if {"own", "settled"} <= set(ended) else none,
        changes(ended["own"], ended["dents"]) if {"own", "dents"} <= set(ended) else none,
        {way: float(run.manifest.get("cpu_s", nothing)) for way, run in runs.items()}, overrides,
    )  # fmt: skip


def main() -> None:
    """Make, run, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--atria", nargs="+", default=["rodero", "1", "3"])
    parser.add_argument("--sizes", type=float, nargs="+", default=[6.0, 4.0])
    parser.add_argument("--thickness-mm", type=float, nargs="+", default=[2.0])
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--out", type=Path, default=Path("results/modes"))
    parser.add_argument("--record", type=Path, help="file of rows, to go on with")
    choice = parser.parse_args()
    if not ATRIA.is_dir():
        raise SystemExit(f"{ATRIA}: no such folder; the files of `benchmarks/atria.py` are not here.")
    rows = records.read(choice.record, Row)
    print("atrium  cells wall  unstable: own dents   settles mm: rms  max   in dents (area)  at rims (area)   "
          "settling changes at 1/4 1/2 3/4 ES | dents change, mm   CPU s", flush=True)  # fmt: skip
    for name, size, thickness in itertools.product(choice.atria, choice.sizes, choice.thickness_mm):
        asked = (name, size, thickness, choice.overrides)
        kept = [r for r in rows if (r.atrium, r.size_mm, r.thickness_mm, r.overrides) == asked]
        row = kept[0] if kept else measured(name, size, thickness, choice.overrides, choice.out)
        if not kept:
            records.add(choice.record, row)
        cost = " ".join(f"{w} {s:.0f}" + ("" if row.ends[w] == "done" else f" {row.ends[w]}") for w, s in row.cpu_s.items())
        settled, dents = (" ".join(f"{v:.3f}" for v in of) for of in (row.settled_changes_mm, row.dents_changes_mm))
        print(
            f"{name:7s} {size:4g} {thickness:4g}   {row.modes.get('own', -1):6d} {row.modes.get('dents', -1):6d}   "
            f"{row.settled_mean_mm:.2f} {row.settled_max_mm:.1f}   {row.in_dents:.2f} ({row.dents_area:.2f})   "
            f"{row.at_rims:.2f} ({row.rims_area:.2f})   {settled} | {dents}   {cost}", flush=True,
        )  # fmt: skip


if __name__ == "__main__":
    main()
