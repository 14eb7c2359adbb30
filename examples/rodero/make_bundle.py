"""Tetrahedra with named surfaces -> an anatomy bundle with a rigid motion of the annulus along its axis."""

from __future__ import annotations

import argparse
from pathlib import Path

from lacli.anatomy.inputs.meshes.tagged import read_tagged
from lacli.contracts.bundle import check, save
from lacli.contracts.motion import save_motion
from lacli.motion.annulus import descend


def main() -> None:
    """Read, check, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tetrahedra", type=Path)
    parser.add_argument("surfaces", type=Path)
    parser.add_argument("names", type=Path)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--cell-size-mm", type=float, default=None, help="mesh the cavity anew; default: their cells")
    parser.add_argument("--thickness-mm", type=float, default=2.0)
    parser.add_argument("--order", type=int, default=2)
    parser.add_argument("--descent-mm", type=float, default=8.0)
    given = parser.parse_args()
    bundle = read_tagged(
        given.tetrahedra, given.surfaces, given.names, given.cell_size_mm, order=given.order, thickness_mm=given.thickness_mm
    )
    check(bundle, str(given.bundle))
    save(bundle, given.bundle)
    save_motion(descend(bundle, descent_mm=given.descent_mm, circumference_change=0.0), given.bundle)
    print(f"{given.bundle}: {len(bundle.tets)} cells, {len(bundle.points)} points, cavity {bundle.cavity_volume_ml():.2f} mL")


if __name__ == "__main__":
    main()
