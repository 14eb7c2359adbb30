"""The files that a deck reads: parameter mesh, cells, materials, loaded faces, annulus. Lengths mm, stresses kPa."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.case import Case
from lacli.contracts.labels import BODY_REGIONS, ENDO, EPI, REGIONS, RINGS, is_body, is_plane
from lacli.contracts.laws import LAWS, MOST_CONSTANTS, NUMBER, RINGS_LAW
from lacli.contracts.motion import Motion
from lacli.contracts.sections import Materials, Pericardium
from lacli.freefem.files import CELL_ORDER, write_arrays, write_faces, write_medit
from lacli.geometry.curvature import curvature_sum
from lacli.geometry.quadrature import at_quadrature


class Cell(IntEnum):
    """Columns of the engine's table of cells (``CellColumn`` in lacli.cpp), by their first."""

    LAW = 0
    C = 1
    ALPHA = 2
    CONSTANTS = 3
    KAPPA_POINTS = CONSTANTS + MOST_CONSTANTS
    KAPPA_FIELD = KAPPA_POINTS + 1
    FIBRE = KAPPA_FIELD + 1
    STABILISATION = FIBRE + 3


CELL_COLUMNS = Cell.STABILISATION + 1

# Dents: curvatures are of the outer surface within DENT_MM, or DENT_CELLS edges of its triangles where these are long. A ball as
# large as an atrium (25 mm) has .08 / mm.
DENT_MM, DENT_CELLS, CONVEX = 6.0, 1.5, 0.01


def pericardium_weight(xi: FloatArray, settings: Pericardium) -> FloatArray:
    """w = smoothstep((xi - (pth - ramp)) / ramp): 0 around the mitral valve, 1 on the roof."""
    s = np.clip((xi - (settings.pth - settings.ramp)) / settings.ramp, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def pericardium_weight_slope(xi: FloatArray, settings: Pericardium) -> FloatArray:
    """Derivative of ``pericardium_weight`` by ``pth``, 1/unit of xi."""
    s = np.clip((xi - (settings.pth - settings.ramp)) / settings.ramp, 0.0, 1.0)
    return -6.0 * s * (1.0 - s) / settings.ramp


def dent_weight(bundle: Bundle) -> FloatArray:
    """Weight (t, q) at the triangles' quadrature points of springs that hold dents of the outer surface: 1 where the sum of the
    principal curvatures is 0 or less, 0 from CONVEX on.

    No tension along a wall carries a pressure from inside where that sum is not positive; what pressed the wall in does.
    """
    outer = bundle.triangles[bundle.tags == EPI]
    edge = np.linalg.norm(bundle.points[outer[:, 0]] - bundle.points[outer[:, 1]], axis=1)
    total = curvature_sum(bundle.points, outer, max(DENT_MM, DENT_CELLS * float(np.median(edge))))
    s = np.clip(1.0 - np.nan_to_num(total, nan=CONVEX) / CONVEX, 0.0, 1.0)
    return at_quadrature(bundle.triangles[:, :3], s * s * (3.0 - 2.0 * s))


def support(bundle: Bundle, settings: Pericardium) -> tuple[FloatArray, FloatArray]:
    """Weight of the springs at the triangles' quadrature points and its derivative by ``pth``, (t, q) both."""
    assert bundle.pericardium_coordinate is not None
    # the weight turns within a cell: taken at the quadrature points, not between values at the corners
    xi = at_quadrature(bundle.triangles[:, :3], bundle.pericardium_coordinate)
    weight, slope = pericardium_weight(xi, settings), pericardium_weight_slope(xi, settings)
    if settings.dents:
        dents = dent_weight(bundle)
        weight, slope = np.maximum(weight, dents), np.where(dents > weight, 0.0, slope)
    return weight, slope


def write_inputs(case: Case, folder: Path) -> None:
    """Write all files that the case's deck reads into ``folder``."""
    bundle, scene, plan, motion = case.bundle, case.scene, case.plan, case.motion
    quadratic = bundle.order == 2
    write_medit(folder / "wall.mesh", bundle.points, bundle.tets, bundle.region, bundle.triangles, bundle.tags)
    write_arrays(folder / "cells.txt", bundle.tets[:, CELL_ORDER] if quadratic else bundle.tets)
    write_arrays(folder / "points.txt", bundle.points.T)
    write_arrays(folder / "materials.txt", material_table(bundle, scene.materials, scene.numerics.kappa_points_kpa))
    write_faces(folder / "pressure.txt", bundle.triangles[(bundle.tags == ENDO) | is_plane(bundle.tags)])
    if plan.vein_springs:
        write_faces(folder / "veins.txt", bundle.triangles[np.isin(bundle.tags, [RINGS["rspv"], RINGS["ripv"]])])
    if plan.pericardium:
        weight, slope = support(bundle, scene.pericardium)
        touched = (bundle.tags == EPI) & (weight > 0).any(axis=1)
        write_faces(folder / "pericardium.txt", bundle.triangles[touched], weight[touched])
        if plan.sensitivities:
            write_arrays(folder / "pericardium_slope.txt", slope[touched])
    if plan.moving:
        assert motion is not None
        spline = annulus_spline(motion)
        # (power, interval, node, coordinate) -> interval, power, coordinate, node
        coefficients = np.moveaxis(spline.c, (0, 1, 2, 3), (1, 0, 3, 2))
        write_arrays(folder / "annulus.txt", motion.wall_point, spline.x, coefficients)
    else:
        write_arrays(folder / "held.txt", np.unique(bundle.triangles[bundle.tags == RINGS["mv"]]))


def annulus_spline(motion: Motion) -> CubicSpline:
    """Cubic spline over one cycle through the frames, periodic: time -> (n, 3) mm."""
    times = np.append(motion.times, 1.0)
    positions = np.concatenate([motion.positions, motion.positions[:1]])
    return CubicSpline(times, positions, axis=0, bc_type="periodic")


def material_table(bundle: Bundle, materials: Materials, kappa_points_kpa: float) -> FloatArray:
    """(m, 12) columns of ``Cells``: number of the law, C, alpha, its constants, kappa at the points and on the pressure field,
    fibre, stabilisation (1/kPa)."""
    law, constants = LAWS[materials.law], np.array(materials.constants())
    rings = LAWS[RINGS_LAW]
    table = np.zeros((len(bundle.tets), CELL_COLUMNS))
    body = is_body(bundle.region)
    stiff = (bundle.region == RINGS["mv"]) | is_plane(bundle.region)
    table[:, Cell.LAW] = np.where(body, NUMBER[law.name], NUMBER[rings.name])
    table[:, Cell.C] = np.where(stiff, materials.plane_c_kpa, materials.ring_c_kpa)
    table[:, Cell.ALPHA] = 1.0
    for name in BODY_REGIONS:
        here = bundle.region == REGIONS[name]
        table[here, Cell.C] = getattr(materials.c_kpa, name)
        table[here, Cell.ALPHA] = getattr(materials.alpha, name)
    table[:, Cell.CONSTANTS : Cell.KAPPA_POINTS] = constants
    table[:, Cell.KAPPA_POINTS] = kappa_points_kpa
    table[:, Cell.KAPPA_FIELD] = materials.kappa_kpa - kappa_points_kpa
    if bundle.fibre is not None:
        table[:, Cell.FIBRE : Cell.STABILISATION] = bundle.fibre
    elif body.any() and law.directed(constants):
        raise AnatomyError("The bundle has no fibres (cell array 'fibre' of wall.vtu); the anisotropic law needs them.")
    if bundle.order == 1:
        # 1 / (2 mu) of the law at rest steadies equal-order pressures
        c, alpha = table[:, Cell.C], table[:, Cell.ALPHA]
        table[:, Cell.STABILISATION] = 1.0 / np.where(body, law.modulus(c, alpha, constants), rings.modulus(c, alpha, constants))
    return table
