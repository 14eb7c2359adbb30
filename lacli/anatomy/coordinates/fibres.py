"""Fibre directions by rule: the Laplace-Dirichlet rule of the left atrium, and bundles drawn in universal coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lacli.base.arrays import FloatArray, IntArray
from lacli.geometry import laplace
from lacli.geometry.laplace import Gradient

BODY, MITRAL, LEFT_VEINS, RIGHT_VEINS = 0, 1, 2, 3
FIELDS = ("r", "v", "ab")


@dataclass(frozen=True)
class Thresholds:
    """Where bundles begin (Piersanti et al. 2021, CMAME 373:113468): of r at the valve, of v at the left and right veins."""

    mitral: float = 0.65
    left_veins: float = 0.1
    right_veins: float = 0.65


@dataclass(frozen=True)
class RuleFibres:
    """Per cell: bundle (m,) of BODY .. RIGHT_VEINS, unit axes (m, 3) along the fibre, in-plane normal, and across the wall."""

    bundle: IntArray
    fibre: FloatArray
    normal: FloatArray
    across: FloatArray


def boundary_sets(openings: Mapping[str, IntArray]) -> dict[str, dict[float, IntArray]]:
    """Dirichlet values of the three fields from the rims' point ids by name (mv, rspv, ripv, lspv, lipv, appendage if any).

    r: 1 mitral ring, 0 veins and appendage; v: 0 left, 1 right veins; ab: -1 appendage, 0 left veins, 1 mitral, 2 right veins.
    A heart without an appendage opening has no set for ab = -1, and the left veins bound it instead.
    """
    left = np.concatenate([openings["lspv"], openings["lipv"]])
    right = np.concatenate([openings["rspv"], openings["ripv"]])
    appendage = openings.get("appendage", np.zeros(0, dtype=np.int64))
    far = np.concatenate([left, right, appendage])
    ab: dict[float, IntArray] = {0.0: left, 1.0: openings["mv"], 2.0: right}
    if len(appendage):
        ab[-1.0] = appendage
    return {"r": {1.0: openings["mv"], 0.0: far}, "v": {0.0: left, 1.0: right}, "ab": ab}


def solve_fields(points: FloatArray, tets: IntArray, sets: Mapping[str, Mapping[float, IntArray]]) -> dict[str, FloatArray]:
    """Harmonic fields (n,) on linear tetrahedra for the given Dirichlet sets."""
    matrix = laplace.stiffness(laplace.gradient(points, tets), len(points))
    return {name: laplace.solve(matrix, values) for name, values in sets.items()}


def bundles(fields: Mapping[str, FloatArray], tets: IntArray, tau: Thresholds) -> IntArray:
    """(m,) bundle of each cell, by the mean of its corners' values."""
    r, v = (fields[name][tets].mean(axis=1) for name in ("r", "v"))
    mitral = r >= tau.mitral
    bundle = np.full(len(tets), BODY, dtype=np.int64)
    bundle[~mitral & (v < tau.left_veins)] = LEFT_VEINS
    bundle[~mitral & (v > tau.right_veins)] = RIGHT_VEINS
    bundle[mitral] = MITRAL
    return bundle


def recovered(grad: Gradient, field: FloatArray, size: int) -> FloatArray:
    """(m, 3) gradient averaged to the points (every cell counts alike) and back to the cells: smooth on coarse walls."""
    per_cell = grad.of(field)
    total = np.zeros((size, 3))
    count = np.zeros(size)
    for column in grad.cells.T:
        count += np.bincount(column, minlength=size)
        for d in range(3):
            total[:, d] += np.bincount(column, weights=per_cell[:, d], minlength=size)
    return (total / np.maximum(count, 1.0)[:, None])[grad.cells].mean(axis=1)


def endocardial_normals(points: FloatArray, tets: IntArray, endo: IntArray) -> FloatArray:
    """(m, 3) unit normal of the endocardial triangle (t, 3) nearest to each cell's centre."""
    a, b, c = (points[endo[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    _, nearest = cKDTree((a + b + c) / 3.0).query(points[tets].mean(axis=1))
    return normal[nearest]


def laplace_dirichlet(
    points: FloatArray,
    tets: IntArray,
    fields: Mapping[str, FloatArray],
    across: FloatArray,
    tau: Thresholds | None = None,
    angle_deg: tuple[float, float] = (0.0, 0.0),
    transmural: FloatArray | None = None,
) -> RuleFibres:
    """The Laplace-Dirichlet rule: a bundle's gradient k, made tangent to the wall, is e_n; the fibre e_l = e_n x e_t.

    across (m, 3): unit e_t. ``angle_deg`` turns the fibre about e_t: the first value where ``transmural`` (m,) < 0.5, the
    second above; 0, 0 as published for the left atrium. Cells whose k is along e_t take their nearest good neighbour's direction.
    """
    tau = tau or Thresholds()
    grad = laplace.gradient(points, tets)
    bundle = bundles(fields, tets, tau)
    slope = {name: recovered(grad, fields[name], len(points)) for name in FIELDS}
    k = np.where((bundle == MITRAL)[:, None], slope["r"], np.where((bundle == BODY)[:, None], slope["ab"], slope["v"]))
    tangent = k - np.sum(k * across, axis=1, keepdims=True) * across
    size = np.linalg.norm(tangent, axis=1)
    weak = size <= 1e-6 * np.maximum(np.linalg.norm(k, axis=1), 1e-300)
    weak |= ~np.isfinite(size) | (size == 0)
    normal = tangent / np.where(weak, 1.0, size)[:, None]
    if weak.any() and not weak.all():
        normal = _fill(points[tets].mean(axis=1), normal, weak, across)
    fibre = np.cross(normal, across)
    if transmural is not None and any(angle_deg):
        angle = np.radians(np.where(transmural < 0.5, angle_deg[0], angle_deg[1]))[:, None]
        fibre, normal = fibre * np.cos(angle) + normal * np.sin(angle), normal * np.cos(angle) - fibre * np.sin(angle)
    return RuleFibres(bundle, fibre, normal, across)


def _fill(centre: FloatArray, vector: FloatArray, weak: NDArray[np.bool_], across: FloatArray) -> FloatArray:
    """Directions of weak cells from the nearest good cell, made tangent again."""
    good = np.flatnonzero(~weak)
    _, nearest = cKDTree(centre[good]).query(centre[weak], k=min(8, len(good)))
    candidates = vector[good][np.atleast_2d(nearest)]
    candidates -= np.sum(candidates * across[weak][:, None], axis=2, keepdims=True) * across[weak][:, None]
    size = np.linalg.norm(candidates, axis=2)
    best = np.argmax(size > 0.3, axis=1)
    rows = np.arange(len(best))
    chosen = candidates[rows, best] / np.maximum(size[rows, best], 1e-12)[:, None]
    spare = np.cross(across[weak], np.roll(across[weak], 1, axis=1) + np.array([0.1, 0.2, 0.3]))
    spare /= np.linalg.norm(spare, axis=1, keepdims=True)
    out = vector.copy()
    out[weak] = np.where((size[rows, best] > 1e-6)[:, None], chosen, spare)
    return out


def uac_bundles(
    points: FloatArray,
    triangles: IntArray,
    uac: FloatArray,
    epicardial: bool,
) -> FloatArray:
    """(t, 3) unit fibres on a surface from bundles drawn in its universal coordinates (n, 2); see ``bundle_direction``.

    Triangles that the coordinates jump across take their nearest neighbours' direction.
    """
    grad = laplace.gradient(points, triangles)
    corner = uac[triangles]
    a, b, c = (points[triangles[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    d_alpha, d_beta = (np.einsum("mk,mkd->md", corner[:, :, i], grad.shape) for i in (0, 1))
    wanted = bundle_direction(corner.mean(axis=1), epicardial)
    # the tangent d with d_alpha . d and d_beta . d in the wanted ratio
    ruled = wanted[:, :1] * np.cross(d_beta, across) - wanted[:, 1:] * np.cross(d_alpha, across)
    size = np.linalg.norm(ruled, axis=1)
    weak = (size < 1e-9) | (np.ptp(corner, axis=1).max(axis=1) > 0.25) | ~np.isfinite(size)
    fibre = ruled / np.where(weak, 1.0, size)[:, None]
    return _fill(points[triangles].mean(axis=1), fibre, weak, across) if weak.any() else fibre


def bundle_direction(uac: FloatArray, epicardial: bool) -> FloatArray:
    """(n, 2) direction in the coordinate square: histology (Ho 2002, J Cardiovasc Electrophysiol 13:1198) as a rule of ours.

    Round the mitral rim fibres follow it (along alpha), in both layers. On the epicardium Bachmann's bundle crosses the
    anterior wall (along alpha), and the septopulmonary bundle runs from the roof down the posterior wall (along beta). On the
    endocardium the septoatrial bundle ascends the anterior wall and fans out over the posterior wall (along beta, oblique
    towards the left). At the junctions of veins and appendage fibres circle them. Between, directions blend as axes (no sign).
    """
    from lacli.anatomy.coordinates.uac import JUNCTION, RIM

    alpha, beta = uac.T
    along = np.array([1.0, 0.0])
    up = np.array([0.0, 1.0]) if epicardial else np.array([0.35, 0.94])
    tensors = []
    from_valve = np.minimum(beta, 1.0 - beta)
    tensors.append((np.clip(1.0 - from_valve / 0.15, 0.0, 1.0) * 3.0, np.broadcast_to(along, uac.shape)))
    anterior = np.clip((beta - 0.55) / 0.1, 0.0, 1.0)
    front = along if epicardial else up
    tensors.append((anterior, np.broadcast_to(front, uac.shape)))
    tensors.append((1.0 - anterior, np.broadcast_to(up, uac.shape)))
    for name in ("rspv", "ripv", "lspv", "lipv", "appendage"):
        circle = RIM.get(name, JUNCTION.get(name))
        assert circle is not None
        reach = JUNCTION[name].half_alpha if name in JUNCTION else 0.1
        x, y = alpha - circle.alpha, beta - circle.beta
        r = np.hypot(x, y)
        weight = 8.0 * np.clip(1.5 - r / reach, 0.0, 1.0)
        tensors.append((weight, np.column_stack([-y, x]) / np.maximum(r, 1e-9)[:, None]))
    # directions without sign are blended as tensors: the axis is the largest eigenvector
    xx = sum(w * d[:, 0] ** 2 for w, d in tensors)
    yy = sum(w * d[:, 1] ** 2 for w, d in tensors)
    xy = sum(w * d[:, 0] * d[:, 1] for w, d in tensors)
    angle = 0.5 * np.arctan2(2.0 * np.asarray(xy), np.asarray(xx) - np.asarray(yy))
    return np.column_stack([np.cos(angle), np.sin(angle)])
