"""Principal curvatures of a surface of triangles: those of the quadratic that fits best around each node."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lacli.base.arrays import FloatArray, IntArray

FEWEST = 8  # nodes for a fit of six numbers


def curvature_sum(points: FloatArray, triangles: IntArray, reach_mm: float) -> FloatArray:
    """Sum of the principal curvatures (n,) 1/mm at the nodes, positive where the surface bulges the way its normals point.

    Of the surface of ``triangles`` (t, 3 or 6), its nodes within ``reach_mm`` of each; NaN at other nodes, and where too few are
    near. A tension T along the surface carries the pressure T times this sum.
    """
    corners = triangles[:, :3]
    nodes = np.unique(triangles)
    vector = np.cross(points[corners[:, 1]] - points[corners[:, 0]], points[corners[:, 2]] - points[corners[:, 0]])
    normal = np.zeros((len(points), 3))
    for k in range(triangles.shape[1]):
        np.add.at(normal, triangles[:, k], vector)
    normal = normal[nodes] / np.maximum(np.linalg.norm(normal[nodes], axis=1, keepdims=True), 1e-300)
    at = points[nodes]
    pairs = cKDTree(at).query_pairs(reach_mm, output_type="ndarray")
    own = np.arange(len(nodes))
    here = np.concatenate([pairs[:, 0], pairs[:, 1], own])
    there = np.concatenate([pairs[:, 1], pairs[:, 0], own])
    same = (normal[here] * normal[there]).sum(axis=1) > 0.0  # not the surface on the other side
    here, there = here[same], there[same]
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    one = np.cross(normal, least)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two = np.cross(normal, one)
    step = (at[there] - at[here]) / reach_mm
    x, y, height = ((step * axis[here]).sum(axis=1) for axis in (one, two, normal))
    terms = np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=1)
    left, right = np.zeros((len(nodes), 6, 6)), np.zeros((len(nodes), 6))
    np.add.at(left, here, terms[:, :, None] * terms[:, None, :])
    np.add.at(right, here, terms * height[:, None])
    enough = np.bincount(here, minlength=len(nodes)) >= FEWEST
    fit = np.linalg.solve(left[enough] + 1e-9 * np.eye(6), right[enough, :, None])[..., 0]
    found = np.full(len(points), np.nan)
    # the fit is height = .. + a x2 / 2 + b x y + c y2 / 2 over a plane that it may lean against
    p, q, a, b, c = fit[:, 1:].T
    found[nodes[enough]] = -((1 + q * q) * a - 2 * p * q * b + (1 + p * p) * c) / (1 + p * p + q * q) ** 1.5 / reach_mm
    return found
