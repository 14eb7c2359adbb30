"""The coefficients of `lacli/mechanics/numerics/cost.py` from runs that were kept, and what its forecasts are worth on them.

    python benchmarks/cost_fit.py RUNS [RUNS ...] [--json]

RUNS: folders of finished runs, each with its scene, however deep below; warm starts and FreeFEM's own language are left out.
Told are, by order, CPU seconds against the price of the systems that were solved (the machine's speed, and the spread that the
form of the price leaves); of the number of systems the least squares of its logarithm, each bundle and order counting the same,
and what states before end-systole add to the other constants; and how far forecasts are off as the constants stand, and as
fitted without the bundle that is foretold.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError
from lacli.cli.terminal.console import print_table
from lacli.contracts.scene import Scene, load_scene
from lacli.mechanics.numerics.cost import early_states, price, softest_kpa, systems

ALONE = {"frames": 0, "times": ()}
COEFFICIENTS = ("constant", "softest", "EDP", "ESP", "quadratic", "early states", "early states, by softest")


@dataclass(frozen=True)
class Kept:
    """A run: its scene, unknowns, linear systems, CPU seconds; ``of``: its bundle and order."""

    scene: Scene
    unknowns: int
    solved: int
    cpu_s: float
    of: str


def kept(folder: Path) -> Iterator[Kept]:
    """The finished runs below a folder."""
    for file in sorted(folder.rglob("manifest.json")):
        try:
            told = json.loads(file.read_text(encoding="utf-8"))
            features = json.loads(file.with_name("features.json").read_text(encoding="utf-8"))
            scene = load_scene(file.with_name("scene.toml"))
            if told["status"] != "done" or told["engine"] != "plugin" or told.get("start", {}).get("way") == "warm":
                continue
            solved, seconds, count = int(told["newton_iterations"]), float(told["cpu_s"]), int(features["unknowns"])
        except (OSError, ValueError, KeyError, TypeError, LacliError):
            continue  # of an earlier version, or being written
        if solved > 0 and seconds > 0 and scene.numerics.unloading == "prestrain" and not scene.numerics.rest_sweeps:
            yield Kept(scene, count, solved, seconds, f"{scene.anatomy.bundle} {scene.numerics.order}")


def design(runs: list[Kept]) -> FloatArray:
    """(n, 7): what the logarithm of the number of systems is linear in, in the order of ``COEFFICIENTS``."""
    rows = []
    for run in runs:
        scene, loads = run.scene, run.scene.loads
        soft, early = math.log(softest_kpa(scene)), math.log(1 + early_states(scene))
        pressures = math.log(max(loads.edp_mmhg, 1.0)), math.log(loads.esp_mmhg)
        rows.append([1.0, soft, *pressures, float(scene.numerics.order == 2), early, early * soft])
    return np.array(rows)


def fitted(a: FloatArray, y: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted least squares."""
    root = np.sqrt(weight)
    return np.asarray(np.linalg.lstsq(a * root[:, None], y * root, rcond=None)[0])


def of_early_states(runs: list[Kept], weight: FloatArray) -> tuple[float, float]:
    """a and b of (1 + states)^(a - b ln softest), no less than 1: least squares beside the other constants as they stand."""
    states = np.log([1 + early_states(run.scene) for run in runs])
    soft = np.log([softest_kpa(run.scene) for run in runs])
    end_systole_alone = [run.scene.model_copy(update={"outputs": run.scene.outputs.model_copy(update=ALONE)}) for run in runs]
    more = np.log([run.solved for run in runs]) - np.log([systems(scene) for scene in end_systole_alone])
    root = np.sqrt(weight)
    found = least_squares(lambda p: root * (np.maximum(0.0, p[0] - p[1] * soft) * states - more), [0.4, 0.4])
    return float(found.x[0]), float(found.x[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    runs = [run for folder in choice.runs for run in kept(folder)]
    groups = sorted({run.of for run in runs})
    if len(groups) < 2:
        raise SystemExit("runs on two bundles, or of two orders, are needed at least.")
    group = np.array([groups.index(run.of) for run in runs])
    weight = 1.0 / np.bincount(group)[group]
    speed = np.log([run.cpu_s / price(run.scene, run.unknowns, run.solved) for run in runs])
    solved = np.log([run.solved for run in runs])
    a = design(runs)
    left_out = np.empty(len(runs))
    for one in range(len(groups)):
        here = group == one
        left_out[here] = a[here] @ fitted(a[~here], solved[~here], weight[~here])
    off = {
        "by the constants": solved - np.log([systems(run.scene) for run in runs]),
        "fitted to other bundles": solved - left_out,
    }

    def told(values: FloatArray, which: FloatArray) -> list[float]:
        w = weight[which] / weight[which].sum()
        v = values[which]
        mean = float(w @ v)
        return [mean, float(np.sqrt(w @ (v - mean) ** 2)), 100.0 * float(w @ (np.abs(np.expm1(-v)) <= 0.25))]

    order = np.array([run.scene.numerics.order for run in runs])
    everywhere = {"linear": order == 1, "quadratic": order == 2, "all": order > 0}
    coefficients = dict(zip(COEFFICIENTS, fitted(a, solved, weight).tolist(), strict=True))
    head = ["what", "cells", "mean of ln (true / foretold)", "sd", "within 25 % (%)"]
    rows = [["CPU s, given the systems", name, *told(speed, which)] for name, which in everywhere.items() if which.any()]
    rows += [[f"systems, {how}", n, *told(v, which)] for how, v in off.items() for n, which in everywhere.items() if which.any()]
    early = {}
    for name, which in everywhere.items():
        if which.any() and name != "all":
            early[name] = of_early_states([run for run, here in zip(runs, which, strict=True) if here], weight[which])
    if choice.json:
        forecasts = [dict(zip(head, row, strict=True)) for row in rows]
        print(json.dumps({"runs": len(runs), "coefficients": coefficients, "early": early, "forecasts": forecasts}))
        return
    title = f"{len(runs)} runs, {len(groups)} bundles and orders"
    print_table(title, ["ln systems", "coefficient"], [[name, value] for name, value in coefficients.items()])
    print_table(
        "States before end-systole: (1 + states)^(a - b ln softest)", ["cells", "a", "b"], [[n, *ab] for n, ab in early.items()]
    )
    print_table("Forecasts", head, rows)


if __name__ == "__main__":
    main()
