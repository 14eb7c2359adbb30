"""Does wall thickness matter? A hemispherical shell, its edge held, under pressure alone and on springs as a pericardium has.

Shells of several thicknesses, uniform and with a patch around the apex that is thinner; Guccione's law with the wall's default
numbers, without a preferred direction (its three constants alike). What thickness does to displacement is told as the exponent
of a power law, d ~ t^slope, over the uniform shells: a membrane of a linear material has -1, a wall that springs hold 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import UsageError
from lacli.contracts.bundle import Bundle
from lacli.contracts.sections import Materials
from lacli.geometry.triangles import area_normals
from lacli.verification import meshes
from lacli.verification.equilibria import clamp, damping
from lacli.verification.runs import GUCCIONE, Setup, material, solve

RADIUS_MM = 20.0
PRESSURE_KPA = 1.0  # 7.5 mmHg, in the middle of what a filling atrium adds
SPRINGS_KPA_PER_MM = 1.0
THICKNESSES_MM = (1.0, 2.0, 3.0, 4.0)
PATCH_SHARE = 0.5  # of the shell's thickness, in the patch
PATCH = np.deg2rad(35.0)  # its half angle; a quarter of it is the way from thin to thick
_FARTHEST_MM = 15.0
_THIN, _THICK = 0.3, 8.0


@dataclass(frozen=True)
class Shell:
    """A shell: thickness (mm; that of the patch where there is one), springs (kPa/mm; 0: none), mean displacement of the inner
    surface (mm), and of its part in the patch's place, patch or not; cpu_s of its solution."""

    thickness_mm: float
    patch_mm: float
    springs_kpa_per_mm: float
    displacement_mm: float
    patch_displacement_mm: float
    cpu_s: float


@dataclass(frozen=True)
class ThicknessStudy:
    """All shells, and the exponents d ~ t^slope of uniform ones: under pressure alone, and on springs."""

    shells: tuple[Shell, ...]
    slope: float
    slope_on_springs: float


def study(
    thicknesses: Sequence[float] = THICKNESSES_MM, size_mm: float = 6.0, tick: Callable[[], None] = lambda: None
) -> ThicknessStudy:
    """Solve all. tick: called after each of the 4 shells of a thickness.

    Raises UsageError, SimulationError, SolverMissingError.
    """
    if len(set(thicknesses)) < 2 or not all(_THIN <= t <= _THICK for t in thicknesses):
        raise UsageError(f"at least two thicknesses, {_THIN:g} to {_THICK:g} mm; given: {', '.join(map(str, thicknesses))}.")
    shells = []
    for springs in (0.0, SPRINGS_KPA_PER_MM):
        for t in sorted(set(thicknesses)):
            for share in (1.0, PATCH_SHARE):
                shells.append(_solved(t, share, springs, size_mm))
                tick()
    return ThicknessStudy(tuple(shells), exponent(shells, 0.0), exponent(shells, SPRINGS_KPA_PER_MM))


def exponent(shells: Sequence[Shell], springs: float) -> float:
    """Least squares of ln d on ln t over the uniform shells on these springs."""
    chosen = [s for s in shells if s.springs_kpa_per_mm == springs and s.patch_mm == s.thickness_mm]
    t, d = (np.log([getattr(s, name) for s in chosen]) for name in ("thickness_mm", "displacement_mm"))
    return float(np.polyfit(t, d, 1)[0])


def shell(thickness: float, share: float, size_mm: float) -> Bundle:
    """A hemisphere of inner radius ``RADIUS_MM`` below z = 0, its patch around the apex ``share`` as thick."""
    radii = (RADIUS_MM, RADIUS_MM), (RADIUS_MM + thickness, RADIUS_MM + thickness)
    bundle = meshes.ellipsoid(size_mm, 1, *radii, cut=0.0)
    radius = np.linalg.norm(bundle.points, axis=1)
    # smooth from the patch's thickness to the shell's; the inner surface stays
    s = np.clip((_polar(bundle.points) - 0.75 * PATCH) / (0.25 * PATCH), 0.0, 1.0)
    factor = share + (1.0 - share) * s * s * (3.0 - 2.0 * s)
    moved = RADIUS_MM + (radius - RADIUS_MM) * factor
    return replace(bundle, points=bundle.points * (moved / radius)[:, None])


def _polar(points: FloatArray) -> FloatArray:
    """Angle from the apex, at negative z."""
    return np.arccos(np.clip(-points[:, 2] / np.linalg.norm(points, axis=1), -1.0, 1.0))


def _solved(thickness: float, share: float, springs: float, size_mm: float) -> Shell:
    bundle = shell(thickness, share, size_mm)
    wall = Materials()
    constants = wall.constants()
    tissue = material(GUCCIONE, wall.c_kpa.roof, [float(np.mean(constants))] * 3, 100.0, wall.kappa_kpa - 100.0, wall.alpha.roof)
    steering = damping(PRESSURE_KPA, thickness * share, _FARTHEST_MM / 5)
    setup = Setup(
        bundle, tissue, clamp(bundle, meshes.CUT), PRESSURE_KPA, (meshes.INNER,), points=4, springs=springs,
        sprung=(meshes.OUTER,), **steering,  # type: ignore[arg-type]
    )  # fmt: skip
    solution = solve(setup)
    moved = np.linalg.norm(solution.states["loaded"][0] - bundle.points, axis=1)
    inner = bundle.triangles[bundle.tags == meshes.INNER][:, :3]
    corner = bundle.points[inner]
    area = np.linalg.norm(area_normals(corner), axis=1)
    mean = moved[inner].mean(axis=1)
    inside = _polar(corner.mean(axis=1)) < 0.75 * PATCH
    whole, part = float(np.average(mean, weights=area)), float(np.average(mean[inside], weights=area[inside]))
    return Shell(thickness, thickness * share, springs, whole, part, solution.cpu_s)
