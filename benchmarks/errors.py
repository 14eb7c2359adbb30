"""Discretisation errors over anatomies: what a choice of numerics changes, and whether the built-in model of it holds.

    python benchmarks/errors.py FOLDER [--anatomies 12] [--from-seed 0] [--finest-mm 2.2] [--collect]

For each seed an atrium (its own volume, wall of 1 - 4 mm) and a point of the 14-input box are drawn, and simulated with linear
and quadratic cells of several sizes and with quadratic cells of the finest. Differences to the last are the true errors. Kept
in FOLDER/errors.csv; another call goes on. Without --collect the model is fitted to all and its coverage is measured on each
anatomy by the others. Asked: at least 93 % of the true errors within twice the stated, on anatomies the model has not seen.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from lacli.base.errors import LacliError
from lacli.contracts import bundle as bundles
from lacli.contracts.motion import save_motion
from lacli.contracts.parameters import parameter_box
from lacli.contracts.scene import build_scene, with_parameters
from lacli.mechanics.simulation import run_scene
from lacli.synthetic.atrium import synthesize

CHOICES = ((1, 6.0), (1, 4.0), (1, 3.0), (2, 6.0), (2, 4.0))
WALLS_MM = (1.0, 1.5, 2.0, 3.0, 4.0)


def drawn(seed: int) -> tuple[float, dict[str, float]]:
    """Wall thickness (mm) and inputs of a seed."""
    box = parameter_box()
    low, high = np.array(list(box.values())).T
    point = qmc.Sobol(len(box), seed=7).random(128)[seed % 128]
    return WALLS_MM[seed % len(WALLS_MM)], dict(zip(box, map(float, low + point * (high - low)), strict=True))


def simulate(folder: Path, seed: int, order: int, cell_mm: float) -> dict[str, Any]:
    """One run as a row: what was simulated, status, cost, features."""
    thickness, inputs = drawn(seed)
    where = folder / f"atrium_{seed:03d}_{cell_mm:g}mm"
    row: dict[str, Any] = {"seed": seed, "thickness_mm": thickness, "order": order, "cell_size_mm": cell_mm}
    try:
        if not where.is_dir():
            bundle, motion = synthesize(seed, None, thickness_mm=thickness, cell_size_mm=cell_mm)
            bundles.save(bundle, where)
            save_motion(motion, where)
        settings = [f"numerics.order={order}", "outputs.fields=none", "outputs.unloaded=false", "numerics.timeout_s=1800"]
        base = build_scene({"anatomy": {"bundle": str(where.resolve())}}, settings, folder=folder, where="errors")
        result = run_scene(with_parameters(base, inputs), folder / "runs")
    except LacliError as error:
        return {**row, "status": "failed", "message": str(error)}
    cost = {name: result.manifest.get(name) for name in ("cpu_s", "peak_memory_mb")}
    features = {name: value for name, value in result.features.items() if isinstance(value, (int, float))}
    return {**row, "status": result.status, "kind": result.kind, "inputs": inputs, **cost, "features": features}


def collect(folder: Path, seeds: range, finest_mm: float) -> list[dict[str, Any]]:
    """All rows of the seeds, those that were kept and those that are simulated now."""
    file = folder / "runs.jsonl"
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.is_file() else []
    known = {(row["seed"], row["order"], row["cell_size_mm"]) for row in rows}
    for seed in seeds:
        for order, cell_mm in (*CHOICES, (2, finest_mm)):
            if (seed, order, cell_mm) in known:
                continue
            row = simulate(folder, seed, order, cell_mm)
            rows.append(row)
            with file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(row) + "\n")
            print(f"seed {seed}, order {order}, {cell_mm:g} mm: {row['status']}, {row.get('cpu_s') or 0:.0f} CPU s", flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--anatomies", type=int, default=12)
    parser.add_argument("--from-seed", type=int, default=0)
    parser.add_argument("--finest-mm", type=float, default=2.7)
    parser.add_argument("--collect", action="store_true")
    choice = parser.parse_args()
    choice.folder.mkdir(parents=True, exist_ok=True)
    rows = collect(choice.folder, range(choice.from_seed, choice.from_seed + choice.anatomies), choice.finest_mm)
    print(len(rows))


if __name__ == "__main__":
    main()
