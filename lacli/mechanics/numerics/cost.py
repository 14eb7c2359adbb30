"""What a simulation will cost: linear systems times the price of one, on this machine and near this scene where runs tell.

The wall is thin, so a sparse direct solution costs as in two dimensions, n^1.5 for n unknowns (George 1973, SIAM J Numer Anal
10:345); memory is the factors' n log n, near enough n. Constants are measured by ``benchmarks/terms.py``. How many systems a
scene takes is known for an ordinary one; soft walls at high pressure take up to ten times as many, which only runs near by tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.parameters import QUANTITIES, STUDY
from lacli.contracts.scene import Scene, parameters_of
from lacli.geometry.tetrahedra import TET10_EDGES

_SYSTEM_S = 2.0e-7  # CPU seconds of one linear system over n^1.5, assembly included
_START_S = (0.2, 1.5e-5)  # CPU seconds to begin, and for each unknown
_MEMORY_MB = {1: (26.0, 0.0067), 2: (13.0, 0.0101)}  # and for each unknown, by order
# linear systems: to strain the wall, to end-systole, what the pericardium's contact adds, for each stretch of the conduit
_PRESTRAIN, _RESERVOIR, _PERICARDIUM, _CONDUIT = 4.0, 5.0, 8.0, 3.0
_UNLOADED, _SENSITIVITIES, _FRAME = 1.25, 1.06, 0.05  # factors of the whole; sensitivities of each further frame
_SCRIPT, _POINTS_14, _BACKWARD = 2.0, 1.6, 2.5
_NEAREST = 5
_SPREAD = 0.15  # of the box: runs within it are as near as can be told


@dataclass(frozen=True)
class Cost:
    """What a simulation will cost, in CPU seconds and MB.

    unknowns: of displacements and pressures; runs: finished runs that it was corrected by (0: none here, the machine is taken
    for the one the constants are from).
    """

    unknowns: int
    cpu_s: float
    peak_memory_mb: float
    runs: int


@dataclass(frozen=True)
class Earlier:
    """A finished run: its scene, its features (``unknowns`` among them), CPU seconds and memory."""

    scene: Scene
    features: Mapping[str, Any]


def unknowns(bundle: Bundle, order: int) -> int:
    """Unknowns of a linear system: three displacements a corner, for second order a mid-edge point too; a pressure a corner."""
    nodes = corners = len(np.unique(bundle.tets[:, :4]))
    if order == 2:
        pairs = np.concatenate([np.sort(bundle.tets[:, list(edge)], axis=1) for edge in TET10_EDGES])
        nodes += len(np.unique(pairs @ np.array([len(bundle.points), 1])))
    return 3 * nodes + corners


def ordinary(scene: Scene, count: int) -> tuple[float, float]:
    """CPU seconds and memory (MB) of an ordinary scene with these terms and ``count`` unknowns, by the constants' machine."""
    loads, outputs = scene.loads, scene.outputs
    es = scene.motion.es_time
    late = sum(time > es for time in outputs.times) if outputs.times else max(4, outputs.frames) * outputs.conduit
    frames = len(outputs.times) if outputs.times else outputs.frames
    systems = _RESERVOIR + _PRESTRAIN * (loads.edp_mmhg > 0) + _CONDUIT * late
    systems += _PERICARDIUM * (scene.pericardium.k_peri_kpa_per_um > 0)
    cpu = _START_S[0] + _START_S[1] * count + systems * _SYSTEM_S * count**1.5
    if outputs.unloaded and loads.edp_mmhg > 0:
        cpu *= _UNLOADED
    if outputs.sensitivities:
        cpu *= _SENSITIVITIES + _FRAME * max(0, frames - 1)
    cpu *= _BACKWARD if loads.edp_mmhg > 0 and scene.numerics.unloading == "backward" else 1.0
    cpu *= _POINTS_14 if scene.numerics.quadrature == 14 else 1.0
    cpu *= _SCRIPT if scene.numerics.engine == "script" else 1.0
    least, each = _MEMORY_MB[scene.numerics.order]
    return cpu, least + each * count


def expected(scene: Scene, bundle: Bundle, earlier: Iterable[Earlier]) -> Cost:
    """Cost of a scene: an ordinary one's, times what finished runs took of theirs; of its order and nearest in the inputs."""
    count = unknowns(bundle, scene.numerics.order)
    cpu, memory = ordinary(scene, count)
    known = [run for run in earlier if run.features.get("unknowns") and run.features.get("cpu_s")]
    known = [run for run in known if run.scene.numerics.order == scene.numerics.order] or known
    if not known:
        return Cost(count, cpu, memory, 0)
    here = _inputs(scene)
    apart = [max(_SPREAD, float(np.linalg.norm(_inputs(run.scene) - here))) for run in known]
    nearest = sorted(range(len(known)), key=lambda i: apart[i])
    chosen = [known[i] for i in nearest if apart[i] <= 1.5 * apart[nearest[0]]][:_NEAREST]
    of_cpu, of_memory = [], []
    for run in chosen:
        plain = ordinary(run.scene, int(run.features["unknowns"]))
        of_cpu.append(float(run.features["cpu_s"]) / plain[0])
        if used := run.features.get("peak_memory_mb"):
            of_memory.append(float(used) / plain[1])
    return Cost(count, cpu * median(of_cpu), memory * (median(of_memory) if of_memory else 1.0), len(chosen))


def _inputs(scene: Scene) -> FloatArray:
    """The study's inputs as shares of their ranges (14,)."""
    low, high = np.array([QUANTITIES[name].study for name in STUDY], float).T
    return np.asarray((np.array(parameters_of(scene, STUDY)) - low) / (high - low))
