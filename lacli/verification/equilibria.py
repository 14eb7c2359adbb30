"""Solved verification problems: a beam, an ellipsoid, an inflated sphere, an unloaded shell. mm, kPa."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import SimulationError
from lacli.contracts.bundle import Bundle
from lacli.freefem.names import Task
from lacli.verification import meshes
from lacli.verification.runs import GUCCIONE, NEO_HOOKEAN, Check, Setup, Solution, compare, material, solve

# Land et al. 2015 (Proc. R. Soc. A 471:20150641), problems 1 and 2, converged values; mm and mm3
BEAM_POINT = (10.0, 0.5, 1.0)
BEAM_MOVED = {"x": 9.1767, "z": 4.169}
ELLIPSOID_APICES = {"apex_endo_z": (-17.0, -26.612), "apex_epi_z": (-20.0, -28.279)}
ELLIPSOID_VOLUME = 10734.3
ELLIPSOID_ENDO, ELLIPSOID_CUT = (7.0, 17.0), 5.0


def clamp(bundle: Bundle, tag: int) -> tuple[IntArray, IntArray]:
    """All coordinates of the nodes of a boundary."""
    nodes = np.unique(bundle.triangles[bundle.tags == tag])
    return np.repeat(nodes, 3), np.tile(np.arange(3), len(nodes))


def nearest(bundle: Bundle, point: tuple[float, float, float]) -> int:
    """The node at ``point``."""
    distance = np.linalg.norm(bundle.points - np.array(point), axis=1)
    assert distance.min() < 1e-6, point
    return int(distance.argmin())


def damping(pressure: float, thickness: float, move: float) -> dict[str, float]:
    """Steering for all the load (kPa) at once, thickness and longest move of a node in mm: a viscosity that lets the load
    move the wall so far a step, from the first step on. Takes fewer factorisations than load steps or damping on demand."""
    viscosity = pressure / (thickness * move)
    return {"move_limit": move, "viscosity": viscosity, "first_viscosity": viscosity}


def beam_mesh(cells: tuple[int, int, int] = (28, 4, 5), grading: float = 2.0) -> Bundle:
    """10 x 1 x 1 mm; bricks along x, y, z; those along x shorten towards the clamp as s ** grading."""
    x = 10.0 * np.linspace(0, 1, cells[0] + 1) ** grading
    return meshes.box((x, np.linspace(0, 1, cells[1] + 1), np.linspace(0, 1, cells[2] + 1)), meshes.sides)


def solve_beam(
    bundle: Bundle, kappa: tuple[float, float] = (10.0, 0.0), points: int = 4, **steering: float
) -> tuple[Solution, FloatArray]:
    """Problem 1: the solution and where the point went. ``kappa``: kPa at the points and on the field (0: incompressible)."""
    tissue = material(GUCCIONE, 2.0, (8.0, 4.0, 2.0), *kappa)
    damped = damping(0.004, 1.0, 2.0) | steering
    setup = Setup(bundle, tissue, clamp(bundle, 1), 0.004, (5,), points=points, task=Task.UNSYMMETRIC, **damped)  # type: ignore[arg-type]
    solution = solve(setup)
    return solution, solution.states["loaded"][0][nearest(bundle, BEAM_POINT)]


def beam() -> list[Check]:
    """Land's problem 1: a clamped beam bends under a follower pressure."""
    solution, moved = solve_beam(beam_mesh())
    at = {"x": moved[0], "z": moved[2]}
    return [compare("beam", axis, at[axis], BEAM_MOVED[axis], 0.02, solution.unknowns, solution.cpu_s) for axis in ("x", "z")]


def solve_ellipsoid(
    bundle: Bundle, kappa: tuple[float, float] = (100.0, 0.0), points: int = 14, **steering: float
) -> tuple[Solution, dict[str, float]]:
    """Problem 2: the solution, both apices' z (mm) and the cavity's volume (mm3), closed by the base plane's disc."""
    tissue = material(GUCCIONE, 10.0, (1.0, 1.0, 1.0), *kappa)
    damped = damping(10.0, 3.0, 4.0) | steering
    setup = Setup(bundle, tissue, clamp(bundle, meshes.CUT), 10.0, (meshes.INNER,), points=points, **damped)  # type: ignore[arg-type]
    solution = solve(setup)
    x = solution.states["loaded"][0]
    found = {name: float(x[nearest(bundle, (0, 0, z)), 2]) for name, (z, _) in ELLIPSOID_APICES.items()}
    # the fixed base adds z n.dA / 3 over its disc to the surface's integral of x.n / 3
    disc = np.pi * ELLIPSOID_ENDO[0] ** 2 * (1 - (ELLIPSOID_CUT / ELLIPSOID_ENDO[1]) ** 2)
    return solution, found | {"cavity_volume": solution.volume + ELLIPSOID_CUT * disc / 3.0}


def ellipsoid(size: float = 2.8, layers: int = 1) -> list[Check]:
    """Land's problem 2: an ellipsoid inflated to 10 kPa."""
    solution, found = solve_ellipsoid(meshes.ellipsoid(size, layers))
    cost = solution.unknowns, solution.cpu_s
    checks = [compare("ellipsoid", name, found[name], z, 0.02, *cost) for name, (_, z) in ELLIPSOID_APICES.items()]
    volume = found["cavity_volume"]
    return [*checks, compare("ellipsoid", "cavity_volume", volume, ELLIPSOID_VOLUME, 0.003, *cost, scale=ELLIPSOID_VOLUME)]


SPHERE_RADII = (10.0, 15.0)
SPHERE_C = 2.0


def sphere_pressure(inner_radius: float, radii: tuple[float, float] = SPHERE_RADII, c: float = SPHERE_C) -> float:
    """Pressure (kPa) that takes the inner radius of an incompressible sphere of W = c (I1 - 3) to ``inner_radius``:
    4c [1/l + 1/(4 l^4)] from the inner to the outer stretch l (e.g. Ogden, Non-linear Elastic Deformations, 5.3.1)."""
    inner, outer = radii
    outer_radius = (outer**3 + inner_radius**3 - inner**3) ** (1 / 3)

    def term(stretch: float) -> float:
        return 1 / stretch + 1 / (4 * stretch**4)

    return 4 * c * (term(outer_radius / outer) - term(inner_radius / inner))


def on_planes(bundle: Bundle) -> tuple[IntArray, IntArray]:
    """The nodes on the coordinate planes, held across them."""
    nodes = [np.flatnonzero(np.abs(bundle.points[:, axis]) < 1e-9) for axis in range(3)]
    return np.concatenate(nodes), np.concatenate([np.full(len(k), axis) for axis, k in enumerate(nodes)])


def solve_sphere(
    bundle: Bundle, inner_radius: float, kappa: tuple[float, float] = (0.0, 0.0), points: int = 14
) -> tuple[Solution, FloatArray]:
    """An octant under the pressure of ``inner_radius`` mm: the solution, and the inner nodes' radii."""
    tissue = material(NEO_HOOKEAN, SPHERE_C, (1.0, 1.0, 1.0), *kappa)
    solution = solve(Setup(bundle, tissue, on_planes(bundle), sphere_pressure(inner_radius), (meshes.INNER,), points=points))
    inside = np.unique(bundle.triangles[bundle.tags == meshes.INNER])
    return solution, np.linalg.norm(solution.states["loaded"][0][inside], axis=1)


def sphere(size: float = 1.5) -> list[Check]:
    """An incompressible neo-Hookean sphere at two pressures against the exact radius; the worst node counts."""
    bundle = meshes.sphere(*SPHERE_RADII, size)
    checks = []
    for radius in (11.0, 13.0):
        solution, found = solve_sphere(bundle, radius)
        worst = float(found[np.abs(found - radius).argmax()])
        quantity = f"inner_radius_{sphere_pressure(radius):.2f}_kpa"
        checks.append(compare("sphere", quantity, worst, radius, 0.002, solution.unknowns, solution.cpu_s, scale=radius))
    return checks


UNLOAD_PRESSURE = 1.0  # 7.5 mmHg, in the middle of what end-diastole has


def unload() -> list[Check]:
    """A shell is loaded, its loaded shape is taken for an image, and the shape at rest is found again, by the backward
    displacement of simulations (which filters: it leaves a shape error) and as an inverse problem (exact); loading the
    latter gives the image back. Distances in mm, over all nodes."""
    bundle = meshes.ellipsoid(5.0)
    tissue = material(GUCCIONE, 1.7, (4.0, 4.0, 4.0), 100.0, 900.0)
    setup = Setup(bundle, tissue, clamp(bundle, meshes.CUT), UNLOAD_PRESSURE, (meshes.INNER,), points=4, unload=True)
    solution = solve(setup)
    image, original = solution.states["loaded"]
    cost = solution.unknowns, solution.cpu_s

    def apart(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.linalg.norm(a - b, axis=1)

    if not apart(image, original).max() > 1.0:
        raise SimulationError("no_load", "The load does not move the shell, so nothing is tested.")
    unloaded = solution.other["unloaded"]
    volume, mean = unloaded["volume"], unloaded["mean_mm"]
    reference, reloaded = solution.states["inverse"][1], solution.states["reloaded"][0]
    return [
        compare("unload", "ed_volume_error", volume, 0.0, 0.01, *cost),
        compare("unload", "ed_shape_mean_mm", mean, 0.0, 0.3, *cost),
        compare("unload", "inverse_rest_max_mm", float(apart(reference, original).max()), 0.0, 1e-6, *cost),
        compare("unload", "reloaded_max_mm", float(apart(reloaded, image).max()), 0.0, 1e-6, *cost),
    ]
