"""Closed triangle surface of the blood pool, its cuts labelled. All lengths in mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError

WALL = 0


@dataclass(frozen=True)
class Surface:
    """A triangle surface with a label per triangle.

    points (n, 3) mm; triangles (t, 3) point ids, normals out of the cavity;
    label (t,): 0 the wall, 11 - 16 the wall's strip along a rim (RINGS, optional), 21 - 26 the valve planes (PLANES).
    """

    points: FloatArray
    triangles: IntArray
    label: IntArray

    def normals(self) -> FloatArray:
        """Unit normals per triangle (t, 3); zero where a triangle is degenerate."""
        n = self.area_vectors()
        size = np.linalg.norm(n, axis=1, keepdims=True)
        return n / np.where(size > 0, size, 1.0)

    def area_vectors(self) -> FloatArray:
        """Normals times triangle area (t, 3), mm2."""
        a, b, c = (self.points[self.triangles[:, i]] for i in range(3))
        return 0.5 * np.cross(b - a, c - a)

    def areas(self) -> FloatArray:
        """Area of each triangle (t,), mm2."""
        return np.linalg.norm(self.area_vectors(), axis=1)

    def area_mm2(self) -> float:
        """Whole area, mm2."""
        return float(self.areas().sum())

    def volume_ml(self) -> float:
        """Volume enclosed, mL; positive where the normals point out (divergence theorem)."""
        centre = self.points.mean(axis=0)
        a, b, c = (self.points[self.triangles[:, i]] - centre for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0 / 1000.0)

    def mean_edge_mm(self) -> float:
        """Mean length of the edges, mm."""
        edges, _ = unique_edges(self.triangles)
        return float(np.linalg.norm(self.points[edges[:, 0]] - self.points[edges[:, 1]], axis=1).mean())

    def is_closed(self) -> bool:
        """Every directed edge once, and its opposite once: closed, manifold along edges, consistently oriented."""
        return len(self.triangles) > 0 and not defects(self.triangles)


def unique_edges(triangles: IntArray) -> tuple[IntArray, IntArray]:
    """Undirected edges (e, 2), sorted, and (t, 3) the edge of each triangle's sides 01, 12, 20."""
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    size = int(triangles.max()) + 1
    keys, inverse = np.unique(pairs[:, 0] * size + pairs[:, 1], return_inverse=True)
    return np.column_stack([keys // size, keys % size]), inverse.reshape(-1, 3)


def defects(triangles: IntArray) -> str:
    """What keeps the triangles from being a closed oriented manifold, in words; empty if nothing does."""
    directed = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    size = int(triangles.max()) + 1
    forward, count = np.unique(directed[:, 0] * size + directed[:, 1], return_counts=True)
    backward = np.unique(directed[:, 1] * size + directed[:, 0])
    words = []
    if np.any(directed[:, 0] == directed[:, 1]):
        words.append("triangles with a repeated point")
    if np.any(count > 1):
        words.append(f"{int((count > 1).sum())} edges used twice in one direction (non-manifold or turned triangles)")
    open_edges = len(np.setdiff1d(forward, backward, assume_unique=True))
    if open_edges:
        words.append(f"{open_edges} open edges")
    return ", ".join(words)


def check(surface: Surface, where: str = "surface") -> None:
    """Raise AnatomyError where the surface is not closed, oriented outward and finite."""
    if not np.isfinite(surface.points).all():
        raise AnatomyError(f"{where}: a point has a coordinate that is not finite.")
    if len(surface.triangles) == 0:
        raise AnatomyError(f"{where}: there is no triangle.")
    if surface.triangles.min() < 0 or surface.triangles.max() >= len(surface.points):
        raise AnatomyError(f"{where}: a triangle names a point that does not exist.")
    if len(surface.label) != len(surface.triangles):
        raise AnatomyError(f"{where}: 'label' does not have one value per triangle.")
    problem = defects(surface.triangles)
    if problem:
        raise AnatomyError(f"{where}: the cavity surface is not closed: {problem}. Repair it, or let `lacli mesh` do so.")
    if surface.volume_ml() <= 0:
        raise AnatomyError(f"{where}: the surface is inside out (volume {surface.volume_ml():.3g} mL). Turn its triangles.")


def nearest(among: FloatArray, points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distance (k,) mm from each of ``points`` to the nearest of ``among``, and which one (k,)."""
    distance, index = cKDTree(among).query(points)
    return np.asarray(distance, dtype=np.float64), np.asarray(index, dtype=np.int64)


def compact(surface: Surface) -> Surface:
    """The same surface without points that no triangle uses."""
    used, local = np.unique(surface.triangles, return_inverse=True)
    return Surface(surface.points[used], local.reshape(-1, 3), surface.label)
