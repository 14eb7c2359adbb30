"""Features of deformed states: cavity volume, displacements from the image's end-diastole, thickness and fibre strain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, PLANES, REGIONS

# Radon's 7 points, degree 5: exact for the volume below a quadratic map
_S = np.sqrt(15.0)
_A, _B = (6 - _S) / 21, (6 + _S) / 21
_POINTS = np.array(
    [[1 / 3, 1 / 3], [_A, _A], [1 - 2 * _A, _A], [_A, 1 - 2 * _A], [_B, _B], [1 - 2 * _B, _B], [_B, 1 - 2 * _B]], dtype=np.float64
)
_WEIGHTS = np.array([9 / 80] + [(155 - _S) / 2400] * 3 + [(155 + _S) / 2400] * 3)


@dataclass(frozen=True)
class TriangleShapes:
    """Shape functions (q, k) and their derivatives at the quadrature points; weights (q,) sum to 1/2."""

    value: FloatArray
    d1: FloatArray
    d2: FloatArray
    weight: FloatArray


def triangle_shapes(nodes: int) -> TriangleShapes:
    """Of a 3- or 6-node triangle in VTK's order (corners, middles of 01, 12, 20)."""
    r, s = _POINTS.T
    t = 1 - r - s
    one, zero = np.ones_like(r), np.zeros_like(r)
    if nodes == 3:
        value, d1, d2 = [t, r, s], [-one, one, zero], [-one, zero, one]
    else:
        value = [t * (2 * t - 1), r * (2 * r - 1), s * (2 * s - 1), 4 * t * r, 4 * r * s, 4 * s * t]
        d1 = [1 - 4 * t, 4 * r - 1, zero, 4 * (t - r), 4 * s, -4 * s]
        d2 = [1 - 4 * t, zero, 4 * s - 1, -4 * r, 4 * r, 4 * (t - s)]
    return TriangleShapes(np.stack(value, 1), np.stack(d1, 1), np.stack(d2, 1), _WEIGHTS)


def cavity_volume_ml(bundle: Bundle, points: FloatArray) -> float:
    """Volume inside endocardium and valve planes, mL; points (n, 3) mm, curved triangles integrated exactly."""
    keep = (bundle.tags == ENDO) | np.isin(bundle.tags, list(PLANES.values()))
    triangles = bundle.triangles[keep]
    shapes = triangle_shapes(triangles.shape[1])
    nodes = points[triangles]
    x = np.einsum("qk,tki->tqi", shapes.value, nodes)
    normal = np.cross(np.einsum("qk,tki->tqi", shapes.d1, nodes), np.einsum("qk,tki->tqi", shapes.d2, nodes))
    # normals point out of the wall, into the cavity
    return float(-np.einsum("q,tqi,tqi->", shapes.weight, x, normal) / 3.0 / 1000.0)


def endocardial_regions(bundle: Bundle) -> tuple[IntArray, IntArray]:
    """Endocardial triangles (t, 3 or 6) of the body and their region (t,), from the cell each belongs to."""
    size = len(bundle.points)
    faces = np.concatenate([bundle.tets[:, list(f)] for f in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))])
    owner = np.tile(np.arange(len(bundle.tets)), 4)
    key = _face_key(faces, size)
    order = np.argsort(key, kind="stable")
    endo = bundle.triangles[bundle.tags == ENDO]
    at = order[np.searchsorted(key[order], _face_key(endo[:, :3], size))]
    region = bundle.region[owner[at]]
    body = region <= max(REGIONS.values())
    return endo[body], region[body]


def _face_key(faces: IntArray, size: int) -> IntArray:
    a, b, c = np.sort(faces, axis=1).T
    return (a * size + b) * size + c if size < 2_000_000 else a * size * size + b * size + c


def displacements_mm(bundle: Bundle, image: FloatArray, points: FloatArray) -> dict[str, float]:
    """Mean distance from the image's end-diastolic endocardium, by area of the image: d_global_mm and d_<region>_mm.

    Weighting by area is the mean over element centres of an even mesh, and converges under refinement.
    """
    triangles, region = endocardial_regions(bundle)
    shapes = triangle_shapes(triangles.shape[1])
    nodes = image[triangles]
    normal = np.cross(np.einsum("qk,tki->tqi", shapes.d1, nodes), np.einsum("qk,tki->tqi", shapes.d2, nodes))
    weight = np.linalg.norm(normal, axis=2) * shapes.weight
    moved = np.linalg.norm(np.einsum("qk,tki->tqi", shapes.value, points[triangles] - nodes), axis=2)
    result = {"d_global_mm": float((weight * moved).sum() / weight.sum())}
    for name, number in REGIONS.items():
        here = region == number
        if here.any():
            result[f"d_{name}_mm"] = float((weight[here] * moved[here]).sum() / weight[here].sum())
    return result


def cell_gradient(bundle: Bundle, reference: FloatArray, points: FloatArray) -> FloatArray:
    """(m, 3, 3) deformation gradient of each cell's corners from ``reference`` to ``points``."""
    before = reference[bundle.tets[:, 1:4]] - reference[bundle.tets[:, :1]]
    after = points[bundle.tets[:, 1:4]] - points[bundle.tets[:, :1]]
    # rows are edges: after = before F^T
    return np.swapaxes(np.linalg.solve(before, after), 1, 2)


def regional_extras(bundle: Bundle, image: FloatArray, points: FloatArray) -> dict[str, float]:
    """Per region, volume-weighted from end-diastole: fibre stretch minus 1 and change of thickness (both shares)."""
    F = cell_gradient(bundle, image, points)
    edges = image[bundle.tets[:, 1:4]] - image[bundle.tets[:, :1]]
    volume = np.abs(np.linalg.det(edges))
    result: dict[str, float] = {}
    through = None
    if bundle.transmural is not None:
        rise = bundle.transmural[bundle.tets[:, 1:4]] - bundle.transmural[bundle.tets[:, :1]]
        gradient = np.linalg.solve(edges, rise[..., None])[..., 0]
        # planes of equal transmural coordinate stay such planes: thickness changes as 1 / |F^-T grad|
        moved = np.einsum("mij,mj->mi", np.swapaxes(np.linalg.inv(F), 1, 2), gradient)
        size = np.linalg.norm(moved, axis=1)
        through = np.where(size > 1e-12, np.linalg.norm(gradient, axis=1) / np.maximum(size, 1e-12), 1.0) - 1.0
    for name, number in REGIONS.items():
        here = bundle.region == number
        if not here.any():
            continue
        if bundle.fibre is not None:
            stretch = np.linalg.norm(np.einsum("mij,mj->mi", F[here], bundle.fibre[here]), axis=1) - 1.0
            result[f"fibre_strain_{name}"] = float(np.average(stretch, weights=volume[here]))
        if through is not None:
            result[f"thickness_change_{name}"] = float(np.average(through[here], weights=volume[here]))
    return result
