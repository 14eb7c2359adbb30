"""Openings that a file has closed by flat discs with sharp rims, as programs that clip and close a surface leave them."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.geometry import curves as paths

SAME_DEG = 5.0  # between triangles of one disc: rounding of coordinates
SHARP_DEG = 20.0  # between a disc and the wall
SHARP_SHARE = 0.8  # of a disc's rim
LEAST_MM2 = 25.0
ROUND = 0.5  # 4 pi area / perimeter^2: 1 of a circle, 0.64 of an ellipse twice as long as wide
FLAT = 0.02  # of a disc's diameter: how far its points may lie off its plane


def flat_caps(points: FloatArray, triangles: IntArray) -> list[BoolArray]:
    """Masks (t,) of the triangles of each flat, round, sharply bordered disc of a consistently turned surface, largest first.

    points (n, 3) mm, triangles (t, 3).
    """
    vector = np.cross(points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]])
    size = np.linalg.norm(vector, axis=1)
    normal = vector / np.maximum(size, 1e-30)[:, None]
    edges, count, of = paths.edge_table(triangles)
    pairs, edge = _wings(of)
    angle = np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", normal[pairs[:, 0]], normal[pairs[:, 1]]), -1.0, 1.0)))
    flat = angle < SAME_DEG
    graph = coo_matrix((np.ones(int(flat.sum())), tuple(pairs[flat].T)), shape=(len(triangles),) * 2)
    _, part = connected_components(graph, directed=False)
    area = np.bincount(part, weights=0.5 * size)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    found = []
    for one in np.argsort(-area):
        if area[one] < LEAST_MM2:
            break
        mine = part == one
        border = mine[pairs[:, 0]] != mine[pairs[:, 1]]
        rim = float(length[edge[border]].sum())
        sharp = float(length[edge[border & (angle > SHARP_DEG)]].sum())
        is_open = bool((count[of[mine]] == 1).any())
        if is_open or rim == 0 or sharp < SHARP_SHARE * rim or 4 * np.pi * area[one] < ROUND * rim**2:
            continue
        if _height(points[np.unique(triangles[mine])]) <= FLAT * np.sqrt(4 * area[one] / np.pi):
            found.append(mine)
    return found


def _wings(of: IntArray) -> tuple[IntArray, IntArray]:
    """The two triangles (k, 2) at each inner edge, and the edge (k,)."""
    flat = np.argsort(of.ravel(), kind="stable")
    edge = of.ravel()[flat]
    inner = np.flatnonzero(edge[1:] == edge[:-1])
    return np.column_stack([flat[inner] // 3, flat[inner + 1] // 3]), edge[inner]


def _height(points: FloatArray) -> float:
    """Largest distance of points (k, 3) from the plane through them."""
    relative = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(relative, full_matrices=False)
    return float(np.abs(relative @ axes[2]).max())
