"""What it changes that springs rest where the wall relaxes to without pressure, not in the image less the prestrain's field.

    python benchmarks/rest.py [--cell-size-mm 8] [--order 2] [--sweeps 0 1 2] [--seed 3]

Synthetic atrium, EDP 8, ESP 18 mmHg. By number of sweeps (``numerics.rest_sweeps``; 0: the cheap form): volume and displacements
at end-systole, how far the last sweep moved the places of rest, linear systems, CPU seconds.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from prepared import prepared

from lacli.cli.terminal.console import print_table
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.scene import build_scene
from lacli.mechanics.simulation import run_scene

SETTINGS = ("outputs.fields=none", "outputs.frames=0", "outputs.unloaded=false", "loads.edp_mmhg=8", "loads.esp_mmhg=18")
SHOWN = ("esv_ml", "d_global_mm", *(f"d_{region}_mm" for region in BODY_REGIONS), "rest_move_mean_mm", "rest_move_max_mm")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell-size-mm", type=float, default=8.0)
    parser.add_argument("--order", type=int, default=2, choices=(1, 2))
    parser.add_argument("--sweeps", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--seed", type=int, default=3)
    choice = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory(prefix="lacli-rest-") as temporary:
        folder = Path(temporary)
        atrium = prepared(folder, choice.seed, choice.cell_size_mm)
        for count in choice.sweeps:
            settings = [*SETTINGS, f"numerics.order={choice.order}", f"numerics.rest_sweeps={count}"]
            scene = build_scene({"anatomy": {"bundle": str(atrium)}}, settings, folder=folder, where="rest")
            result = run_scene(scene, folder / "runs")
            shown = [result.features.get(name) for name in SHOWN]
            systems = result.features.get("newton_iterations")
            rows.append([count, result.kind or result.status, *shown, systems, result.manifest["cpu_s"]])
    print_table(f"order {choice.order}, {choice.cell_size_mm:g} mm", ["sweeps", "status", *SHOWN, "systems", "CPU (s)"], rows)


if __name__ == "__main__":
    main()
