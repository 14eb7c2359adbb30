"""Whether simulations end at the extremes of the study's box, on walls of several thicknesses, and why those that do not.

    python benchmarks/extremes.py [--anatomies wall2 wall1 wall4 real] [--kinds corner sobol] [--most N] [--record FILE]

Corners: 64 of the calibration's box of 9 inputs, a fraction of the 512 in which any three inputs take all their combinations
equally often (2^(9-3), resolution IV); ``--all``: the 512. Sobol' points: 64 with all 14 inputs. They come in random order, so
that a part of them is a sample. With ``--record`` what is done is kept, a line each, and a later call goes on.

Asked: each ends or says why, 98 % end, the longest takes no more than ten times the processor time of the median.
"""

from __future__ import annotations

import argparse
import itertools
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import real_atrium
import records
from scipy.stats import qmc

from lacli.contracts import bundle as bundles
from lacli.contracts.failures import SCENE
from lacli.contracts.motion import save_motion
from lacli.contracts.parameters import parameter_box
from lacli.contracts.scene import build_scene, with_parameters
from lacli.inference.box import CALIBRATION_INPUTS
from lacli.mechanics.execute import run_scenes
from lacli.synthetic.atrium import synthesize

ENDED, RATIO = 0.98, 10.0  # asked
WORST = 10  # are listed with what the solver did
# of the factors 1 - 6; the defining words have four letters at least (Box, Hunter & Hunter, 2005, table 6.22)
GENERATORS = ((0, 1, 2, 3), (0, 2, 4, 5), (1, 3, 4, 5))
ANATOMIES = {"wall1": 1.0, "wall2": 2.0, "wall4": 4.0}


@dataclass(frozen=True)
class Row:
    """A run: anatomy, kind of point and its number; how it ended ("done" or the failure's kind and message); cost; what the
    solver did, by phase; unstable modes and distance from the image (mm) at end-diastole; the inputs by name."""

    anatomy: str
    kind: str
    number: int
    end: str
    message: str
    cpu_s: float
    newton: int
    did: str
    modes_ed: int
    modes_es: int
    shape_mm: float
    values: dict[str, float]


def corners(whole: bool) -> np.ndarray:
    """(64, 9), or (512, 9): 0 where an input is at its lower end, 1 at the upper."""
    base = np.array(list(itertools.product((0, 1), repeat=9 if whole else 6)))
    rows = base if whole else np.column_stack([base, *(base[:, list(word)].sum(axis=1) % 2 for word in GENERATORS)])
    for three in itertools.combinations(range(9), 3):
        assert len(set(Counter(map(tuple, rows[:, list(three)])).values())) == 1
    return rows.astype(float)


def points(kind: str, whole: bool) -> list[dict[str, float]]:
    """The inputs by name, in random but fixed order."""
    if kind == "corner":
        box, unit = parameter_box(list(CALIBRATION_INPUTS)), corners(whole)
    else:
        box = parameter_box()
        unit = qmc.Sobol(len(box), seed=1).random(64)
    low, high = np.array(list(box.values())).T
    rows = (low + unit * (high - low))[np.random.default_rng(1).permutation(len(unit))]
    return [dict(zip(box, map(float, row), strict=True)) for row in rows]


def made(name: str, size: float, out: Path) -> Path:
    """The anatomy's bundle, made once."""
    folder = out / f"{name}_{size:g}mm"
    if name == "real":
        return real_atrium.made(real_atrium.DATA, size, folder)
    if not folder.is_dir():
        bundle, motion = synthesize(1, None, thickness_mm=ANATOMIES[name], cell_size_mm=size)
        bundles.save(bundle, folder)
        save_motion(motion, folder)
    return folder


def did(log: Path) -> str:
    """Newton steps by phase (v: viscous ones among them), and what was tried again, of a solver's log."""
    if not log.is_file():
        return ""
    steps: dict[str, Counter[str]] = {}
    again: Counter[str] = Counter()
    for line in log.read_text(errors="replace").splitlines():
        if found := re.match(r"@ progress phase=(\w+) .*viscosity=(\S+)", line):
            count = steps.setdefault(found[1], Counter())
            count["all"] += 1
            count["viscous"] += float(found[2]) > 0
        elif found := re.match(r"@ retry phase=(\w+) kind=(\w+) rung=(\w+)", line):
            again[f"{found[1]} {found[2]} -> {found[3]}"] += 1
    words = [f"{phase} {c['all']}" + (f" ({c['viscous']} v)" if c["viscous"] else "") for phase, c in steps.items()]
    return ", ".join(words + [f"{n} x {what}" for what, n in again.items()])


def summary(rows: list[Row]) -> None:
    """By anatomy and kind: how many ended, their cost; the longest runs with what the solver did."""
    print(f"\n{'anatomy':8s} {'points':8s} {'ended':>12s} {'explained':>10s} {'CPU s median':>13s} {'worst':>7s} {'ratio':>6s} "
          f"{'ED unstable':>12s} {'ED off mm':>10s}")  # fmt: skip
    for key in dict.fromkeys((r.anatomy, r.kind) for r in rows):
        mine = [r for r in rows if (r.anatomy, r.kind) == key]
        done = [r for r in mine if r.end == "done"]
        named = sum(r.end in SCENE for r in mine if r.end != "done")
        cost = np.array([r.cpu_s for r in mine])
        shape = f"{np.median([r.shape_mm for r in done]):10.2f}" if done else ""
        print(f"{key[0]:8s} {key[1]:8s} {len(done):5d} of {len(mine):3d} {named:4d} of {len(mine) - len(done):2d} "
              f"{np.median(cost):13.0f} {cost.max():7.0f} {cost.max() / np.median(cost):6.1f} "
              f"{sum(r.modes_ed > 0 for r in done):5d} of {len(done):3d} {shape}")  # fmt: skip
    print("\nthe longest, and those that did not end:")
    longest = sorted(rows, key=lambda r: -r.cpu_s)[:WORST]
    for r in longest + [r for r in rows if r.end != "done" and r not in longest]:
        values = ", ".join(f"{key} {value:.3g}" for key, value in r.values.items())
        print(f"{r.anatomy} {r.kind} {r.number}: {r.end} {r.message}, {r.cpu_s:.0f} CPU s, {r.did}  [{values}]")
    share = sum(r.end == "done" for r in rows) / max(len(rows), 1)
    print(f"\n{100 * share:.1f} % of {len(rows)} ended (asked {100 * ENDED:g} %); longest over median asked {RATIO:g} at most")


def main() -> None:
    """Run what is not in the record yet, and sum up all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomies", nargs="+", choices=[*ANATOMIES, "real"], default=[*ANATOMIES, "real"])
    parser.add_argument("--kinds", nargs="+", choices=["corner", "sobol"], default=["corner", "sobol"])
    parser.add_argument("--all", action="store_true", help="the 512 corners")
    parser.add_argument("--most", type=int, help="simulations of each anatomy and kind, this time's and earlier ones'")
    parser.add_argument("--cell-size-mm", type=float, default=4.0)
    parser.add_argument("--order", type=int, default=2)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/extremes"))
    parser.add_argument("--record", type=Path, help="file of rows, to go on with")
    choice = parser.parse_args()
    settings = [f"numerics.order={choice.order}", "outputs.fields=none", "outputs.unloaded=false", "numerics.timeout_s=3600"]
    rows = records.read(choice.record, Row)
    for name, kind in itertools.product(choice.anatomies, choice.kinds):
        folder = made(name, choice.cell_size_mm, choice.out)
        base = build_scene({"anatomy": {"bundle": str(folder.resolve())}}, settings, folder=folder, where="extremes")
        wanted = list(enumerate(points(kind, choice.all)))[: choice.most]
        left = [(n, v) for n, v in wanted if not any((r.anatomy, r.kind, r.values) == (name, kind, v) for r in rows)]
        scenes = [with_parameters(base, values) for _, values in left]
        for index, result in run_scenes(scenes, choice.out / "runs", workers=choice.workers):
            f, (number, values) = result.features, left[index]
            row = Row(name, kind, number, result.kind or "done", result.message, float(result.manifest.get("cpu_s", np.nan)),
                      int(f.get("newton_iterations", 0)), did(result.folder / "solver.log"), int(f.get("ed_unstable_modes", 0)),
                      int(f.get("es_unstable_modes", 0)), float(f.get("ed_shape_error_mean_mm", 0.0)), values)  # fmt: skip
            rows.append(row)
            records.add(choice.record, row)
            print(f"{name} {kind} {number:3d} {row.end:20s} {row.cpu_s:6.0f} CPU s  {row.message} {row.did}", flush=True)
    summary(rows)


if __name__ == "__main__":
    main()
