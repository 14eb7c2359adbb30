"""Assembled forms against what they must be: patch test, pressure force, springs. mm, kPa."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle, as_order
from lacli.freefem.names import Faces, Task
from lacli.geometry.quadrature import at_quadrature
from lacli.verification import meshes
from lacli.verification.equilibria import on_planes
from lacli.verification.laws import OFFSETS, difference
from lacli.verification.runs import GUCCIONE, NEO_HOOKEAN, Check, Form, Setup, ask, compare, material, solve, vertices

TOLERANCE = 1e-9
KAPPA = (100.0, 900.0)
TISSUE = material(GUCCIONE, 1.7, (8.0, 4.0, 3.0), *KAPPA, 1.3, (0.6, 0.48, 0.64))
# linear cells steady their pressures: 1/kPa
STEADIED = np.append(TISSUE[:11], 0.05)


def distorted_box(curved: bool, seed: int = 3) -> Bundle:
    """A 3 x 2 x 2 mm box whose inner nodes stand anywhere near their place: vertices alone (straight cells), or middles
    too (curved cells)."""
    bundle = meshes.box((np.linspace(0, 3, 4), np.linspace(0, 2, 3), np.linspace(0, 2, 3)), meshes.sides)
    random = np.random.default_rng(seed)
    inside = np.ones(len(bundle.points), dtype=bool)
    inside[np.unique(bundle.triangles)] = False
    points = bundle.points.copy()
    corner = np.zeros(len(points), dtype=bool)
    corner[vertices(bundle)] = True
    moved = inside & corner
    points[moved] += 0.15 * random.uniform(-1, 1, (moved.sum(), 3))
    edges = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
    points[bundle.tets[:, 4:]] = points[bundle.tets[:, edges]].mean(axis=2)
    if curved:
        moved = inside & ~corner
        points[moved] += 0.04 * random.uniform(-1, 1, (moved.sum(), 3))
    return Bundle(points, bundle.tets, bundle.region, bundle.triangles, bundle.tags, info={})


def patch() -> list[Check]:
    """An affine map is in equilibrium inside any mesh, and is found again from a disturbed start; tangents are derivatives."""
    affine = np.array([[1.12, 0.2, -0.05], [0.04, 0.93, 0.1], [0.02, -0.08, 1.01]])
    pressure = KAPPA[1] * np.log(np.linalg.det(affine))
    checks = []
    # curved cells have integrands of degree 3: 4 points are exact on straight cells alone
    straight, curved = distorted_box(False), distorted_box(True)
    linear = as_order(straight, 1)
    for name, bundle, points in (("straight_cells", straight, 4), ("curved_cells", curved, 14), ("linear_cells", linear, 4)):
        tissue = TISSUE if bundle.order == 2 else STEADIED
        x, nv = bundle.points @ affine.T, len(vertices(bundle))
        unknowns = 3 * len(x) + nv
        answers, cpu = ask(bundle, tissue, [Form(Task.RESIDUAL, x, bundle.points, np.full(nv, pressure))], [], points)
        outside = np.unique(bundle.triangles)
        inside = np.setdiff1d(np.arange(len(x)), outside)
        force = answers[0].force
        scale = float(np.abs(force[outside]).max())
        residual = float(np.abs(force[inside]).max())
        checks.append(compare("patch", f"{name}_residual", residual, 0.0, TOLERANCE, unknowns, cpu, scale))
        start = x.copy()
        start[inside] += 0.03 * np.random.default_rng(4).uniform(-1, 1, (len(inside), 3))
        held = np.repeat(outside, 3), np.tile(np.arange(3), len(outside))
        solution = solve(Setup(bundle, tissue, held, start=start, at=x, points=points, tolerance=1e-9))
        error = float(np.abs(solution.states["loaded"][0] - x).max())
        checks.append(compare("patch", f"{name}_field", error, 0.0, TOLERANCE, unknowns, solution.cpu_s))
    return checks + _tangent_checks(curved, "") + _tangent_checks(linear, "linear_") + [_uniaxial_check()]


def disturbed(bundle: Bundle, size: float, seed: int) -> FloatArray:
    """A smooth, far from affine deformation of the box, mm."""
    random = np.random.default_rng(seed)
    a, b = random.standard_normal((3, 3)), random.standard_normal((3, 3))
    return bundle.points + size * np.sin(bundle.points @ a) + size * np.cos(bundle.points @ b)


def _tangent_checks(bundle: Bundle, prefix: str) -> list[Check]:
    """Tangents of the forward and the inverse problem, all kinds of faces loaded, against differences of the residual."""
    h = 1e-4
    random = np.random.default_rng(9)
    n, nv = len(bundle.points), len(vertices(bundle))
    x, X, p = disturbed(bundle, 0.05, 1), disturbed(bundle, 0.02, 2), 10 * random.standard_normal(nv)
    v, dp = random.standard_normal((n, 3)), 10 * random.standard_normal(nv)
    loads = 2.0, 1.5, 2.5
    faces = [
        (Faces.PRESSURE, bundle.tags == 5, None),
        (Faces.VEINS, bundle.tags == 1, None),
        (Faces.PERICARDIUM, bundle.tags == 6, None),
    ]
    checks = []
    for name, task in (("tangent", Task.UNSYMMETRIC), ("inverse_tangent", Task.INVERSE)):
        inverse = task == Task.INVERSE
        forms = [Form(task, x, X, p, v, dp, loads=loads)]
        for t in OFFSETS * h:
            forms.append(Form(Task.RESIDUAL, x if inverse else x + t * v, X + t * v if inverse else X, p + t * dp, loads=loads))
        answers, cpu = ask(bundle, TISSUE if bundle.order == 2 else STEADIED, forms, faces)
        found = np.concatenate([answers[0].tangent_force.ravel(), answers[0].tangent_gap])
        exact = difference(np.array([np.concatenate([a.force.ravel(), a.gap]) for a in answers[1:]]), h)
        error = float(np.abs(found - exact).max())
        checks.append(compare("patch", prefix + name, error, 0.0, TOLERANCE, 3 * n + nv, cpu, scale=float(np.abs(exact).max())))
    return checks


def _uniaxial_check() -> Check:
    """A free incompressible neo-Hookean block pushed on one end: pressure 2c (1/l - l^2) shortens it to the stretch l."""
    bundle, c, stretch = distorted_box(True), 2.0, 0.85
    held = on_planes(bundle)
    load = 2 * c * (1 / stretch - stretch**2)
    solution = solve(Setup(bundle, material(NEO_HOOKEAN, c), held, load, (2,), task=Task.UNSYMMETRIC, tolerance=1e-9))
    end = np.unique(bundle.triangles[bundle.tags == 2])
    found = solution.states["loaded"][0][end, 0] / 3.0
    worst = float(found[np.abs(found - stretch).argmax()])
    return compare("patch", "uniaxial_stretch", worst, stretch, TOLERANCE, solution.unknowns, solution.cpu_s, scale=stretch)


def hollow_box() -> Bundle:
    """A 4 x 3 x 3 mm box with a hollow of 2 x 1 x 1 mm; the hollow's faces have tag 0."""
    breaks = (np.linspace(0, 4, 5), np.linspace(0, 3, 4), np.linspace(0, 3, 4))
    keep = np.ones((4, 3, 3), dtype=bool)
    keep[1:3, 1, 1] = False
    return meshes.box(breaks, meshes.sides, keep)


def pressure() -> list[Check]:
    """A closed cavity: its volume, the pressure's force as the volume's derivative, no net force, a symmetric tangent."""
    bundle = hollow_box()
    cavity = bundle.tags == 0
    random = np.random.default_rng(5)
    n, nv = len(bundle.points), len(vertices(bundle))
    affine = np.array([[1.1, 0.3, 0.0], [-0.1, 0.9, 0.2], [0.2, 0.1, 1.2]])
    x, X, zero = disturbed(bundle, 0.06, 6) @ affine.T, bundle.points, np.zeros(nv)
    v, w = random.standard_normal((n, 3)), random.standard_normal((n, 3))
    h, load = 1e-2, 3.0
    forms = [
        Form(Task.RESIDUAL, bundle.points @ affine.T, X, zero),
        Form(Task.RESIDUAL, x, X, zero),
        Form(Task.RESIDUAL, x, X, zero, loads=(load, 0.0, 0.0)),
        Form(Task.UNSYMMETRIC, x, X, zero, v),
        Form(Task.UNSYMMETRIC, x, X, zero, v, loads=(load, 0.0, 0.0)),
        Form(Task.UNSYMMETRIC, x, X, zero, w),
        Form(Task.UNSYMMETRIC, x, X, zero, w, loads=(load, 0.0, 0.0)),
        Form(Task.SYMMETRIC, x, X, zero, v),
        Form(Task.SYMMETRIC, x, X, zero, v, loads=(load, 0.0, 0.0)),
        *[Form(Task.RESIDUAL, x + t * v, X, zero) for t in OFFSETS * h],
    ]
    # soft and without volume terms, so that the wall's own forces do not hide the pressure's
    soft = material(NEO_HOOKEAN, 1e-3)
    a, cpu = ask(bundle, soft, forms, [(Faces.PRESSURE, cavity, None)])
    cost = 3 * n + nv, cpu
    force = a[2].force - a[1].force
    rate = float(difference(np.array([b.volume for b in a[9:]]), h))
    Kv, Kw = a[4].tangent_force - a[3].tangent_force, a[6].tangent_force - a[5].tangent_force
    symmetric = a[8].tangent_force - a[7].tangent_force
    size = float(np.linalg.norm(Kv) * np.linalg.norm(w))
    exact = 2.0 * float(np.linalg.det(affine))
    return [
        compare("pressure", "volume_mm3", a[0].volume, exact, TOLERANCE, *cost, scale=exact),
        compare("pressure", "work_per_volume", float(np.sum(force * v)), -load * rate, TOLERANCE, *cost, scale=abs(load * rate)),
        compare(
            "pressure",
            "net_force",
            float(np.abs(force.sum(axis=0)).max()),
            0.0,
            TOLERANCE,
            *cost,
            scale=float(np.abs(force).sum()),
        ),
        compare("pressure", "symmetry", float(np.sum(w * Kv)), float(np.sum(v * Kw)), TOLERANCE, *cost, scale=size),
        compare(
            "pressure",
            "symmetric_form",
            float(np.abs(symmetric - Kv).max()),
            0.0,
            TOLERANCE,
            *cost,
            scale=float(np.abs(Kv).max()),
        ),
    ]


def spring() -> list[Check]:
    """Springs on a turned box that moves by u as a whole, two meshes. Veins: stiffness x area x u. Pericardium: stiffness x
    sum of areas (u.n) n, with a weight that rises along the box; outward: only over the sides that u leaves through."""
    checks = []
    turn = np.linalg.qr(np.random.default_rng(11).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    size, stiffness = np.array([3.0, 2.0, 1.0]), 0.7
    u = np.array([0.3, -0.2, 0.5])
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])  # of one side across x, y, z
    along = turn.T @ u
    for bricks in ((2, 1, 1), (5, 3, 2)):
        flat = meshes.box(tuple(np.linspace(0, s, k + 1) for s, k in zip(size, bricks, strict=True)), meshes.sides)  # type: ignore[arg-type]
        bundle = Bundle(flat.points @ turn.T, flat.tets, flat.region, flat.triangles, flat.tags, info={})
        n, nv = len(bundle.points), len(vertices(bundle))
        every, top = np.ones(len(bundle.tags), dtype=bool), bundle.tags == 2
        weight = at_quadrature(flat.triangles[:, :3], flat.points[:, 0]) / size[0]
        # weight x / 3 mm: 1/2 on average, 0 on the side x low, 1 on the side x high
        normal = turn @ (areas * along)
        outward = turn @ (areas * np.array([float(along[0] > 0), 0.5, 0.5]) * along)
        cases = {
            "vein_force": ((Faces.VEINS, top, None), (0.0, stiffness, 0.0), areas[0] * u),
            "pericardium_force": ((Faces.PERICARDIUM, every, weight), (0.0, 0.0, stiffness), normal),
            "outward_force": ((Faces.OUTWARD, every, weight), (0.0, 0.0, stiffness), outward),
        }
        for name, (faces, loads, exact) in cases.items():
            form = Form(Task.RESIDUAL, bundle.points + u, bundle.points, np.zeros(nv), loads=loads)
            answers, cpu = ask(bundle, material(NEO_HOOKEAN, 1.0), [form], [faces])
            found, wanted = answers[0].force.sum(axis=0), stiffness * exact
            k = int(np.abs(found - wanted).argmax())
            scale = float(np.linalg.norm(wanted))
            quantity = f"{name}_{len(bundle.tets)}_cells"
            checks.append(compare("spring", quantity, found[k], wanted[k], TOLERANCE, 3 * n + nv, cpu, scale=scale))
    return checks
