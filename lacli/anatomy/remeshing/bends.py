"""How long edges may be where a surface bends: a triangle must not span a fold or a thin vessel's tip."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy.remeshing.projection import vertex_normals
from lacli.anatomy.remeshing.workmesh import Asked
from lacli.base.arrays import FloatArray, IntArray
from lacli.geometry.surface import Surface, unique_edges

TURN = 1.3  # rad, the most that the wall may turn along one edge
LEAST = 0.4  # of the size asked for
SMOOTHING_MM = 1.5  # of the normals: the noise of voxels bends nothing
GROWTH = 0.4  # of the edge length per mm away from a bend
SHARE = 0.5  # of the turning neighbours of a point, so that a single noisy one does not count


def limits(surface: Surface, size: float) -> Asked | None:
    """Longest edges (k,) mm at points (k, 3) by how the wall bends there; None where none is below ``size``."""
    bend, edges, length = bending(surface, SMOOTHING_MM)
    local = np.clip(TURN * np.sqrt(SHARE) / np.maximum(bend, 1e-9), LEAST * size, size)
    if (local >= size).all():
        return None
    local = grown(local, edges, length, GROWTH)
    tree = cKDTree(surface.points)

    def asked(points: FloatArray) -> FloatArray:
        distance, near = (np.asarray(x) for x in tree.query(points))
        return np.asarray(np.minimum(size, local[near] + GROWTH * distance), dtype=np.float64)

    return asked


def bending(surface: Surface, smoothing_mm: float) -> tuple[FloatArray, IntArray, FloatArray]:
    """How the wall turns at each point (n,), rad per mm, the root mean square over its edges, 0 off the wall; the wall's edges
    (e, 2) and their lengths (e,) mm."""
    normals = vertex_normals(surface, 0, smoothing_mm)
    edges, _ = unique_edges(surface.triangles)
    edges = edges[np.isfinite(normals[edges, 0]).all(axis=1)]
    a, b = edges.T
    length = np.linalg.norm(surface.points[a] - surface.points[b], axis=1)
    bend = np.linalg.norm(normals[a] - normals[b], axis=1) / np.maximum(length, 0.25 * float(length.mean()))
    n = len(surface.points)
    count = np.maximum(np.bincount(edges.ravel(), minlength=n), 1)
    square = np.bincount(edges.ravel(), weights=np.repeat(bend**2, 2), minlength=n) / count
    return np.sqrt(square), edges, length


def grown(local: FloatArray, edges: IntArray, length: FloatArray, growth: float) -> FloatArray:
    """Sizes (n,) that grow by at most ``growth`` per mm along the edges (e, 2) of these lengths (e,)."""
    a, b = edges.T
    local = local.copy()
    for _ in range(40):
        before = local.copy()
        np.minimum.at(local, a, before[b] + growth * length)
        np.minimum.at(local, b, before[a] + growth * length)
        if np.allclose(local, before, rtol=1e-3):
            break
    return local
