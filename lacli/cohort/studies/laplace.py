"""The law of Laplace beside a run's wall stress at end-systole, by region.

A closed membrane of mean curvature H under a pressure p carries sigma = p / (2 t H) along itself, t its thickness. Of the run,
the stress is the material's at the deformation from the unloaded wall. Its volumetric part is a multiplier that displacements do
not tell; so what is compared is the stress along the wall less that across it, which is free of that part: (tr - 3 n.n) / 2 of
Cauchy's, n the direction across. H is the endocardium's: a sphere of inner radius a and outer b, cut in two, holds pi a^2 p by
pi (b^2 - a^2) of wall, along which the mean is p a^2 / (b^2 - a^2) = p a / (2 t) - p / 4 to first order in t / a. Across, a wall
between p and nothing carries -p / 2 in the mean, so that the law's difference is p / (2 t H) + p / 4. Springs and neighbours that
bear on the wall are not in the law; nor is bending, nor unequal curvatures. Where the wall is flat or bulges inwards there is no
such membrane: those regions are shown, and are in neither correlation nor slope.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lacli.anatomy.coordinates.describe import cell_label
from lacli.anatomy.wall.thickness import of_bundle
from lacli.base import vtkxml
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import InputError
from lacli.contracts.bundle import Bundle, as_order, load
from lacli.contracts.labels import BODY_REGIONS, ENDO, REGIONS
from lacli.contracts.scene import Scene
from lacli.geometry import curves
from lacli.geometry.tetrahedra import volumes
from lacli.geometry.triangles import area_normals
from lacli.mechanics.features import cell_gradient
from lacli.mechanics.inputs import Cell, material_table
from lacli.mechanics.pressure import pressure_of
from lacli.mechanics.simulation import finished
from lacli.motion.annulus import asked_motion
from lacli.verification.runs import respond

_FAILS = 1.5  # a ratio beyond it, or below its inverse: there the law fails
_FLAT = 0.2  # of the convex regions' median curvature: with less a region's radius is no atrium's
_PLANE = 1e-9  # 1/mm: a curvature of nought has no radius
_LEAST = 3  # regions that are compared


@dataclass(frozen=True)
class Region:
    """A region at end-systole: stress along the wall less across (kPa) of the run and by the law, thickness and radius (mm)."""

    region: str
    stress_kpa: float
    laplace_kpa: float
    thickness_mm: float
    radius_mm: float

    @property
    def ratio(self) -> float:
        """The run's stress over the law's."""
        return self.stress_kpa / self.laplace_kpa

    @property
    def fails(self) -> bool:
        """Whether the law is off by more than half."""
        return not 1 / _FAILS <= self.ratio <= _FAILS


@dataclass(frozen=True)
class LaplaceStudy:
    """Regions; correlation and slope (through nought) of the run's stress with the law's over those that bulge outwards (NaN of
    fewer than 3); pressure, kPa; left_out: the regions that are flat or concave."""

    regions: tuple[Region, ...]
    correlation: float
    slope: float
    pressure_kpa: float
    left_out: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """What correlation and slope leave out, in words."""
        said = [f"{', '.join(self.left_out)}: flat or concave; in neither correlation nor slope."] if self.left_out else []
        if (count := len(self.regions) - len(self.left_out)) < _LEAST:
            said.append(f"{count} regions bulge outwards; correlation and slope are of at least {_LEAST}.")
        return tuple(said)


def of_run(run: Path) -> LaplaceStudy:
    """The comparison for the folder of a run that kept its fields and found its unloaded state.

    Raises InputError, UsageError and StorageError where scene, bundle or products have changed since, AnatomyError,
    SolverMissingError, SimulationError.
    """
    file = run / "fields" / "es.vtu"
    if not file.is_file():
        raise InputError(f'{file}: no such file; simulate with outputs.fields = "es".')
    scene, _ = finished(run)
    whole = load(Path(scene.anatomy.bundle))
    bundle = as_order(whole, scene.numerics.order)  # the run's points are those of its cells
    fields = vtkxml.read(file)
    if "displacement_from_unloaded" not in fields.point_data:
        raise InputError(f"{run}: its unloaded state is not known; simulate with outputs.unloaded = true.")
    x = np.asarray(fields.points, float)
    free = x - np.asarray(fields.point_data["displacement_from_unloaded"], float)
    materials = material_table(bundle, scene.materials, scene.numerics.kappa_points_kpa)
    pressure = pressure_at_es(scene, whole)
    deformed = replace(bundle, points=x)
    stress = along_less_across(bundle, materials, free, x)
    thickness = {name: lap for name, (_, lap) in of_bundle(deformed).per_region.items()}
    return compared(stress, by_law(deformed, thickness, pressure), pressure)


def pressure_at_es(scene: Scene, bundle: Bundle) -> float:
    """The pressure that the run had at its end-systole, kPa: of a scene's own transient what that is there."""
    motion = asked_motion(scene.motion, bundle, Path(scene.anatomy.bundle))
    return pressure_of(scene.loads, scene.motion.es_time, motion).at_es_kpa


def along_less_across(bundle: Bundle, materials: FloatArray, free: FloatArray, x: FloatArray) -> dict[str, float]:
    """Mean over each region of the stress along the wall less that across, kPa, for positions (n, 3) without load and with."""
    if bundle.transmural is None:
        raise InputError("the bundle has no transmural coordinate: what is across the wall is not known.")
    body = np.isin(bundle.region, [REGIONS[name] for name in BODY_REGIONS])
    gradient = cell_gradient(bundle, free, x)[body]
    table = materials[body][:, : Cell.STABILISATION]
    _, piola, _, _, _ = respond(table, gradient, np.zeros(len(gradient)))
    cauchy = piola @ np.swapaxes(gradient, 1, 2) / np.linalg.det(gradient)[:, None, None]
    corners = bundle.tets[body, :4]
    rise = bundle.transmural[corners[:, 1:]] - bundle.transmural[corners[:, :1]]
    across = np.linalg.solve(x[corners[:, 1:]] - x[corners[:, :1]], rise[..., None])[..., 0]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    through = np.einsum("mi,mij,mj->m", across, cauchy, across)
    value = 0.5 * (np.trace(cauchy, axis1=1, axis2=2) - 3 * through)
    weight = np.abs(volumes(x, corners))
    region = bundle.region[body]
    return {
        name: float(np.average(value[region == REGIONS[name]], weights=weight[region == REGIONS[name]]))
        for name in BODY_REGIONS
        if (region == REGIONS[name]).any()
    }


def by_law(deformed: Bundle, thickness: Mapping[str, float], pressure: float) -> dict[str, tuple[float, float, float]]:
    """By region: the law's stress less that across (kPa), thickness and radius of mean curvature (mm)."""
    inner = deformed.triangles[deformed.tags == ENDO][:, :3]
    owner = cell_label(deformed, inner)
    found = {}
    for name, t in thickness.items():
        if name not in BODY_REGIONS or not (owner == REGIONS[name]).any():
            continue
        # normals point out of the wall, into the cavity
        curvature = mean_curvature(deformed.points, inner[:, ::-1], owner == REGIONS[name]) or _PLANE
        found[name] = (pressure / (2 * t) / curvature + pressure / 4, t, 1 / curvature)
    return found


def mean_curvature(points: FloatArray, triangles: IntArray, inside: np.ndarray) -> float:
    """Mean of (k1 + k2) / 2 over the triangles ``inside``, 1/mm, positive where the surface bulges towards its normals.

    Of a surface of flat triangles the integral of the mean curvature stands in the edges: half of the angle between the
    normals times the length (Steiner's formula); an edge between inside and outside counts half.
    """
    normals = area_normals(points[triangles])
    area = 0.5 * np.linalg.norm(normals, axis=1)
    unit = normals / (2 * area)[:, None]
    sides, _ = curves.side_pairs(curves.edge_table(triangles)[2])
    one, other = sides.T // 3
    # along the first triangle's side
    start, end = (triangles[one, (sides[:, 0] + step) % 3] for step in (0, 1))
    edge = points[end] - points[start]
    length = np.linalg.norm(edge, axis=1)
    turn = np.einsum("ki,ki->k", np.cross(unit[one], unit[other]), edge) / length
    angle = np.arctan2(turn, np.einsum("ki,ki->k", unit[one], unit[other]))
    total = 0.25 * float((angle * length * (inside[one].astype(float) + inside[other])).sum())
    return total / float(area[inside].sum())


def compared(stress: Mapping[str, float], law: Mapping[str, tuple[float, float, float]], pressure: float) -> LaplaceStudy:
    """Both by region, and how they go together."""
    rows = tuple(Region(name, stress[name], *law[name]) for name in stress if name in law)
    if len(rows) < _LEAST:
        raise InputError(f"{len(rows)} regions have both stresses; at least {_LEAST} are compared.")
    curvature = np.array([1 / row.radius_mm for row in rows])
    convex = curvature > 0
    bulges = convex & (curvature > _FLAT * float(np.median(curvature[convex]) if convex.any() else 0.0))
    left_out = tuple(row.region for row, good in zip(rows, bulges, strict=True) if not good)
    correlation = slope = math.nan
    if bulges.sum() >= _LEAST:
        a, b = (np.array([getattr(row, key) for row in rows])[bulges] for key in ("laplace_kpa", "stress_kpa"))
        correlation, slope = float(np.corrcoef(a, b)[0, 1]), float(a @ b / (a @ a))
    return LaplaceStudy(rows, correlation, slope, pressure, left_out)
