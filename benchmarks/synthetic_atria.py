"""Ten parametric atria, extremes of wall and cells, and time at 2 mm cells: asked against measured.

Run: python benchmarks/synthetic_atria.py [--quick]
"""

from __future__ import annotations

import sys
import time

from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle, check
from lacli.geometry import tetrahedra as cells
from lacli.synthetic.atrium import synthesize
from lacli.synthetic.shape import cohort_volume

LINE = "{:<34}{:>9}{:>11}{:>9}{:>9}{:>9}{:>10}{:>9}"


def row(name: str, seed: int, thickness: float = 2.0, size: float = 4.0) -> Bundle | None:
    """Make one, print its figures."""
    start = time.process_time()
    try:
        bundle, _ = synthesize(seed, thickness_mm=thickness, cell_size_mm=size)
        check(bundle, name)
    except AnatomyError as error:
        print(f"{name:<34}FAILED: {error}")
        return None
    spent = time.process_time() - start
    quality = cells.scaled_jacobian(bundle.points, bundle.tets)
    volume = -cells.enclosed_volume_ml(bundle.points, bundle.cavity_triangles())
    error = 100 * (volume / cohort_volume(seed) - 1)
    curved = cells.curved_jacobian(bundle.points, bundle.tets).min()
    print(
        LINE.format(
            name,
            f"{volume:.2f}",
            f"{error:+.4f}",
            len(bundle.tets),
            f"{quality.min():.3f}",
            f"{100 * (quality < 0.2).mean():.3f}",
            f"{curved:.3f}",
            f"{spent:.1f}",
        ),
        flush=True,
    )
    return bundle


def main() -> None:
    """All rows."""
    print(LINE.format("", "mL", "error %", "cells", "SJ min", "SJ<.2 %", "J curved", "CPU s"))
    print(LINE.format("asked", "47 - 135", "2", "", ">= 0.05", "<= 0.1", "> 0", "<= 180"))
    for seed in range(1, 4 if "--quick" in sys.argv else 11):
        row(f"seed {seed}, 2 mm wall, 4 mm cells", seed)
    if "--quick" in sys.argv:
        return
    for thickness, size in (
        (2.0, 2.0),
        (2.0, 1.0),
        (2.0, 8.0),
        (0.7, 4.0),
        (0.7, 8.0),
        (5.0, 4.0),
        (5.0, 8.0),
        (0.7, 1.0),
        (5.0, 1.0),
    ):
        row(f"seed 1, {thickness:g} mm wall, {size:g} mm cells", 1, thickness, size)


if __name__ == "__main__":
    main()
