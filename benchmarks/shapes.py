"""Simulations at extremes of wall, cells, pressure and compressibility: each converges or says why; features must be monotone.

python benchmarks/shapes.py [--order 1] [--out DIR]
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

from lacli.contracts import bundle as bundles
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import build_scene
from lacli.mechanics.simulation import run_scene
from lacli.synthetic.atrium import synthesize

# name, wall (mm), cells (mm), overrides
CASES: tuple[tuple[str, float, float, tuple[str, ...]], ...] = (
    ("reference", 2.0, 4.0, ()),
    ("wall 0.7 mm", 0.7, 4.0, ()),
    ("wall 1 mm", 1.0, 4.0, ()),
    ("wall 5 mm", 5.0, 4.0, ()),
    ("cells 8 mm", 2.0, 8.0, ()),
    ("EDP 0", 2.0, 4.0, ("loads.edp_mmhg=0",)),
    ("EDP 1", 2.0, 4.0, ("loads.edp_mmhg=1",)),
    ("ESP 13", 2.0, 4.0, ("loads.esp_mmhg=13",)),
    ("ESP 37", 2.0, 4.0, ("loads.esp_mmhg=37",)),
    ("kappa 100 kPa", 2.0, 4.0, ("materials.kappa_kpa=100", "numerics.kappa_points_kpa=20")),
    ("kappa 10,000 kPa", 2.0, 4.0, ("materials.kappa_kpa=10000",)),
    ("C 0.2 kPa", 2.0, 4.0, ("materials.c_kpa=0.2",)),
    ("C 6.8 kPa", 2.0, 4.0, ("materials.c_kpa=6.8",)),
    ("EDP 0, C 6.8", 2.0, 4.0, ("loads.edp_mmhg=0", "materials.c_kpa=6.8")),
    ("EDP 0, C 0.2", 2.0, 4.0, ("loads.edp_mmhg=0", "materials.c_kpa=0.2")),
    ("EDP 0, wall 5 mm", 5.0, 4.0, ("loads.edp_mmhg=0",)),
    ("EDP 0, wall 1 mm", 1.0, 4.0, ("loads.edp_mmhg=0",)),
    ("cells 1 mm", 2.0, 1.0, ()),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--order", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("results/shapes"))
    choice = parser.parse_args()
    grown = {}
    print(f"{'case':18s} {'result':22s} {'EDV mL':>8} {'ESV mL':>8} {'d mm':>7} {'min J':>6} {'modes ED/ES':>12} {'CPU s':>7}")
    for name, wall, size, overrides in CASES:
        folder = choice.out / f"wall{wall:g}_cells{size:g}"
        if not folder.is_dir():
            bundle, motion = synthesize(1, None, thickness_mm=wall, cell_size_mm=size)
            bundles.save(bundle, folder)
            save_motion(motion, folder)
        settings = [f"numerics.order={choice.order}", "outputs.fields=none", "outputs.unloaded=false", *overrides]
        scene = build_scene({"anatomy": {"bundle": str(folder.resolve())}}, settings, folder=folder, where="shapes")
        result = run_scene(scene, choice.out / "runs")
        cpu = float(result.manifest.get("cpu_s", float("nan")))
        if result.status != "done":
            print(f"{name:18s} {result.kind}: {result.message} {cpu:.0f} CPU s", flush=True)
            continue
        f = result.features
        modes = f"{f.get('ed_unstable_modes', 0)}/{f['es_unstable_modes']}"
        row = f"{f['edv_ml']:8.2f} {f['esv_ml']:8.2f} {f['d_global_mm']:7.3f} {f['min_jacobian']:6.3f} {modes:>12} {cpu:7.1f}"
        print(f"{name:18s} {'done':22s} {row}", flush=True)
        grown[name] = f["esv_ml"]
    chains = {
        "a higher ESP fills more": ("ESP 13", "reference", "ESP 37"),
        "a higher EDP uses compliance up": ("reference", "EDP 1", "EDP 0"),
        # from rest alone: under EDP the image fixes the tension, and a softer or thinner wall has then stiffened more
        "a stiffer wall fills less from rest": ("EDP 0, C 6.8", "EDP 0", "EDP 0, C 0.2"),
        "a thicker wall fills less from rest": ("EDP 0, wall 5 mm", "EDP 0", "EDP 0, wall 1 mm"),
    }
    for law, names in chains.items():
        values = [grown[name] for name in names if name in grown]
        holds = len(values) == len(names) and all(a < b for a, b in itertools.pairwise(values))
        print(f"{law}: {'holds' if holds else 'NOT'} ({', '.join(f'{v:.2f}' for v in values)} mL)")


if __name__ == "__main__":
    main()
