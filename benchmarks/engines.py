"""The compiled engine against FreeFEM's own language on the synthetic atrium: CPU seconds, their ratio, largest difference.

    python benchmarks/engines.py [--cell-size-mm 6] [--seed 1] [--out DIR] [--json]

One thread, one simulation after the other; CPU s is FreeFEM's whole process. Asked: features equal to 1e-6 relative.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from prepared import prepared

from lacli.cli.terminal.console import print_json, print_table
from lacli.contracts.scene import build_scene
from lacli.mechanics.simulation import run_scene

ENGINES = ("plugin", "script")
AGREEMENT = 1e-6
COST = ("cpu_s", "peak_memory_mb")  # of a run, not of the atrium


def largest_difference(one: dict[str, Any], other: dict[str, Any]) -> tuple[str, float]:
    """The feature that differs most, and by how much, relative to its size (at least 1e-3 of its unit)."""
    gaps = {}
    for name, value in one.items():
        if isinstance(value, float) and name not in COST:
            gaps[name] = abs(value - other[name]) / max(abs(value), 1e-3)
    name = max(gaps, key=lambda key: gaps[key])
    return name, gaps[name]


def compare(folder: Path, order: int, root: Path) -> dict[str, Any]:
    """One row: both engines on one scene."""
    row: dict[str, Any] = {"order": order}
    features = []
    for engine in ENGINES:
        settings = [f"numerics.order={order}", f"numerics.engine={engine}", "outputs.fields=none"]
        scene = build_scene({"anatomy": {"bundle": str(folder)}}, settings, folder=folder, where="engines")
        result = run_scene(scene, root)
        row[f"{engine}_cpu_s"] = result.manifest["cpu_s"]
        row[f"{engine}_mb"] = result.manifest["peak_memory_mb"]
        row[f"{engine}_newton"] = result.features.get("newton_iterations")
        row["unknowns"] = result.features.get("unknowns")
        if result.status != "done":
            row["passed"], row["worst"] = False, f"{engine}: {result.kind}, {result.message}"
            return row
        features.append(result.features)
    row["ratio"] = row["script_cpu_s"] / row["plugin_cpu_s"]
    row["worst"], row["difference"] = largest_difference(*features)
    row["passed"] = row["difference"] < AGREEMENT
    return row


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell-size-mm", type=float, default=6.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="where runs are kept (and found again); else they are thrown away")
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="lacli-engines-") as temporary:
        out = (choice.out or Path(temporary)).resolve()
        folder = prepared(out, choice.seed, choice.cell_size_mm)
        rows = [compare(folder, order, out / "runs") for order in (1, 2)]
    if choice.json:
        print_json({"rows": rows, "asked": AGREEMENT})
    else:
        columns = list(dict.fromkeys(name for row in rows for name in row))
        print_table(f"asked: features within {AGREEMENT:g}", columns, [[row.get(name) for name in columns] for row in rows])
    if not all(row["passed"] for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
