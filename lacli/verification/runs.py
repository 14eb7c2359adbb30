"""FreeFEM runs of the verification problems: equilibria, forms at given states, laws at given points."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lacli.base import resources
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import SimulationError
from lacli.contracts.bundle import Bundle
from lacli.contracts.laws import NUMBER
from lacli.freefem import run as freefem
from lacli.freefem.files import CELL_ORDER, read_history, read_rows, read_state, write_arrays, write_faces, write_medit
from lacli.freefem.names import Task
from lacli.freefem.program import find
from lacli.freefem.template import render_template
from lacli.mechanics.engine import plugin
from lacli.mechanics.inputs import CELL_COLUMNS, Cell

TIMEOUT_S = 1800.0
GUCCIONE, NEO_HOOKEAN = NUMBER["guccione"], NUMBER["neo_hookean"]


@dataclass(frozen=True)
class Check:
    """One comparison. ``error`` has the unit of ``tolerance``: mm for positions and lengths, relative otherwise.
    ``unknowns`` counts all, held ones too; ``cpu_s`` is the solver's whole process."""

    name: str
    quantity: str
    computed: float
    reference: float
    error: float
    tolerance: float
    passed: bool
    unknowns: int
    cpu_s: float


def compare(
    name: str,
    quantity: str,
    computed: float,
    reference: float,
    tolerance: float,
    unknowns: int,
    cpu_s: float,
    scale: float = 1.0,
) -> Check:
    """A check of |computed - reference| / scale against the tolerance; a number that is not finite fails."""
    error = abs(computed - reference) / scale
    passed = bool(np.isfinite(error) and error <= tolerance)
    return Check(name, quantity, float(computed), float(reference), float(error), tolerance, passed, unknowns, cpu_s)


def material(
    law: int,
    c: float,
    constants: Sequence[float] = (1.0, 1.0, 1.0),
    kappa_points: float = 0.0,
    kappa_field: float = 0.0,
    alpha: float = 1.0,
    fibre: tuple[float, float, float] = (1.0, 0.0, 0.0),
) -> FloatArray:
    """(12,) one row of the engine's materials: c, kappas in kPa; the law's three constants. ``kappa_field`` 0 is the
    incompressible material, its pressure field a Lagrange multiplier."""
    return np.array([law, c, alpha, *constants, kappa_points, kappa_field, *fibre, 0.0])


@dataclass(frozen=True)
class Setup:
    """An equilibrium: ``held`` (nodes, coordinates 0 to 2), pressure in kPa on the faces with ``loaded`` tags,
    ``springs`` in kPa/mm along the normal on the faces with ``sprung`` tags, ``start`` and ``at`` (n, 3) mm where the iteration
    begins and where held nodes go; the rest steers the iteration."""

    bundle: Bundle
    material: FloatArray
    held: tuple[IntArray, IntArray]
    pressure: float = 0.0
    loaded: tuple[int, ...] = ()
    springs: float = 0.0
    sprung: tuple[int, ...] = ()
    start: FloatArray | None = None
    at: FloatArray | None = None
    points: int = 14
    task: int = Task.SYMMETRIC
    tolerance: float = 1e-6
    first_step: float = 1.0
    first_viscosity: float = 0.0
    move_limit: float = 2.0
    viscosity: float = 0.3
    unload: bool = False
    prestrain: bool = False
    volume_tolerance: float = 1e-3
    max_sweeps: int = 60


@dataclass(frozen=True)
class Solution:
    """States by name: x and X (n, 3) mm; the loaded state's cavity volume, and at rest (mm3), smallest J; words of the
    history; counts and CPU seconds of the solver's process."""

    states: dict[str, tuple[FloatArray, FloatArray]]
    volume_at_rest: float
    volume: float
    min_jacobian: float
    unknowns: int
    newton: int
    steps: int
    cpu_s: float
    other: dict[str, dict[str, float]] = field(default_factory=dict)


def solve(setup: Setup) -> Solution:
    """Run an equilibrium problem. Raises SimulationError when it does not converge, SolverMissingError."""
    with tempfile.TemporaryDirectory(prefix="lacli-verify-") as name:
        folder = Path(name)
        _write_mesh(setup.bundle, setup.material, folder)
        write_arrays(folder / "held.txt", *setup.held)
        if setup.loaded:
            write_faces(folder / "pressure.txt", setup.bundle.triangles[np.isin(setup.bundle.tags, setup.loaded)])
        if setup.springs:
            write_faces(folder / "springs.txt", setup.bundle.triangles[np.isin(setup.bundle.tags, setup.sprung)])
        for array, file in ((setup.start, "start.txt"), (setup.at, "at.txt")):
            if array is not None:
                write_arrays(folder / file, array.T)
        choices = {key: value for key, value in vars(setup).items() if isinstance(value, (bool, int, float))}
        choices |= {
            "order": setup.bundle.order,
            "faces": bool(setup.loaded),
            "start": setup.start is not None,
            "at": setup.at is not None,
        }
        outcome = _run("verification.edp.j2", folder, **choices)
        history = read_history(folder / "history.txt")
        if "end" not in history:
            raise SimulationError("bad_output", "The verification problem's history is incomplete.")
        names: tuple[str, ...] = ("loaded",)
        if setup.unload or setup.prestrain:
            names += ("unloaded", "reloaded") + (("inverse",) if setup.unload else ())
        states = {name: read_state(folder / f"{name}.txt", len(setup.bundle.points)) for name in names}
    said = history.pop("state")
    unknowns, newton, steps = (int(said[name]) for name in ("unknowns", "newton", "steps"))
    return Solution(states, said["rest_mm3"], said["volume_mm3"], said["min_j"], unknowns, newton, steps, outcome.cpu_s, history)


@dataclass(frozen=True)
class Form:
    """A question to the engine: positions x (the field v of the prestrain's tasks), reference X (n, 3), vertex pressures p;
    direction v (n, 3), dp; loads: pressure (kPa), stiffness of vein springs and of the pericardium (kPa/mm)."""

    task: int
    x: FloatArray
    reference: FloatArray
    p: FloatArray
    v: FloatArray | None = None
    dp: FloatArray | None = None
    loads: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Answer:
    """Energy (kPa mm3), cavity volume (mm3), residual: forces (n, 3), volume equations (nv,), tangent times direction."""

    energy: float
    volume: float
    force: FloatArray
    gap: FloatArray
    tangent_force: FloatArray
    tangent_gap: FloatArray


def vertices(bundle: Bundle) -> IntArray:
    """Nodes (nv,) that carry pressures, ascending: the order of ``p`` in forms."""
    return np.unique(bundle.tets[:, :4])


# kind, which triangles (k,), their vertices' weights (kept, 3) or None for ones
FaceSet = tuple[int, NDArray[np.bool_], FloatArray | None]


@dataclass(frozen=True)
class Slopes:
    """A question for the residual's derivatives along the engine's inputs: derivatives along the pericardium's threshold of its
    vertices' weights (kept, 3); of the pressure (kPa) along EDP and ESP; of the prestrain's field along each input (inputs, n,
    3), or None."""

    weights: FloatArray
    shares: tuple[float, float]
    rates: FloatArray | None = None


def ask(
    bundle: Bundle, materials: FloatArray, forms: list[Form], faces: Sequence[FaceSet], points: int = 14
) -> tuple[list[Answer], float]:
    """Answers to ``forms`` in one run, and its CPU seconds."""
    answers, _, cpu_s = _ask(bundle, materials, forms, faces, points, None)
    return answers, cpu_s


def ask_slopes(
    bundle: Bundle, materials: FloatArray, forms: list[Form], faces: Sequence[FaceSet], slopes: Slopes, points: int = 14
) -> tuple[FloatArray, float]:
    """(inputs, 3 n + nv) derivatives of the residual (x | y | z of all nodes | volume equations) at the last of ``forms``, and
    the run's CPU seconds."""
    _, table, cpu_s = _ask(bundle, materials, forms, faces, points, slopes)
    return table, cpu_s


def _ask(
    bundle: Bundle, materials: FloatArray, forms: list[Form], faces: Sequence[FaceSet], points: int, slopes: Slopes | None
) -> tuple[list[Answer], FloatArray, float]:
    n, nv = len(bundle.points), len(vertices(bundle))
    with tempfile.TemporaryDirectory(prefix="lacli-verify-") as name:
        folder = Path(name)
        _write_mesh(bundle, materials, folder)
        files = []
        for i, (kind, keep, weight) in enumerate(faces):
            files.append((kind, f"faces{i}.txt"))
            write_faces(folder / f"faces{i}.txt", bundle.triangles[keep], weight)
        settings = [[float(f.task), *f.loads] for f in forms]
        zero, none = np.zeros((n, 3)), np.zeros(nv)
        states = [np.concatenate([f.x.T.ravel(), f.p]) for f in forms]
        directions = [np.concatenate([(zero if f.v is None else f.v).T.ravel(), none if f.dp is None else f.dp]) for f in forms]
        write_arrays(
            folder / "forms.txt",
            np.array(settings),
            np.array(states),
            np.array([f.reference.T for f in forms]),
            np.array(directions),
        )
        if slopes is not None:
            write_arrays(folder / "pericardium_slope.txt", slopes.weights)
            rates = np.zeros(0) if slopes.rates is None else [np.concatenate([v.T.ravel(), none]) for v in slopes.rates]
            write_arrays(folder / "slopes.txt", np.array(slopes.shares), np.array(rates))
        choices = {"order": bundle.order, "points": points, "faces": files, "slopes": slopes is not None}
        outcome = _run("verification_forms.edp.j2", folder, **choices)
        said = read_rows(folder / "forms_out.txt")
        derivatives = read_rows(folder / "slopes_out.txt")["slope"] if slopes is not None else np.zeros((0, 3 * n + nv))
    energy, volume = said["energy_kpa_mm3"][:, 0], said["volume_mm3"][:, 0]
    force, gap = _parts(said["residual"], n)
    tangent_force, tangent_gap = _parts(said["tangent"], n)
    answers = [
        Answer(float(energy[k]), float(volume[k]), force[k], gap[k], tangent_force[k], tangent_gap[k]) for k in range(len(forms))
    ]
    return answers, derivatives, outcome.cpu_s


def _parts(rows: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Rows (k, 3 n + nv) of (x | y | z of all nodes | volume equations) as (k, n, 3) and (k, nv)."""
    return rows[:, : 3 * n].reshape(-1, 3, n).transpose(0, 2, 1), rows[:, 3 * n :]


def respond(materials: FloatArray, F: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
    """Energy (k,), first Piola stress (k, 3, 3), dP/dF (k, 3, 3, 3, 3), dP/df (k, 3, 3, 3), kPa, and CPU seconds, of
    (k, 11) materials (with the fibre) at deformation gradients F (k, 3, 3) and pressures p (k,), tension positive."""
    with tempfile.TemporaryDirectory(prefix="lacli-verify-") as name:
        folder = Path(name)
        write_arrays(folder / "law.txt", materials, np.column_stack([F.reshape(-1, 9), p]))
        outcome = _run("verification_law.edp.j2", folder, material=Cell.STABILISATION.value)
        said = read_rows(folder / "response.txt")
    return (
        said["energy_kpa"][:, 0],
        said["stress_kpa"].reshape(-1, 3, 3),
        said["stress_by_gradient"].reshape(-1, 3, 3, 3, 3),
        said["stress_by_fibre"].reshape(-1, 3, 3, 3),
        outcome.cpu_s,
    )


def _write_mesh(bundle: Bundle, materials: FloatArray, folder: Path) -> None:
    write_medit(folder / "wall.mesh", bundle.points, bundle.tets, bundle.region, bundle.triangles, bundle.tags)
    write_arrays(folder / "cells.txt", bundle.tets[:, CELL_ORDER] if bundle.order == 2 else bundle.tets)
    write_arrays(folder / "points.txt", bundle.points.T)
    write_arrays(folder / "materials.txt", np.broadcast_to(materials, (len(bundle.tets), CELL_COLUMNS)))


def _run(template: str, folder: Path, **choices: Any) -> freefem.Outcome:
    text = render_template(template, plugin(), **choices)
    script = folder / "deck.edp"
    script.write_text(text, encoding="utf-8")
    solvers = resources.folder("solvers") / "freefem"
    outcome = freefem.run(find(), script, folder, TIMEOUT_S, includes=(solvers,))
    if outcome.kind is not None:
        raise SimulationError(outcome.kind, f"A verification problem did not end ({outcome.kind}): {outcome.message}")
    return outcome
