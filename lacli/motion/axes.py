"""The endocardium's own axes at the bundle's points: normal and the tangents of the universal coordinates."""

from __future__ import annotations

import numpy as np

from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle


def nodal_axes(bundle: Bundle, surface: Endocardium) -> dict[str, FloatArray]:
    """Unit vectors (n, 3) at the bundle's points, means of the endocardial faces around: normal, alpha, beta; 0 elsewhere."""
    result = {}
    for name, vectors in (("normal", surface.normal), ("alpha", surface.alpha), ("beta", surface.beta)):
        if vectors is None:
            continue
        mean = (surface.area[..., None] * vectors).sum(axis=1)
        total = np.zeros((len(bundle.points), 3))
        for k in range(surface.faces.shape[1]):
            np.add.at(total, surface.faces[:, k], mean)
        size = np.linalg.norm(total, axis=1, keepdims=True)
        result[name] = np.divide(total, size, out=np.zeros_like(total), where=size > 0)
    return result


def wall_normals(bundle: Bundle, surface: Endocardium) -> FloatArray:
    """Unit normals (n, 3) at the points of the cavity's whole surface: the endocardium's, and inside valve planes the planes'
    own; 0 elsewhere."""
    normal = nodal_axes(bundle, surface)["normal"]
    corner = surface.ed[surface.closed[:, :3]]
    # out of the cavity, as the endocardium's; faces of the bundle look into it
    vector = -np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    total = np.zeros_like(normal)
    for column in surface.closed.T:
        np.add.at(total, column, vector)
    size = np.linalg.norm(total, axis=1, keepdims=True)
    plane = np.divide(total, size, out=np.zeros_like(total), where=size > 0)
    return np.where(normal.any(axis=1, keepdims=True), normal, plane)
