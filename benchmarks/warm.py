"""Warm starts against cold ones: factorisations, Newton steps, CPU seconds, and whether both end in the same features.

    python benchmarks/warm.py [--cell-size-mm 6] [--order 1] [--frames 0] [--points medium soft] [--steps .02 .1 .3]
        [--moves 3] [--seed 1] [--out DIR] [--json]

Synthetic atrium. At each point of `benchmarks/sensitivities.py` one run leaves its states; from there alpha of the five regions,
EDP, ESP, k_peri and PTH are moved at random, the farthest by the share of its range that is asked for, and run warm and cold.
Difference: the largest of the features' over the larger of the feature and 1 (mm, mL), at the scenes' own tolerance.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from prepared import prepared
from sensitivities import POINTS

from lacli.cli.terminal.console import print_json, print_table
from lacli.contracts.parameters import QUANTITIES
from lacli.contracts.scene import Scene, build_scene, with_parameters
from lacli.inference.box import OUTPUTS
from lacli.mechanics import warm
from lacli.mechanics.simulation import RunResult, run_scene

ASKED_FACTORS, ASKED_STEP, ASKED_LOST = 5, 0.1, 15
SAME = 2e-4  # of a feature: two tolerances (1e-4 mm) of the scenes
_MOVED = (*(f"alpha_{name}" for name in ("anterior", "posterior", "septum", "lateral", "roof")), "edp_mmhg", "esp_mmhg",
          "k_peri_kpa_per_um", "pth")  # fmt: skip


def moved(point: dict[str, float], step: float, rng: np.random.Generator) -> dict[str, float]:
    """The point with all inputs moved, the farthest by ``step`` of its range, those at its end backwards."""
    shares = rng.uniform(-1.0, 1.0, len(_MOVED))
    shares *= step / np.abs(shares).max()
    found = dict(point)
    for name, share in zip(_MOVED, shares, strict=True):
        quantity = QUANTITIES[name]
        assert quantity.study is not None
        low, high = quantity.study
        for sign in (1.0, -1.0):
            if quantity.log:
                value = point[name] * (high / low) ** (sign * share)
            else:
                value = point[name] + sign * share * (high - low)
            if low <= value <= high:
                found[name] = value
                break
    return found


def compared(scene: Scene, to: dict[str, float], states: Path, place: Path) -> dict[str, Any]:
    """The run at ``to`` cold, and warm from the run whose states are below ``states``."""
    there = with_parameters(scene, to)
    cold = run_scene(there, place / "cold")
    shutil.copytree(states / warm.FOLDER, place / "warm" / warm.FOLDER, dirs_exist_ok=True)
    other = run_scene(there, place / "warm", warm=True)
    start = other.manifest.get("start", {})
    row: dict[str, Any] = {"way": start.get("way", "cold"), "status": f"{cold.status}/{other.status}"}
    if "done" == cold.status == other.status:
        a, b = (np.array([run.features[name] for name in OUTPUTS]) for run in (cold, other))
        row["difference"] = float(np.max(np.abs(a - b) / np.maximum(1.0, np.abs(a))))
    lost = [said["newton"] for said in start.get("states", {}).values() if not said["accepted"]]
    for name, run in (("cold", cold), ("warm", other)):
        row |= {f"factors_{name}": factors(run), f"newton_{name}": run.features.get("newton_iterations")}
        row[f"cpu_s_{name}"] = run.manifest["cpu_s"]
    return row | {"lost_newton": sum(lost), "ed_modes": cold.features.get("ed_unstable_modes")}


def factors(run: RunResult) -> int | None:
    """Factorisations of a run, those of stability checks and derivatives (one each at end-diastole and end-systole, one of the
    prestrain's tangent) among them."""
    counted = run.features.get("factorisations")
    return int(counted) if counted is not None else None


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell-size-mm", type=float, default=6.0)
    parser.add_argument("--order", type=int, default=1, choices=(1, 2))
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--points", nargs="*", default=["medium", "soft"], choices=list(POINTS))
    parser.add_argument("--steps", nargs="*", type=float, default=[0.02, 0.1, 0.3])
    parser.add_argument("--moves", type=int, default=3, help="in random directions, of each step from each point")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="where runs are kept (and found again); else they are thrown away")
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory(prefix="lacli-warm-") as temporary:
        out = (choice.out or Path(temporary)).resolve()
        folder = prepared(out, choice.seed, choice.cell_size_mm)
        settings = [
            f"numerics.order={choice.order}",
            f"outputs.frames={choice.frames}",
            *("outputs.fields=none", "outputs.unloaded=false", "outputs.sensitivities=true", "numerics.engine=plugin"),
        ]
        scene = build_scene({"anatomy": {"bundle": str(folder)}}, settings, folder=folder, where="warm")
        for name in choice.points:
            states = out / f"{name}_{choice.order}_{choice.frames}"
            run_scene(with_parameters(scene, POINTS[name]), states, warm=True)
            if not (states / warm.FOLDER).is_dir():
                raise SystemExit(f"the run at {name} left no states: it has unstable modes")
            for step in choice.steps:
                rng = np.random.default_rng(choice.seed)
                for number in range(choice.moves):
                    place = states / f"{step:g}_{number}"
                    rows.append({"point": name, "step": step, **compared(scene, moved(POINTS[name], step, rng), states, place)})
    if choice.json:
        print_json({"rows": rows})
    else:
        columns = list(dict.fromkeys(key for row in rows for key in row))
        asked = (
            f"asked: {ASKED_FACTORS} factorisations or fewer at {ASKED_STEP:g}, differences of {SAME:g}, {ASKED_LOST} steps lost"
        )
        print_table(asked, columns, [[row.get(name) for name in columns] for row in rows])
    other = any(row.get("difference", 0.0) > SAME for row in rows)
    if other or any(row["lost_newton"] > ASKED_LOST for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
