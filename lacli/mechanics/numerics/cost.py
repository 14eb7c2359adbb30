"""What a simulation will cost: linear systems times the price of one, on this machine and near this scene where runs tell.

The price of a system of n unknowns is known: the wall is thin, so a sparse direct solution costs nearly as in two dimensions,
n^1.5 (George 1973, SIAM J Numer Anal 10:345), assembly n; with the number of systems a run takes given, it tells CPU seconds
within 25 % for most runs. Memory is the factors' n log n, near enough n.

How many systems a scene takes is known in the middle only: Newton's method takes some three for the prestrain and eight to
end-systole where the wall stays smooth, and tens where a soft region at high pressure snaps through, which no number of the
scene foretells sharply. So the cost is a middle and a range, and finished runs near by narrow it.

``benchmarks/terms.py`` measures prices, factors and what the forecast is worth, ``benchmarks/cost_fit.py`` the coefficients on
runs that were kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import exp, log, sqrt
from statistics import median
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.features import SAME_TIME
from lacli.contracts.parameters import QUANTITIES, STUDY
from lacli.contracts.scene import Scene, parameters_of
from lacli.geometry.tetrahedra import TET10_EDGES

# by order: CPU seconds of a system of 10,000 unknowns, assembly included; the power of n; seconds to begin and end, an unknown
_SYSTEM = {1: (0.140, 1.267, 1.25e-4), 2: (0.156, 1.306, 7.1e-5)}
_MEMORY_MB = {1: (28.0, 0.0064), 2: (4.3, 0.0103)}  # and for each unknown, by order
# systems to end-systole, in the middle: exp(a) soft^b edp^c esp^d, soft the least C alpha (kPa) of a region, pressures in mmHg;
# quadratic cells bend where linear ones are too stiff, and take more
_SYSTEMS = (0.892, -0.219, 0.067, 0.568)
_QUADRATIC = 1.36
_LEAST_EDP = 1.0  # mmHg: below it the prestrain takes its two systems all the same
_UNHELD = 0.7  # of them, without pericardium
# states before end-systole, by order: systems as (1 + states)^(a - b ln soft), no fewer: a stiff wall is soon at the next state,
# a soft one gives way between them
_EARLY = {1: (0.37, 0.53), 2: (0.72, 0.62)}
_SECOND = (
    1.2  # of the systems to end-systole, for a second way there: the middle of 19 soft walls (benchmarks/branches.py), .7 to 2.7
)
_CONDUIT = 1.5  # systems for each stretch of the conduit
_UNLOADED, _FRAME = 1.3, 0.05  # factors of the whole; sensitivities of each further frame
_REST = 0.4  # of the whole, for each sweep of springs at rest where the wall relaxes
# by order: where solving is fast, assembly is what costs
_SENSITIVITIES, _POINTS_14, _SCRIPT = {1: 1.06, 2: 1.05}, {1: 2.3, 2: 1.3}, {1: 3.0, 2: 3.0}
_BACKWARD = 3.5  # times the systems
# runs near by: how near counts (of the box's diagonal units), what a run of the other order counts, runs' worth of the middle
_NEAR, _OTHER_ORDER, _PRIOR = 0.3, 0.5, 0.25
# logarithm of what is left unknown: by order without runs near by, what states before end-systole add, with many runs; nine
# of ten lie from -1.3 to +1.9 of it
_UNKNOWN, _UNKNOWN_EARLY, _LEFT = {1: 0.30, 2: 0.45}, 0.35, 0.17
_BELOW, _ABOVE = 1.3, 1.9


@dataclass(frozen=True)
class Cost:
    """What a simulation will cost, in CPU seconds and MB.

    unknowns: of displacements and pressures; low_s and high_s: between them it lies in nine of ten scenes; runs: finished runs
    that it was corrected by (0: none here, the machine is taken for the one the constants are from).
    """

    unknowns: int
    cpu_s: float
    peak_memory_mb: float
    runs: int
    low_s: float
    high_s: float


@dataclass(frozen=True)
class Earlier:
    """A finished run: its scene, its features (``unknowns`` among them), CPU seconds and memory; whether it began where another
    had ended, which tells the machine's speed and not how many systems a run takes."""

    scene: Scene
    features: Mapping[str, Any]
    warm: bool = False


def unknowns(bundle: Bundle, order: int) -> int:
    """Unknowns of a linear system: three displacements a corner, for second order a mid-edge point too; a pressure a corner."""
    nodes = corners = len(np.unique(bundle.tets[:, :4]))
    if order == 2:
        pairs = np.concatenate([np.sort(bundle.tets[:, list(edge)], axis=1) for edge in TET10_EDGES])
        nodes += len(np.unique(pairs @ np.array([len(bundle.points), 1])))
    return 3 * nodes + corners


def softest_kpa(scene: Scene) -> float:
    """The least C alpha of a region, kPa."""
    regional = dict(zip(STUDY, parameters_of(scene, STUDY), strict=True))
    return min(
        value * regional[name.replace("c_", "alpha_").removesuffix("_kpa")]
        for name, value in regional.items()
        if name[:2] == "c_"
    )


def early_states(scene: Scene) -> int:
    """States between end-diastole and end-systole that a scene asks for."""
    outputs, es = scene.outputs, scene.motion.es_time
    return sum(0 < t < es - SAME_TIME for t in outputs.times) if outputs.times else max(1, outputs.frames) - 1


def systems(scene: Scene) -> float:
    """Linear systems that an ordinary scene takes, in the middle, to its last state."""
    soft = softest_kpa(scene)
    level, by_soft, by_edp, by_esp = _SYSTEMS
    count = exp(
        level + by_soft * log(soft) + by_edp * log(max(scene.loads.edp_mmhg, _LEAST_EDP)) + by_esp * log(scene.loads.esp_mmhg)
    )
    if scene.numerics.order == 2:
        count *= _QUADRATIC
    if scene.pericardium.k_peri_kpa_per_um == 0:
        count *= _UNHELD
    outputs = scene.outputs
    second = _SECOND * count * outputs.equilibria
    by_states, by_states_soft = _EARLY[scene.numerics.order]
    count *= (1 + early_states(scene)) ** max(0.0, by_states - by_states_soft * log(soft))
    late = sum(t > scene.motion.es_time for t in outputs.times) if outputs.times else max(4, outputs.frames) * outputs.conduit
    return count + second + _CONDUIT * late


def price(scene: Scene, count: int, solved: float) -> float:
    """CPU seconds of a scene with its terms, ``count`` unknowns and ``solved`` linear systems, by the constants' machine."""
    order = scene.numerics.order
    system, power, start = _SYSTEM[order]
    cpu = start * count + solved * system * (count / 1e4) ** power
    loads, outputs, numerics = scene.loads, scene.outputs, scene.numerics
    strained = loads.edp_mmhg > 0
    if outputs.unloaded and strained:
        cpu *= _UNLOADED
    if outputs.sensitivities:
        frames = len(outputs.times) if outputs.times else outputs.frames
        cpu *= _SENSITIVITIES[order] + _FRAME * max(0, frames - 1)
    cpu *= _POINTS_14[order] if numerics.quadrature == 14 else 1.0
    return cpu * (_SCRIPT[order] if numerics.engine == "script" else 1.0)


def ordinary(scene: Scene, count: int) -> tuple[float, float]:
    """CPU seconds and memory (MB) of an ordinary scene with these terms and ``count`` unknowns, by the constants' machine."""
    least, each = _MEMORY_MB[scene.numerics.order]
    return price(scene, count, _all_systems(scene)), least + each * count


def expected(scene: Scene, bundle: Bundle, earlier: Iterable[Earlier]) -> Cost:
    """Cost of a scene, from its own numbers and from finished runs: these tell how fast the machine is (seconds against those of
    as many systems), and those near by in the inputs how many systems it takes of what an ordinary scene would."""
    count = unknowns(bundle, scene.numerics.order)
    cpu, memory = ordinary(scene, count)
    known = [run for run in earlier if all(run.features.get(name) for name in ("unknowns", "cpu_s", "newton_iterations"))]
    if not known:
        return _cost(scene, count, cpu, memory, 0, 0.0)
    here = _inputs(scene)
    speeds, more, weights, of_memory = [], [], [], []
    for run in known:
        size, solved = int(run.features["unknowns"]), float(run.features["newton_iterations"])
        speeds.append(log(float(run.features["cpu_s"]) / price(run.scene, size, solved)))
        more.append(log(solved / _all_systems(run.scene)))
        apart = float(np.linalg.norm(_inputs(run.scene) - here)) / _NEAR
        same = 1.0 if run.scene.numerics.order == scene.numerics.order else _OTHER_ORDER
        weights.append(0.0 if run.warm else exp(-0.5 * apart**2) * same)
        if used := run.features.get("peak_memory_mb"):
            of_memory.append(float(used) / ordinary(run.scene, size)[1])
    weight = sum(weights)
    shift = sum(w * m for w, m in zip(weights, more, strict=True)) / (weight + _PRIOR)
    foretold = price(scene, count, _all_systems(scene) * exp(shift)) * exp(median(speeds))
    return _cost(scene, count, foretold, memory * (median(of_memory) if of_memory else 1.0), len(known), weight)


def _cost(scene: Scene, count: int, cpu: float, memory: float, runs: int, weight: float) -> Cost:
    """With its range, for runs near by of a weight in all."""
    blind = _UNKNOWN[scene.numerics.order] ** 2 + (_UNKNOWN_EARLY**2 if early_states(scene) else 0.0)
    unknown = sqrt(_LEFT**2 + (blind - _LEFT**2) * _PRIOR / (weight + _PRIOR))
    return Cost(count, cpu, memory, runs, cpu * exp(-_BELOW * unknown), cpu * exp(_ABOVE * unknown))


def _all_systems(scene: Scene) -> float:
    """With what the scene's way of finding end-diastole adds: sweeps."""
    strained = scene.loads.edp_mmhg > 0
    if strained and scene.numerics.unloading == "backward":
        return _BACKWARD * systems(scene)
    return systems(scene) * (1.0 + _REST * scene.numerics.rest_sweeps * strained)


def _inputs(scene: Scene) -> FloatArray:
    """The study's inputs as shares of their ranges (14,)."""
    low, high = np.array([QUANTITIES[name].study for name in STUDY], float).T
    return np.asarray((np.array(parameters_of(scene, STUDY)) - low) / (high - low))
