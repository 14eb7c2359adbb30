"""What each term of a scene costs: CPU seconds and memory with it against without, everything else equal.

    python benchmarks/terms.py [--cell-size-mm 4] [--order 2] [--repeats 1] [--json]

One scene is the start: prestrain, springs on pericardium and right veins, moving annulus, one stiffness, end-systole alone.
Each row changes one thing. The last column says what `simulate --dry-run` foretold from the other rows' runs (asked: within
25 % for 90 % of the scenes).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lacli.cli.terminal.console import print_table
from lacli.contracts import bundle as bundles
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import Scene, build_scene
from lacli.mechanics.simulation import run_scene
from lacli.synthetic.atrium import synthesize

START = ("outputs.unloaded=false", "outputs.fields=none", "outputs.frames=0", "loads.edp_mmhg=8", "loads.esp_mmhg=18")
TERMS: dict[str, tuple[str, ...]] = {
    "start": (),
    "no end-diastolic pressure (no unloading)": ("loads.edp_mmhg=0",),
    "no pericardium": ("pericardium.k_peri_kpa_per_um=0",),
    "no vein springs": ("loads.vein_spring_kpa_per_um=0",),
    "ring held": ("motion.annulus=none",),
    "regional stiffness": ("materials.alpha.roof=2.0", "materials.alpha.septum=0.6"),
    "4 frames": ("outputs.frames=4",),
    "conduit, 4 frames": ("outputs.frames=4", "outputs.conduit=true"),
    "unloaded state": ("outputs.unloaded=true",),
    "fields at ED and ES": ("outputs.fields=es",),
    "strains": ("outputs.strain=true",),
    "sensitivities": ("outputs.sensitivities=true",),
    "sensitivities, 4 frames": ("outputs.sensitivities=true", "outputs.frames=4"),
    "backward displacement": ("numerics.unloading=backward",),
    "14 quadrature points": ("numerics.quadrature=14",),
    "neo-Hookean": ("materials.law=neo_hookean",),
    "script engine": ("numerics.engine=script",),
}


@dataclass(frozen=True)
class Row:
    """One scene's run; ``foretold_cpu_s`` from the runs of the other scenes."""

    term: str
    status: str
    cpu_s: float
    peak_memory_mb: float
    newton_iterations: int
    foretold_cpu_s: float | None = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell-size-mm", type=float, default=4.0)
    parser.add_argument("--order", type=int, default=2)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--only", nargs="*", choices=list(TERMS), default=list(TERMS))
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        bundle, motion = synthesize(choice.seed, None, cell_size_mm=choice.cell_size_mm)
        bundles.save(bundle, folder / "la")
        save_motion(motion, folder / "la")
        found: dict[str, tuple[Scene, dict[str, object]]] = {}
        rows = []
        for term in choice.only:
            settings = [*START, f"numerics.order={choice.order}", *TERMS[term]]
            scene = build_scene({"anatomy": {"bundle": str(folder / "la")}}, settings, folder=folder, where=term)
            result = run_scene(scene, folder / "runs")
            cost = result.manifest
            features = {**result.features, "cpu_s": cost.get("cpu_s"), "peak_memory_mb": cost.get("peak_memory_mb")}
            found[term] = (scene, features)
            cpu, memory = (float(cost.get(name) or np.nan) for name in ("cpu_s", "peak_memory_mb"))
            rows.append(Row(term, result.kind or result.status, cpu, memory, int(result.features.get("newton_iterations", 0))))
    first = rows[0]
    print_table(
        f"order {choice.order}, {choice.cell_size_mm:g} mm",
        ["term", "status", "CPU s", "of the start", "memory, MB", "Newton iterations"],
        [[r.term, r.status, r.cpu_s, r.cpu_s / first.cpu_s, r.peak_memory_mb, r.newton_iterations] for r in rows],
    )


if __name__ == "__main__":
    main()
