"""The pointwise share of the bulk modulus: what it changes, and whether that vanishes under refinement.

    python benchmarks/kappa.py [--cells-mm 6 4 3] [--shares 0 30 100 300] [--order 2] [--seed 3]

Of kappa (1000 kPa) the cells' mean pressure carries one part and each quadrature point the rest, ``numerics.kappa_points_kpa``.
Both parts have the same limit under refinement, so that the difference to share 0 is an error of discretisation: it is told
for each cell size, beside the discretisation error of share 0 itself (against its finest cells), and the Newton systems.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from lacli.cli.terminal.console import print_table
from lacli.contracts import bundle as bundles
from lacli.contracts.features import PUBLISHED
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import build_scene
from lacli.mechanics.simulation import run_scene
from lacli.synthetic.atrium import synthesize

PLAIN = ("outputs.unloaded=false", "outputs.fields=none", "outputs.frames=0", "loads.edp_mmhg=8", "loads.esp_mmhg=18")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells-mm", type=float, nargs="+", default=[6.0, 4.0, 3.0])
    parser.add_argument("--shares", type=float, nargs="+", default=[0.0, 30.0, 100.0, 300.0])
    parser.add_argument("--order", type=int, default=2)
    parser.add_argument("--seed", type=int, default=3)
    choice = parser.parse_args()
    found: dict[tuple[float, float], dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for cell_mm in choice.cells_mm:
            bundle, motion = synthesize(choice.seed, None, cell_size_mm=cell_mm)
            bundles.save(bundle, folder / f"la{cell_mm:g}")
            save_motion(motion, folder / f"la{cell_mm:g}")
            for share in choice.shares:
                settings = [*PLAIN, f"numerics.order={choice.order}", f"numerics.kappa_points_kpa={share}"]
                scene = build_scene({"anatomy": {"bundle": f"la{cell_mm:g}"}}, settings, folder=folder, where="kappa")
                result = run_scene(scene, folder / "runs")
                found[cell_mm, share] = {**result.features, "status": result.kind or result.status}
    names = [name for name in PUBLISHED if name != "esv_ml"]
    finest = found[choice.cells_mm[-1], choice.shares[0]]
    rows = []
    for (cell_mm, share), run in found.items():
        plain = found[cell_mm, choice.shares[0]]
        if "esv_ml" not in run or "esv_ml" not in plain or "esv_ml" not in finest:
            rows.append([cell_mm, share, run["status"], "", "", "", "", ""])
            continue
        changed = max(abs(run[name] - plain[name]) for name in names)
        own = max(abs(plain[name] - finest[name]) for name in names)
        volume = run["esv_ml"] - plain["esv_ml"]
        error = run["esv_ml"] - finest["esv_ml"]
        rows.append([cell_mm, share, run["status"], changed, volume, own, error, run["newton_iterations"]])
    head = ["cells (mm)", "share (kPa)", "status", "largest change of a d (mm)", "change of ESV (mL)"]
    print_table(
        f"order {choice.order}, against share {choice.shares[0]:g} kPa and {choice.cells_mm[-1]:g} mm",
        [*head, "error of d without it (mm)", "error of ESV (mL)", "systems"],
        rows,
    )


if __name__ == "__main__":
    main()
