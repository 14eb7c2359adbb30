"""What a simulation will cost: unknowns counted, time and memory scaled from runs of the same kind."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from lacli.contracts.bundle import Bundle
from lacli.contracts.scene import Scene
from lacli.geometry.tetrahedra import TET10_EDGES

# sparse direct solution of a thin wall: between the 2D (n^1.5) and the assembly's n^1
_TIME_POWER, _MEMORY_POWER = 1.3, 1.2


@dataclass(frozen=True)
class Cost:
    """unknowns of the displacement; cpu_s and peak_memory_mb None where no run tells."""

    unknowns: int
    cpu_s: float | None
    peak_memory_mb: float | None
    runs: int


def unknowns(bundle: Bundle, order: int) -> int:
    """Displacement unknowns: three a corner, and for second order three a mid-edge point."""
    nodes = len(np.unique(bundle.tets[:, :4]))
    if order == 2:
        pairs = np.concatenate([np.sort(bundle.tets[:, list(edge)], axis=1) for edge in TET10_EDGES])
        nodes += len(np.unique(pairs @ np.array([len(bundle.points), 1])))
    return 3 * nodes


def expected(scene: Scene, bundle: Bundle, earlier: Iterable[dict[str, Any]]) -> Cost:
    """Cost of a scene; ``earlier`` are features (unknowns, cpu_s, peak_memory_mb) of finished runs."""
    count = unknowns(bundle, scene.numerics.order)
    known = [run for run in earlier if run.get("unknowns") and run.get("cpu_s")]
    if not known:
        return Cost(count, None, None, 0)
    cpu = median(float(run["cpu_s"]) * (count / float(run["unknowns"])) ** _TIME_POWER for run in known)
    sized = [run for run in known if run.get("peak_memory_mb")]
    memory = None
    if sized:
        memory = median(float(run["peak_memory_mb"]) * (count / float(run["unknowns"])) ** _MEMORY_POWER for run in sized)
    return Cost(count, cpu, memory, len(known))
