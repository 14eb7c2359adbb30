"""The coefficients of `lacli/mechanics/numerics/cost.py` from runs that were kept, and what its forecasts are worth on them.

    python benchmarks/cost_fit.py RUNS [RUNS ...] [--json]

RUNS: folders of finished runs, each with its scene, however deep below; left out are warm starts, FreeFEM's own language and runs
that sought a second way to end-systole. Told are, by order, CPU seconds against the price of the systems that were solved (the
machine's speed, and the spread that the form of the price leaves); of the number of systems the robust least squares of its
logarithm, and the Gaussian process of what it leaves; and how far forecasts are off: systems as the constants
stand, and as fitted without the bundle that is foretold; CPU seconds so too, with the machine's speed as the bundle's runs of the
order have it in the middle, and by the constants, from that speed alone and from ten other runs of the bundle.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError
from lacli.cli.terminal.console import print_table
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle
from lacli.contracts.scene import Scene, load_scene
from lacli.mechanics.numerics.cost import Earlier, early_states, expected, laplace, price, scaled_inputs, slenderness, systems

COEFFICIENTS = ("constant", "Laplace", "quadratic", "early states")
PROCESS = ("sd", "length", "between orders", "between anatomies", "scatter")
_FAR = 0.35  # of the logarithm: runs further from the middle count less, for snapping through is no matter of the middle
_STORE = 10  # runs of a bundle that are there before one is foretold


@dataclass(frozen=True)
class Kept:
    """A run: its scene and features, unknowns, linear systems, CPU seconds; ``of``: its bundle."""

    scene: Scene
    features: dict[str, Any]
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
        plain = scene.numerics.unloading == "prestrain" and not scene.numerics.rest_sweeps and not scene.outputs.equilibria
        if solved > 0 and seconds > 0 and plain:
            yield Kept(scene, features, count, solved, seconds, str(scene.anatomy.bundle))


def design(runs: list[Kept], slender: dict[str, dict[str, float]]) -> FloatArray:
    """(n, 4): what the logarithm of the number of systems is linear in, in the order of ``COEFFICIENTS``."""
    return np.array(
        [
            [
                1.0,
                math.log(laplace(run.scene, slender[run.of])),
                float(run.scene.numerics.order == 2),
                math.log(1 + early_states(run.scene)),
            ]
            for run in runs
        ]
    )


def fitted(a: FloatArray, y: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted least squares, runs beyond ``_FAR`` by their distance (Huber)."""
    found, trust = np.zeros(a.shape[1]), np.ones(len(y))
    for _ in range(30):
        root = np.sqrt(weight * trust)
        found = np.asarray(np.linalg.lstsq(a * root[:, None], y * root, rcond=None)[0])
        trust = np.minimum(1.0, _FAR / np.maximum(np.abs(y - a @ found), 1e-9))
    return found


def process(runs: list[Kept], left: FloatArray) -> FloatArray:
    """The most likely values of ``PROCESS`` for what the middle leaves."""
    inputs = np.array([scaled_inputs(run.scene) for run in runs])
    apart = np.sum((inputs[:, None] - inputs[None]) ** 2, axis=2)
    order = np.array([run.scene.numerics.order for run in runs])
    of = np.array([run.of for run in runs])
    same_order, same_bundle = order[:, None] == order, of[:, None] == of

    def unlikely(p: FloatArray) -> float:
        sd, length, scatter = np.exp(p[[0, 1, 4]])
        orders, anatomies = 1.0 / (1.0 + np.exp(-p[2:4]))
        shared = np.where(same_order, 1.0, orders) * np.where(same_bundle, 1.0, anatomies)
        covariance = sd**2 * np.exp(-0.5 * apart / length**2) * shared + scatter**2 * np.eye(len(left))
        try:
            factor = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            return math.inf
        return float(np.log(np.diag(factor)).sum() + 0.5 * np.sum(np.linalg.solve(factor, left) ** 2))

    p = minimize(unlikely, [math.log(0.3), math.log(0.5), 1.0, 1.0, math.log(0.2)], method="Nelder-Mead").x
    return np.concatenate([np.exp(p[:2]), 1.0 / (1.0 + np.exp(-p[2:4])), np.exp(p[4:])])


def forecasts(runs: list[Kept], walls: dict[str, Bundle], slender: dict[str, dict[str, float]]) -> FloatArray:
    """(2, n, 2): logarithm of true over foretold CPU seconds, and whether it is in the range (1, 0), from the machine's speed
    alone and from ``_STORE`` other runs of the bundle, drawn; not a number where there are fewer."""
    rng = np.random.default_rng(0)
    done = [Earlier(run.scene, run.features | {"cpu_s": run.cpu_s}, slender[run.of]) for run in runs]
    found = np.full((2, len(runs), 2), np.nan)
    for one, run in enumerate(runs):
        others = [i for i, other in enumerate(runs) if other.of == run.of and i != one]
        if len(others) < _STORE:
            continue
        store = [done[i] for i in rng.choice(others, _STORE, replace=False)]
        for number, known in enumerate(([replace(run, slender=None) for run in store], store)):
            cost = expected(run.scene, walls[run.of], known)
            found[number, one] = math.log(run.cpu_s / cost.cpu_s), cost.low_s <= run.cpu_s <= cost.high_s
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    runs = [run for folder in choice.runs for run in kept(folder)]
    groups = sorted({run.of for run in runs})
    if len(groups) < 2:
        raise SystemExit("runs on two bundles are needed at least.")
    walls = {of: bundles.load(Path(of)) for of in groups}
    slender = {of: slenderness(wall) for of, wall in walls.items()}
    group = np.array([groups.index(run.of) for run in runs])
    # runs of a bundle are alike: a hundred do not tell as much as ten times ten
    weight = 1.0 / np.sqrt(np.bincount(group)[group])
    speed = np.log([run.cpu_s / price(run.scene, run.unknowns, run.solved) for run in runs])
    solved = np.log([run.solved for run in runs])
    a = design(runs, slender)
    left_out = np.empty(len(runs))
    for one in range(len(groups)):
        here = group == one
        left_out[here] = a[here] @ fitted(a[~here], solved[~here], weight[~here])
    order = np.array([run.scene.numerics.order for run in runs])
    machine = np.array([np.median(speed[(group == g) & (order == o)]) for g, o in zip(group, order, strict=True)])
    foretold = np.log([price(run.scene, run.unknowns, math.exp(at)) for run, at in zip(runs, left_out, strict=True)]) + machine
    found = fitted(a, solved, weight)
    by_speed, by_runs = forecasts(runs, walls, slender)
    off = {
        "CPU s, given the systems": speed,
        "systems, by the constants": solved - np.log([systems(run.scene, slender[run.of]) for run in runs]),
        "systems, fitted to other bundles": solved - left_out,
        "CPU s, fitted to other bundles": np.log([run.cpu_s for run in runs]) - foretold,
        "CPU s, given the machine's speed": by_speed[:, 0],
        f"CPU s, from {_STORE} runs of the bundle": by_runs[:, 0],
    }
    ranges = {"CPU s, given the machine's speed": by_speed[:, 1], f"CPU s, from {_STORE} runs of the bundle": by_runs[:, 1]}

    def told(values: FloatArray, which: FloatArray) -> list[float]:
        w = weight[which] / weight[which].sum()
        v = values[which]
        mean = float(w @ v)
        return [mean, float(np.sqrt(w @ (v - mean) ** 2)), 100.0 * float(w @ (np.abs(np.expm1(-v)) <= 0.25))]

    everywhere = {"linear": order == 1, "quadratic": order == 2, "all": order > 0}
    coefficients = dict(zip(COEFFICIENTS, found.tolist(), strict=True))
    rest = dict(zip(PROCESS, process(runs, solved - a @ found).tolist(), strict=True))
    head = ["what", "cells", "runs", "mean of ln (true / foretold)", "sd", "within 25 % (%)", "in the range (%)"]
    rows: list[list[Any]] = []
    for what, values in off.items():
        for cells, which in everywhere.items():
            if (there := which & np.isfinite(values)).any():
                share = weight[there] / weight[there].sum()
                inside = 100.0 * float(share @ ranges[what][there]) if what in ranges else ""
                rows.append([what, cells, int(there.sum()), *told(values, there), inside])
    if choice.json:
        lines = [dict(zip(head, row, strict=True)) for row in rows]
        print(json.dumps({"runs": len(runs), "coefficients": coefficients, "process": rest, "forecasts": lines}))
        return
    title = f"{len(runs)} runs, {len(groups)} bundles"
    print_table(title, ["ln systems", "coefficient"], [[name, value] for name, value in coefficients.items()])
    print_table("What the middle leaves", ["of its logarithm", "value"], [[name, value] for name, value in rest.items()])
    print_table("Forecasts", head, rows)


if __name__ == "__main__":
    main()
