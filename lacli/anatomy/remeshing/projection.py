"""Closest points and smooth normals on a labelled reference surface, each label's patch and each border by itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.spatial import cKDTree

from lacli.base.arrays import FloatArray, IntArray
from lacli.contracts.labels import is_ring
from lacli.geometry.surface import Surface, unique_edges


def side_of(label: IntArray) -> IntArray:
    """Labels with the rims' strips counted to the wall: what is smooth together."""
    return np.where(is_ring(label), 0, label)


def border_edges(triangles: IntArray, label: IntArray) -> IntArray:
    """Edges (e, 2) between triangles of different labels."""
    edges, of_triangle = unique_edges(triangles)
    low = np.full(len(edges), np.iinfo(np.int64).max)
    high = np.full(len(edges), -1)
    for k in range(3):
        np.minimum.at(low, of_triangle[:, k], label)
        np.maximum.at(high, of_triangle[:, k], label)
    return edges[low != high]


def vertex_normals(surface: Surface, side: int, smoothing_mm: float = 0.0) -> FloatArray:
    """Unit normals (n, 3) of one side's patch at its points, NaN elsewhere; averaged over about ``smoothing_mm``."""
    keep = side_of(surface.label) == side
    triangles = surface.triangles[keep]
    vectors = surface.area_vectors()[keep]
    n = len(surface.points)
    total = np.zeros((n, 3))
    for d in range(3):
        total[:, d] = np.bincount(triangles.ravel(), weights=np.repeat(vectors[:, d], 3), minlength=n)
    used = np.zeros(n, dtype=bool)
    used[triangles] = True
    if smoothing_mm > 0:
        edges, _ = unique_edges(triangles)
        length = np.linalg.norm(surface.points[edges[:, 0]] - surface.points[edges[:, 1]], axis=1).mean()
        graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n)).tocsr()
        graph = graph + graph.T + diags(np.ones(n))
        total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
        # k steps of averaging over the neighbours spread like a walk of sqrt(k) edges
        for _ in range(min(int((smoothing_mm / length) ** 2) + 1, 50)):
            total = np.asarray(graph @ total, dtype=np.float64)
            total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    total[~used] = np.nan
    return total


@dataclass
class Reference:
    """A surface prepared for look-ups; build it once per surface."""

    surface: Surface
    _locators: dict[int, tuple[Any, IntArray]] = field(default_factory=dict)
    _curves: dict[tuple[int, int], tuple[cKDTree, FloatArray, FloatArray]] = field(default_factory=dict)
    _normals: dict[int, tuple[cKDTree, FloatArray]] = field(default_factory=dict)

    def closest(self, points: FloatArray, label: int) -> FloatArray:
        """Closest points (k, 3) on the patch with this label."""
        return self._query(points, label)[0]

    def cells(self, points: FloatArray, label: int) -> IntArray:
        """Triangle ids (k,) of the closest points on the patch with this label."""
        return self._query(points, label)[1]

    def distance(self, points: FloatArray) -> FloatArray:
        """Distance (k,) mm to the whole surface."""
        return np.linalg.norm(points - self._query(points, -1)[0], axis=1)

    def _query(self, points: FloatArray, label: int) -> tuple[FloatArray, IntArray]:
        import pyvista as pv

        if label not in self._locators:
            ids = np.arange(len(self.surface.triangles)) if label < 0 else np.flatnonzero(self.surface.label == label)
            used, local = np.unique(self.surface.triangles[ids], return_inverse=True)
            patch = pv.PolyData.from_regular_faces(self.surface.points[used], local.reshape(-1, 3))
            self._locators[label] = (patch, ids)
        patch, ids = self._locators[label]
        if len(points) == 0:
            return points.reshape(0, 3), np.zeros(0, dtype=np.int64)
        cell, closest = patch.find_closest_cell(np.ascontiguousarray(points), return_closest_point=True)
        return np.asarray(closest, dtype=np.float64).reshape(-1, 3), ids[np.atleast_1d(cell)]

    def closest_on_border(self, points: FloatArray, pair: tuple[int, int]) -> FloatArray:
        """Closest points (k, 3) on the border between two labels (low, high)."""
        if pair not in self._curves:
            low, high = (np.isin(self.surface.label, [value]) for value in pair)
            first, _ = unique_edges(self.surface.triangles[low])
            second, _ = unique_edges(self.surface.triangles[high])
            size = len(self.surface.points)
            shared = np.intersect1d(first[:, 0] * size + first[:, 1], second[:, 0] * size + second[:, 1])
            a, b = self.surface.points[shared // size], self.surface.points[shared % size]
            self._curves[pair] = (cKDTree((a + b) / 2), a, b)
        tree, a, b = self._curves[pair]
        _, near = tree.query(points, k=min(6, len(a)))
        near = near.reshape(len(points), -1)
        start, along = a[near], b[near] - a[near]
        t = np.einsum("pkd,pkd->pk", points[:, None] - start, along) / np.maximum(np.einsum("pkd,pkd->pk", along, along), 1e-30)
        foot = start + np.clip(t, 0, 1)[..., None] * along
        best = np.argmin(np.linalg.norm(foot - points[:, None], axis=2), axis=1)
        return foot[np.arange(len(points)), best]

    def normals(self, points: FloatArray, side: int, smoothing_mm: float) -> FloatArray:
        """Smooth unit normals (k, 3) of one side's patch near the points (mean of the closest points', by distance)."""
        if side not in self._normals:
            all_normals = vertex_normals(self.surface, side, smoothing_mm)
            used = np.flatnonzero(np.isfinite(all_normals[:, 0]))
            self._normals[side] = (cKDTree(self.surface.points[used]), all_normals[used])
        tree, values = self._normals[side]
        distance, near = (np.asarray(x) for x in tree.query(points, k=min(4, tree.n)))
        distance, near = distance.reshape(len(points), -1), near.reshape(len(points), -1)
        weight = 1.0 / (distance + 1e-3 + 0.1 * distance.max(axis=1, keepdims=True))
        total = np.einsum("pk,pkd->pd", weight, values[near])
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
