"""The files that a deck reads: parameter mesh, cells, materials, loaded faces, annulus. Lengths mm, stresses kPa."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.case import Case
from lacli.contracts.labels import BODY_REGIONS, ENDO, EPI, REGIONS, RINGS, is_body, is_plane
from lacli.contracts.motion import Motion
from lacli.contracts.scene import Materials, Pericardium
from lacli.freefem.files import CELL_ORDER, write_arrays, write_faces, write_medit
from lacli.geometry.quadrature import at_quadrature


def pericardium_weight(xi: FloatArray, settings: Pericardium) -> FloatArray:
    """w = smoothstep((xi - (pth - ramp)) / ramp): 0 around the mitral valve, 1 on the roof."""
    s = np.clip((xi - (settings.pth - settings.ramp)) / settings.ramp, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def pericardium_weight_slope(xi: FloatArray, settings: Pericardium) -> FloatArray:
    """Derivative of ``pericardium_weight`` by ``pth``, 1/unit of xi."""
    s = np.clip((xi - (settings.pth - settings.ramp)) / settings.ramp, 0.0, 1.0)
    return -6.0 * s * (1.0 - s) / settings.ramp


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
        assert bundle.pericardium_coordinate is not None
        # the weight turns within a cell: taken at the quadrature points, not between values at the corners
        xi = at_quadrature(bundle.triangles[:, :3], bundle.pericardium_coordinate)
        weight = pericardium_weight(xi, scene.pericardium)
        touched = (bundle.tags == EPI) & (weight > 0).any(axis=1)
        write_faces(folder / "pericardium.txt", bundle.triangles[touched], weight[touched])
        if plan.sensitivities:
            slope = pericardium_weight_slope(xi, scene.pericardium)
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
    """(m, 12): law, C, alpha, bf, bft, bt, kappa at the points and on the pressure field, fibre, stabilisation (1/kPa)."""
    table = np.zeros((len(bundle.tets), 12))
    body = is_body(bundle.region)
    stiff = (bundle.region == RINGS["mv"]) | is_plane(bundle.region)
    guccione = body & (materials.law == "guccione")
    table[:, 0] = ~guccione
    table[:, 1] = np.where(stiff, materials.plane_c_kpa, materials.ring_c_kpa)
    table[:, 2] = 1.0
    for name in BODY_REGIONS:
        here = bundle.region == REGIONS[name]
        table[here, 1] = getattr(materials.c_kpa, name)
        table[here, 2] = getattr(materials.alpha, name)
    table[:, 3:6] = materials.bf, materials.bft, materials.bt
    table[:, 6] = kappa_points_kpa
    table[:, 7] = materials.kappa_kpa - kappa_points_kpa
    if bundle.fibre is not None:
        table[:, 8:11] = bundle.fibre
    elif guccione.any() and not materials.bf == materials.bft == materials.bt:
        raise AnatomyError("The bundle has no fibres (cell array 'fibre' of wall.vtu); the anisotropic law needs them.")
    if bundle.order == 1:
        # 1 / (2 mu) of the law at rest steadies equal-order pressures
        mean_b = (materials.bf + materials.bft + materials.bt) / 3.0
        table[:, 11] = np.where(guccione, 1.0 / (table[:, 1] * table[:, 2] * mean_b), 1.0 / (4.0 * table[:, 1]))
    return table
