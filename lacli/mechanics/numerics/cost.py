"""What a simulation will cost: linear systems times the price of one, on this machine and near this scene where runs tell.

The price of a system of n unknowns is known: the wall is thin, so a sparse direct solution costs nearly as in two dimensions,
n^1.5 (George 1973, SIAM J Numer Anal 10:345), assembly n; with the number of systems a run takes given, it tells CPU seconds
within 25 % for most runs. Memory is the factors' n log n, near enough n.

How many systems a scene takes goes with Laplace's measure of the softest region, pressure times radius over thickness times
stiffness: the strain that the load asks of it. It tells the middle only. Newton's method takes some three for the prestrain and
eight to end-systole where the wall stays smooth, and tens where a soft region snaps through. Scenes 1 % apart take the same
number, but what decides it changes over half the inputs' ranges. So the cost is a middle and a range. What finished runs took
more or less than their middle is taken for a Gaussian process of the inputs, and corrects both.

``benchmarks/terms.py`` measures prices, factors and what the forecast is worth, ``benchmarks/cost_fit.py`` the coefficients on
runs that were kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import exp, pi, sqrt
from statistics import median
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.features import SAME_TIME
from lacli.contracts.labels import ENDO, REGIONS
from lacli.contracts.parameters import QUANTITIES, STUDY
from lacli.contracts.scene import Scene, parameters_of
from lacli.geometry.quadrature import area_vectors
from lacli.geometry.tetrahedra import TET10_EDGES, boundary_faces, row_keys, volumes
from lacli.mechanics import engine
from lacli.mechanics.pressure import pressure_of

# by order: CPU seconds of a system of 10,000 unknowns, assembly included; the power of n; seconds to begin and end, an unknown
_SYSTEM = {1: (0.087, 1.267, 7.8e-5), 2: (0.116, 1.306, 5.3e-5)}
_MEMORY_MB = {1: (28.0, 0.0064), 2: (4.3, 0.0103)}  # and for each unknown, by order
# systems to end-systole, in the middle: exp(a) L^b, L Laplace's measure; quadratic cells bend where linear ones are too stiff,
# and take more
_SYSTEMS = (1.65, 0.33)
_QUADRATIC = 1.3
_UNHELD = 0.7  # of them, without pericardium
_EARLY = 0.29  # states before end-systole: systems as (1 + states) to that power
_SECOND = 1.2  # of the systems to end-systole, for a second way there: the middle of 19 soft walls, .7 to 2.7
_CONDUIT = 1.5  # systems for each stretch of the conduit
_UNLOADED, _FRAME = 1.3, 0.05  # factors of the whole; sensitivities of each further frame
_REST = 0.4  # of the whole, for each sweep of springs at rest where the wall relaxes
# by order: where solving is fast, assembly is what costs
_SENSITIVITIES, _POINTS_14 = {1: 1.06, 2: 1.05}, {1: 1.8, 2: 1.3}
_BACKWARD = 3.5  # times the systems
# what a scene's systems are more or less than the middle, as a Gaussian process of its inputs: standard deviation of the
# logarithm, length (shares of the inputs' ranges), correlation between orders and between anatomies, and what scenes near by
# do not share, the price of a system included
_FIELD, _NEAR, _OTHER_ORDER, _OTHER_ANATOMY, _SCATTER = 0.37, 0.5, 0.9, 0.84, 0.18
_BELOW, _ABOVE = 1.3, 1.9  # nine of ten lie between so many standard deviations


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
    """A finished run: its scene, its features (``unknowns`` among them), CPU seconds and memory; the slenderness of its wall,
    None where its anatomy is gone; whether it began where another had ended; the engine that made it ('': the one that the scene
    names). Without the first, or warm, it tells the machine's speed and not how many systems a run takes."""

    scene: Scene
    features: Mapping[str, Any]
    slender: Mapping[str, float] | None
    warm: bool = False
    engine: str = ""


def unknowns(bundle: Bundle, order: int) -> int:
    """Unknowns of a linear system: three displacements a corner, for second order a mid-edge point too; a pressure a corner."""
    nodes = corners = len(np.unique(bundle.tets[:, :4]))
    if order == 2:
        pairs = np.concatenate([np.sort(bundle.tets[:, list(edge)], axis=1) for edge in TET10_EDGES])
        nodes += len(np.unique(pairs @ np.array([len(bundle.points), 1])))
    return 3 * nodes + corners


def slenderness(bundle: Bundle) -> dict[str, float]:
    """Radius over thickness of each region that the wall has: of the ball with the cavity's volume; the wall's volume over the
    area of its endocardium."""
    tets, points = bundle.tets[:, :4], bundle.points
    faces, owner = boundary_faces(tets)
    of_faces, of_cavity = (
        row_keys(np.sort(rows, axis=1), len(points)) for rows in (faces, bundle.triangles[bundle.tags == ENDO][:, :3])
    )
    inside = np.isin(of_faces, of_cavity)
    area = np.linalg.norm(area_vectors(faces[inside], points).sum(axis=1), axis=1)
    region, volume = bundle.region[owner[inside]], np.abs(volumes(points, tets))
    radius = (3000.0 * bundle.cavity_volume_ml() / (4.0 * pi)) ** (1.0 / 3.0)
    return {
        name: radius * float(area[region == label].sum() / volume[bundle.region == label].sum())
        for name, label in REGIONS.items()
        if (region == label).any()
    }


def laplace(scene: Scene, slender: Mapping[str, float]) -> float:
    """End-systolic pressure times radius over thickness times C alpha, the greatest of a region: the measure of Laplace's law."""
    regional = dict(zip(STUDY, parameters_of(scene, STUDY), strict=True))
    pressure = pressure_of(scene.loads, scene.motion.es_time, None).at_es_kpa
    return max(pressure * ratio / (regional[f"c_{name}_kpa"] * regional[f"alpha_{name}"]) for name, ratio in slender.items())


def early_states(scene: Scene) -> int:
    """States between end-diastole and end-systole that a scene asks for."""
    outputs, es = scene.outputs, scene.motion.es_time
    return sum(0 < t < es - SAME_TIME for t in outputs.times) if outputs.times else max(1, outputs.frames) - 1


def systems(scene: Scene, slender: Mapping[str, float]) -> float:
    """Linear systems that an ordinary scene takes on a wall, in the middle, to its last state."""
    level, by_load = _SYSTEMS
    # without a load there is a system to solve all the same
    count = max(1.0, exp(level) * max(0.0, laplace(scene, slender)) ** by_load)
    if scene.numerics.order == 2:
        count *= _QUADRATIC
    if scene.pericardium.k_peri_kpa_per_um == 0:
        count *= _UNHELD
    outputs = scene.outputs
    second = _SECOND * count * outputs.equilibria
    count *= (1 + early_states(scene)) ** _EARLY
    late = sum(t > scene.motion.es_time for t in outputs.times) if outputs.times else max(4, outputs.frames) * outputs.conduit
    return count + second + _CONDUIT * late


def price(scene: Scene, count: int, solved: float, by: str = "") -> float:
    """CPU seconds of a scene with its terms, ``count`` unknowns and ``solved`` linear systems, by the constants' machine.

    by: the engine, ``plugin`` or ``script``; '': the one that the scene names, the plugin for "auto".
    """
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
    return cpu * (engine.SLOWER[order] if (by or numerics.engine) == "script" else 1.0)


def ordinary(scene: Scene, count: int, slender: Mapping[str, float]) -> tuple[float, float]:
    """CPU seconds and memory (MB) of an ordinary scene with these terms and ``count`` unknowns, by the constants' machine."""
    return price(scene, count, _all_systems(scene, slender)), _memory_mb(scene, count)


def expected(scene: Scene, bundle: Bundle, earlier: Iterable[Earlier]) -> Cost:
    """Cost of a scene, from its own numbers and from finished runs: these tell how fast the machine is (seconds against those of
    as many systems), and those near by in the inputs how many systems it takes of what an ordinary scene would. Of "auto" it is
    the cost with the engine that it finds here."""
    count, slender = unknowns(bundle, scene.numerics.order), slenderness(bundle)
    known = [run for run in earlier if all(run.features.get(name) for name in ("unknowns", "cpu_s", "newton_iterations"))]
    speed, of_memory = _machine(known)
    more, unknown = _more_systems(scene, known)
    middle = _all_systems(scene, slender) * exp(more)
    by = "script" if engine.obstacle(scene.numerics.engine) else "plugin"
    low, cpu, high = (speed * price(scene, count, middle * exp(at * unknown), by) for at in (-_BELOW, 0.0, _ABOVE))
    return Cost(count, cpu, _memory_mb(scene, count) * of_memory, len(known), low, high)


def _machine(known: list[Earlier]) -> tuple[float, float]:
    """CPU seconds and memory of runs, over those of as many systems and unknowns by the constants' machine; 1 without runs."""
    speeds, of_memory = [], []
    for run in known:
        size, solved = int(run.features["unknowns"]), float(run.features["newton_iterations"])
        speeds.append(float(run.features["cpu_s"]) / price(run.scene, size, solved, run.engine))
        if used := run.features.get("peak_memory_mb"):
            of_memory.append(float(used) / _memory_mb(run.scene, size))
    return median(speeds or [1.0]), median(of_memory or [1.0])


def _more_systems(scene: Scene, known: list[Earlier]) -> tuple[float, float]:
    """Logarithm of how many times the middle's systems a scene takes, by runs near by, and its standard deviation."""
    telling = [run for run in known if run.slender and not run.warm]
    scenes = [*(run.scene for run in telling), scene]
    together = _together(scenes)
    among, here = together[:-1, :-1] + _SCATTER**2 * np.eye(len(telling)), together[:-1, -1]
    weights = np.linalg.solve(among, here)
    solved = [float(run.features["newton_iterations"]) / _all_systems(run.scene, run.slender or {}) for run in telling]
    return float(weights @ np.log(solved)), sqrt(together[-1, -1] + _SCATTER**2 - float(weights @ here))


def _together(scenes: list[Scene]) -> FloatArray:
    """Covariance (n, n) of what scenes take more or less than the middle."""
    inputs = np.array([scaled_inputs(scene) for scene in scenes])
    apart = np.sum((inputs[:, None] - inputs[None]) ** 2, axis=2)
    order = np.array([scene.numerics.order for scene in scenes])
    anatomy = np.array([str(scene.anatomy.bundle) for scene in scenes])
    shared = np.where(order[:, None] == order, 1.0, _OTHER_ORDER) * np.where(anatomy[:, None] == anatomy, 1.0, _OTHER_ANATOMY)
    return np.asarray(_FIELD**2 * np.exp(-0.5 * apart / _NEAR**2) * shared)


def _memory_mb(scene: Scene, count: int) -> float:
    least, each = _MEMORY_MB[scene.numerics.order]
    return least + each * count


def _all_systems(scene: Scene, slender: Mapping[str, float]) -> float:
    """With what the scene's way of finding end-diastole adds: sweeps."""
    strained = scene.loads.edp_mmhg > 0
    if strained and scene.numerics.unloading == "backward":
        return _BACKWARD * systems(scene, slender)
    return systems(scene, slender) * (1.0 + _REST * scene.numerics.rest_sweeps * strained)


def scaled_inputs(scene: Scene) -> FloatArray:
    """The study's inputs as shares of their ranges (14,)."""
    low, high = np.array([QUANTITIES[name].study for name in STUDY], float).T
    return np.asarray((np.array(parameters_of(scene, STUDY)) - low) / (high - low))
