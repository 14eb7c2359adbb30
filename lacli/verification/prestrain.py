"""The prestrain of an image against what it must be: tangents, a homogeneous strain, an exact sphere, unloading. mm, kPa."""

from __future__ import annotations

import numpy as np
from scipy.integrate import quad
from scipy.linalg import expm

from lacli.base.errors import SimulationError
from lacli.contracts.bundle import Bundle, as_order
from lacli.freefem.names import Faces, Task
from lacli.verification import meshes
from lacli.verification.equilibria import SPHERE_C, SPHERE_RADII, clamp, on_planes
from lacli.verification.forms import STEADIED, TISSUE, TOLERANCE, distorted_box, disturbed
from lacli.verification.laws import ALPHA, KAPPA_POINTS, OFFSETS, B, C, difference, guccione_stress
from lacli.verification.runs import GUCCIONE, NEO_HOOKEAN, Check, Form, Setup, ask, compare, material, solve, vertices


def prestrain() -> list[Check]:
    """The prestrain problem's parts."""
    curved = distorted_box(True)
    linear = as_order(distorted_box(False), 1)
    return [*_tangents(curved, ""), *_tangents(linear, "linear_"), *_homogeneous(), _sphere(), *_released()]


def _tangents(bundle: Bundle, prefix: str) -> list[Check]:
    """The prestrain's tangent, and that of a wall that has one, against differences of the residual; both residuals agree in
    the image."""
    h = 1e-4
    random = np.random.default_rng(13)
    n, nv = len(bundle.points), len(vertices(bundle))
    X = bundle.points
    v, p = disturbed(bundle, 0.05, 3) - X, 10 * random.standard_normal(nv)
    d, dp = random.standard_normal((n, 3)), 10 * random.standard_normal(nv)
    x = disturbed(bundle, 0.03, 4)
    loads = 2.0, 1.5, 2.5
    faces = [
        (Faces.PRESSURE, bundle.tags == 5, None),
        (Faces.VEINS, bundle.tags == 1, None),
        (Faces.PERICARDIUM, bundle.tags == 6, None),
    ]
    forms = [Form(Task.PRESTRAIN, v, X, p, d, dp, loads)]
    forms += [Form(Task.PRESTRAIN_RESIDUAL, v + t * d, X, p + t * dp, loads=loads) for t in OFFSETS * h]
    forms += [Form(Task.PRESTRAIN_RESIDUAL, v, X, p, loads=loads), Form(Task.KEEP_PRESTRAIN, v, X, p, loads=loads)]
    forms += [Form(Task.UNSYMMETRIC, x, X, p, d, dp, loads)]
    forms += [Form(Task.RESIDUAL, x + t * d, X, p + t * dp, loads=loads) for t in OFFSETS * h]
    answers, cpu = ask(bundle, TISSUE if bundle.order == 2 else STEADIED, forms, faces)
    whole = [np.concatenate([a.force.ravel(), a.gap]) for a in answers]
    checks = []
    for name, first in (("tangent", 0), ("strained_tangent", 7)):
        found = np.concatenate([answers[first].tangent_force.ravel(), answers[first].tangent_gap])
        exact = difference(np.array(whole[first + 1 : first + 5]), h)
        scale = float(np.abs(exact).max())
        checks.append(
            compare("prestrain", prefix + name, float(np.abs(found - exact).max()), 0.0, TOLERANCE, 3 * n + nv, cpu, scale)
        )
    gap = float(np.abs(whole[5] - whole[6]).max())
    scale = float(np.abs(whole[5]).max())
    return [*checks, compare("prestrain", prefix + "residual_in_the_image", gap, 0.0, TOLERANCE, 3 * n + nv, cpu, scale)]


def _homogeneous() -> list[Check]:
    """v = e x with a symmetric e: no force inside; the force on a side is its area times sigma n, sigma = P(U) U / J, U = exp e,
    with the fibre that U turns into the image's."""
    e = np.array([[0.15, 0.06, -0.02], [0.06, -0.08, 0.04], [-0.02, 0.04, 0.03]])
    bundle = distorted_box(True)
    n, nv = len(bundle.points), len(vertices(bundle))
    U, p = expm(e), 7.0
    f = np.linalg.solve(U, np.array([0.6, 0.48, 0.64]))
    stress = guccione_stress(U, f / np.linalg.norm(f), p, C, ALPHA, B, KAPPA_POINTS)
    sigma = stress @ U / np.linalg.det(U)
    answers, cpu = ask(bundle, TISSUE, [Form(Task.PRESTRAIN_RESIDUAL, bundle.points @ e, bundle.points, np.full(nv, p))], [])
    force = answers[0].force
    inside = np.setdiff1d(np.arange(n), np.unique(bundle.triangles))
    scale = float(np.abs(force).max())
    moment = np.einsum("ni,nj->ij", force, bundle.points)  # virial: volume x sigma, for a body in equilibrium
    volume = 3.0 * 2.0 * 2.0
    worst = np.unravel_index(np.abs(moment / volume - sigma).argmax(), (3, 3))
    cost = 3 * n + nv, cpu
    return [
        compare("prestrain", "homogeneous_inside", float(np.abs(force[inside]).max()), 0.0, TOLERANCE, *cost, scale),
        compare(
            "prestrain",
            "homogeneous_stress",
            float(moment[worst] / volume),
            float(sigma[worst]),
            TOLERANCE,
            *cost,
            float(np.abs(sigma).max()),
        ),
    ]


def sphere_prestrain_pressure(c: float, radii: tuple[float, float] = SPHERE_RADII, stiffness: float = SPHERE_C) -> float:
    """Pressure (kPa) that an incompressible sphere of W = stiffness (I1 - 3) holds in an image of these radii (mm) with the
    prestrain v = c / r^2 radially: div v = 0; stretches exp(c / r^3) around, exp(-2 c / r^3) along the radius; the balance
    of stress gives the integral of 2 (sigma_t - sigma_r) / r = 4 stiffness (l_t^2 - l_r^2) / r."""

    def integrand(r: float) -> float:
        return 4 * stiffness * (np.exp(2 * c / r**3) - np.exp(-4 * c / r**3)) / r

    return float(quad(integrand, *radii, epsabs=1e-13, epsrel=1e-13)[0])


def _sphere(size: float = 1.3) -> Check:
    """The only strain that a pressurised incompressible sphere can have in its image, at the inner radius: v = c / a^2."""
    bundle = meshes.sphere(*SPHERE_RADII, size)
    c = 120.0
    tissue = material(NEO_HOOKEAN, SPHERE_C)
    pressure = sphere_prestrain_pressure(c)
    solution = solve(Setup(bundle, tissue, on_planes(bundle), pressure, (meshes.INNER,), prestrain=True))
    inside = np.unique(bundle.triangles[bundle.tags == meshes.INNER])
    v = solution.states["loaded"][0][inside] - bundle.points[inside]
    radial = np.einsum("ni,ni->n", v, bundle.points[inside]) / SPHERE_RADII[0]
    exact = c / SPHERE_RADII[0] ** 2
    worst = float(radial[np.abs(radial - exact).argmax()])
    return compare("prestrain", "sphere_v_mm", worst, exact, 0.002, solution.unknowns, solution.cpu_s, exact)


def _released() -> list[Check]:
    """A shell in its image: forward forces balance there; without the pressure it shrinks, under it again it is the image."""
    bundle = meshes.ellipsoid(5.0)
    tissue = material(GUCCIONE, 1.7, (4.0, 4.0, 4.0), 100.0, 900.0)
    setup = Setup(bundle, tissue, clamp(bundle, meshes.CUT), 1.0, (meshes.INNER,), points=4, prestrain=True)
    solution = solve(setup)
    shrunk = np.linalg.norm(solution.states["unloaded"][0] - bundle.points, axis=1).max()
    back = np.linalg.norm(solution.states["reloaded"][0] - bundle.points, axis=1).max()
    if not shrunk > 0.5:
        raise SimulationError("no_load", "The pressure's end does not move the shell, so nothing is tested.")
    cost = solution.unknowns, solution.cpu_s
    return [
        compare("prestrain", "reloaded_max_mm", float(back), 0.0, 1e-6, *cost),
    ]
