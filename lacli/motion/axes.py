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
