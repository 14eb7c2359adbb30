"""Features of the wall's cells in deformed states: thickness and fibre stretch. (The endocardium's: anatomy.surface_features.)"""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import REGIONS


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
            result[f"fibre_stretch_{name}"] = float(np.average(stretch, weights=volume[here]))
        if through is not None:
            result[f"thickness_change_{name}"] = float(np.average(through[here], weights=volume[here]))
    return result
