"""Tetrahedra: faces, second order, quality of straight and curved cells."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray, IntArray

# VTK's quadratic tetrahedron: corners 0-3, then the middles of these edges
TET10_EDGES: tuple[tuple[int, int], ...] = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
# faces of a tetrahedron, normals out of it
FACES: tuple[tuple[int, int, int], ...] = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))


def volumes(points: FloatArray, tets: IntArray) -> FloatArray:
    """Signed volumes (m,) mm3 of the straight cells."""
    a, b, c, d = (points[tets[:, i]] for i in range(4))
    return np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) / 6.0


def boundary_faces(tets: IntArray) -> tuple[IntArray, IntArray]:
    """Corner triangles (t, 3) that belong to one cell only, normals out of the material, and (t,) that cell."""
    faces = tets[:, FACES].reshape(-1, 3)
    owner = np.repeat(np.arange(len(tets)), 4)
    order, start, count = group_rows(np.sort(faces, axis=1))
    single = order[start[count == 1]]
    single.sort()
    return faces[single], owner[single]


def group_rows(rows: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Sorting (k,) of equal integer rows together, and the start and length of each group."""
    order = np.lexsort(rows.T[::-1])
    ranked = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = np.any(ranked[1:] != ranked[:-1], axis=1)
    start = np.flatnonzero(new)
    return order, start, np.diff(np.append(start, len(rows)))


def row_keys(rows: IntArray, size: int) -> IntArray:
    """One integer per row of two or three point ids (sorted within the row), for look-ups; ids below ``size``."""
    rows = np.sort(rows, axis=1)
    key = rows[:, 0]
    for column in rows.T[1:]:
        key = key * size + column
    return key


def edges_of(tets: IntArray) -> tuple[IntArray, IntArray]:
    """Undirected edges (e, 2) and, per cell, the edge behind each mid-edge node (m, 6) in TET10 order."""
    pairs = np.sort(tets[:, TET10_EDGES], axis=2).reshape(-1, 2)
    size = int(tets[:, :4].max()) + 1
    keys, inverse = np.unique(pairs[:, 0] * size + pairs[:, 1], return_inverse=True)
    return np.column_stack([keys // size, keys % size]), inverse.reshape(-1, 6)


def elevate(points: FloatArray, tets: IntArray, triangles: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
    """Linear mesh -> 10-node cells with straight edges: points, tets (m, 10), triangles (t, 6)."""
    edges, of_cell = edges_of(tets)
    n = len(points)
    middle = points[edges].mean(axis=1)
    size = int(tets.max()) + 1
    keys = edges[:, 0] * size + edges[:, 1]
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    at = np.searchsorted(keys, sides[..., 0] * size + sides[..., 1])
    return np.vstack([points, middle]), np.column_stack([tets, n + of_cell]), np.column_stack([triangles, n + at])


def scaled_jacobian(points: FloatArray, tets: IntArray) -> FloatArray:
    """Scaled Jacobian (m,) of the straight cells: sqrt(2) det J over the largest corner product of edge lengths (Verdict).

    1 for the regular tetrahedron, 0 for a flat one, negative for an inverted one.
    """
    x = points[tets[:, :4]]
    e = {pair: np.linalg.norm(x[:, pair[1]] - x[:, pair[0]], axis=1) for pair in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))}
    products = np.stack(
        [
            e[0, 1] * e[0, 2] * e[0, 3],
            e[0, 1] * e[1, 2] * e[1, 3],
            e[1, 2] * e[0, 2] * e[2, 3],
            e[0, 3] * e[1, 3] * e[2, 3],
        ]
    )
    det = 6.0 * volumes(points, tets)
    largest = np.maximum(products.max(axis=0), np.abs(det))
    return np.sqrt(2.0) * det / np.where(largest > 0, largest, 1.0)


def _sample_gradients() -> FloatArray:
    """Gradients (p, 10, 3) of the ten quadratic shape functions at the sampling points of the Jacobian.

    The points: 4 corners, 6 edge middles, the centre, and the four points of the degree-2 rule and of degree 4's inner ring.
    """
    a = 0.1381966011250105
    bary = [np.eye(4), np.full((1, 4), 0.25)]
    bary.append(np.array([[0.5 if k in pair else 0.0 for k in range(4)] for pair in TET10_EDGES]))
    bary.append(np.full((4, 4), a) + np.eye(4) * (1 - 4 * a))
    bary.append(np.full((4, 4), 0.09273525031089) + np.eye(4) * (1 - 4 * 0.09273525031089))
    bary.append(np.full((4, 4), 1 / 3) - np.eye(4) / 3)
    points = np.vstack(bary)
    dl = np.array([[-1.0, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    grad = np.empty((len(points), 10, 3))
    for p, lam in enumerate(points):
        for i in range(4):
            grad[p, i] = (4 * lam[i] - 1) * dl[i]
        for k, (i, j) in enumerate(TET10_EDGES):
            grad[p, 4 + k] = 4 * (lam[i] * dl[j] + lam[j] * dl[i])
    return grad


def curved_jacobian(points: FloatArray, tets: IntArray) -> FloatArray:
    """Smallest det J over the sampling points (corners, edge and face middles, quadrature points), over its mean (m,).

    1 for a straight cell; <= 0 where a 10-node cell folds. 4-node cells give 1 or, inverted, -1.
    """
    if tets.shape[1] == 4:
        return np.sign(volumes(points, tets))
    grad = _sample_gradients()
    node = points[tets].transpose(1, 0, 2).reshape(10, -1)
    edge = (grad.transpose(0, 2, 1).reshape(-1, 10) @ node).reshape(len(grad), 3, len(tets), 3)
    det = np.einsum("pmi,pmi->pm", edge[:, 0], np.cross(edge[:, 1], edge[:, 2]))
    straight = 6.0 * volumes(points, tets)
    return det.min(axis=0) / np.where(straight > 0, straight, np.inf) * np.sign(np.where(straight > 0, 1.0, -1.0))
