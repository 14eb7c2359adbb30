"""What each term of a scene costs, and what `simulate --dry-run` foretells of it.

    python benchmarks/terms.py [--cell-size-mm 4] [--order 2] [--points 20] [--json]

One scene is the start: prestrain, springs on pericardium and right veins, moving annulus, one stiffness, end-systole alone.
Each row changes one thing. Then --points scenes are drawn from the 14-input box. ``foretold`` is what the dry run says before
the run, from no run at all and from the runs of the other rows. Asked: within 25 % for 90 % of the scenes.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.stats import qmc

from lacli.cli.terminal.console import print_table
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle
from lacli.contracts.motion import save_motion
from lacli.contracts.parameters import parameter_box
from lacli.contracts.scene import Scene, build_scene, with_parameters
from lacli.mechanics.numerics.cost import Earlier, expected, price, slenderness
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
    "neo-Hookean, 20 kPa": ("materials.law=neo_hookean", "materials.c_kpa=20"),
    "script engine": ("numerics.engine=script",),
    "springs at rest where the wall relaxes": ("numerics.rest_sweeps=1",),
}


@dataclass(frozen=True)
class Row:
    """One scene's run; what was foretold (CPU s) from no run, and from the runs of the other scenes; whether the run lies in the
    ranges foretold; the price of as many linear systems as it took."""

    term: str
    status: str
    cpu_s: float
    peak_memory_mb: float
    newton_iterations: int
    foretold_blind_cpu_s: float
    foretold_cpu_s: float
    inside: tuple[bool, bool]
    price_of_its_systems_cpu_s: float

    @property
    def misses(self) -> tuple[float, float]:
        """Foretold over true, minus 1, blind and from other runs."""
        return self.foretold_blind_cpu_s / self.cpu_s - 1.0, self.foretold_cpu_s / self.cpu_s - 1.0


def drawn(points: int, order: int, bundle: Path, folder: Path) -> dict[str, Scene]:
    """Scenes at points of the 14-input box."""
    box = parameter_box()
    low, high = np.array(list(box.values())).T
    at = low + qmc.Sobol(len(box), seed=11).random(64)[:points] * (high - low)
    plain = build_scene({"anatomy": {"bundle": str(bundle)}}, [*START, f"numerics.order={order}"], folder=folder, where="points")
    return {f"point {i}": with_parameters(plain, dict(zip(box, map(float, x), strict=True))) for i, x in enumerate(at)}


def measured(scenes: dict[str, Scene], bundle: Bundle, folder: Path) -> list[Row]:
    """Run all, then foretell each from the others."""
    found: dict[str, Earlier] = {}
    states: dict[str, str] = {}
    for term, scene in scenes.items():
        result = run_scene(scene, folder / "runs")
        states[term] = result.kind or result.status
        cost = {name: result.manifest.get(name) for name in ("cpu_s", "peak_memory_mb")}
        found[term] = Earlier(scene, {**result.features, **cost}, slenderness(bundle))
    rows = []
    for term, run in found.items():
        others = [other for name, other in found.items() if name != term and states[name] == "done"]
        blind, known = (expected(run.scene, bundle, earlier) for earlier in ([], others))
        cpu, memory = (float(run.features.get(name) or np.nan) for name in ("cpu_s", "peak_memory_mb"))
        solved = int(run.features.get("newton_iterations", 0))
        inside = (blind.low_s <= cpu <= blind.high_s, known.low_s <= cpu <= known.high_s)
        given = price(run.scene, blind.unknowns, solved)
        rows.append(Row(term, states[term], cpu, memory, solved, blind.cpu_s, known.cpu_s, inside, given))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell-size-mm", type=float, default=4.0)
    parser.add_argument("--order", type=int, default=2)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--points", type=int, default=20)
    parser.add_argument("--only", nargs="*", choices=list(TERMS), default=list(TERMS))
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        bundle, motion = synthesize(choice.seed, None, cell_size_mm=choice.cell_size_mm)
        bundles.save(bundle, folder / "la")
        save_motion(motion, folder / "la")
        scenes = {
            term: build_scene(
                {"anatomy": {"bundle": str(folder / "la")}},
                [*START, f"numerics.order={choice.order}", *TERMS[term]], folder=folder, where=term,
            )
            for term in choice.only
        }  # fmt: skip
        terms = measured(scenes, bundle, folder)
        points = measured(drawn(choice.points, choice.order, folder / "la", folder), bundle, folder) if choice.points else []
    if choice.json:
        print(json.dumps([asdict(row) for row in (*terms, *points)]))
        return
    first = terms[0]
    head = [
        "scene",
        "status",
        "CPU (s)",
        "of the start",
        "memory (MB)",
        "systems",
        "foretold, no run (%)",
        "foretold, other runs (%)",
    ]
    print_table(
        f"order {choice.order}, {choice.cell_size_mm:g} mm",
        head,
        [
            [
                r.term,
                r.status,
                r.cpu_s,
                r.cpu_s / first.cpu_s,
                r.peak_memory_mb,
                r.newton_iterations,
                *(100 * m for m in r.misses),
            ]
            for r in (*terms, *points)
        ],
    )
    for name, rows in (("terms", terms), ("points of the box", points)):
        done = [r for r in rows if r.status == "done"]
        if done:
            within = [100.0 * float(np.mean([abs(r.misses[i]) <= 0.25 for r in done])) for i in (0, 1)]
            print(f"{name}: within 25 %: {within[0]:.0f} % from no run, {within[1]:.0f} % from other runs (asked: 90 %)")
            ranges = [100.0 * float(np.mean([r.inside[i] for r in done])) for i in (0, 1)]
            print(f"{name}: in the range: {ranges[0]:.0f} % from no run, {ranges[1]:.0f} % from other runs (stated: 90 %)")
            given = 100.0 * float(np.mean([abs(r.price_of_its_systems_cpu_s / r.cpu_s - 1.0) <= 0.25 for r in done]))
            print(f"{name}: price of the systems that were solved within 25 %: {given:.0f} %")


if __name__ == "__main__":
    main()
