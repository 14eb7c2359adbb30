"""The surface while it is remeshed: what follows from its triangles, and the way back to the reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lacli.anatomy.remeshing.projection import Reference
from lacli.base.arrays import FloatArray, IntArray
from lacli.contracts.labels import is_plane
from lacli.geometry.surface import unique_edges
from lacli.geometry.triangles import area_normals

INNER, BORDER, CORNER = 0, 1, 2
Asked = Callable[[FloatArray], FloatArray]  # points (k, 3) mm -> wanted edge length (k,) mm


@dataclass
class WorkMesh:
    """Work state: points, triangles, labels, and what follows from them."""

    points: FloatArray
    triangles: IntArray
    label: IntArray
    size: FloatArray  # asked edge length per point
    refusals: FloatArray = field(default_factory=lambda: np.zeros(0))  # collapses refused so far, per point

    def refresh(self) -> None:
        """Edges, their triangles, and whether points are inside a patch, on a border, or fixed."""
        self.edges, self.of_triangle = unique_edges(self.triangles)
        e = len(self.edges)
        order = np.argsort(self.of_triangle.ravel(), kind="stable")
        self.wing = (order // 3).reshape(e, 2)  # the two triangles of each edge
        self.opposite = self.triangles[order // 3, (order % 3 + 2) % 3].reshape(e, 2)
        self.is_border = self.label[self.wing[:, 0]] != self.label[self.wing[:, 1]]
        n = len(self.points)
        count = np.bincount(self.edges[self.is_border].ravel(), minlength=n)
        self.kind = np.where(count == 0, INNER, np.where(count == 2, BORDER, CORNER))
        self.valence = np.bincount(self.edges.ravel(), minlength=n)
        self.length = np.linalg.norm(self.points[self.edges[:, 0]] - self.points[self.edges[:, 1]], axis=1)
        self.wanted = self.size[self.edges].mean(axis=1)


def project(mesh: WorkMesh, ids: IntArray, reference: Reference) -> None:
    """Put points back: those inside a patch on it, those of a border on the border; corners stay."""
    kind = mesh.kind[ids]
    label = np.zeros(len(mesh.points), dtype=np.int64)
    label[mesh.triangles.ravel()] = np.repeat(mesh.label, 3)
    inner = ids[kind == INNER]
    for value in np.unique(label[inner]):
        which = inner[label[inner] == value]
        mesh.points[which] = reference.closest(mesh.points[which], int(value))
    on_border = np.zeros(len(mesh.points), dtype=bool)
    on_border[ids[kind == BORDER]] = True
    if on_border.any():
        edges = mesh.edges[mesh.is_border]
        pair = np.sort(mesh.label[mesh.wing[mesh.is_border]], axis=1)
        pairs = np.full((len(mesh.points), 2), -1)
        for k in range(2):
            pairs[edges[:, k]] = pair
        chosen = np.flatnonzero(on_border)
        for low, high in np.unique(pairs[chosen], axis=0):
            which = chosen[(pairs[chosen, 0] == low) & (pairs[chosen, 1] == high)]
            mesh.points[which] = reference.closest_on_border(mesh.points[which], (int(low), int(high)))


def turned(mesh: WorkMesh, position: FloatArray, which: IntArray) -> np.ndarray:
    """Triangles (of ids ``which``) that would face away from the surface around them if the points moved to ``position``.

    The surface's direction is the mean of the area-weighted normals at the triangle's points, wall and planes apart: thin
    triangles, whose own normals mean nothing, have no say in it.
    """
    vector = area_normals(mesh.points[mesh.triangles])
    plane = is_plane(mesh.label)
    n = len(mesh.points)
    around = np.zeros((2 * n, 3))
    slot = mesh.triangles + n * plane[:, None]
    for d in range(3):
        around[:, d] = np.bincount(slot.ravel(), weights=np.repeat(vector[:, d], 3), minlength=2 * n)
    around /= np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-30)
    expected = around[slot[which]].sum(axis=1)
    expected /= np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), 1e-30)
    new = area_normals(position[mesh.triangles[which]])
    cosine = np.einsum("ij,ij->i", new, expected) / np.maximum(np.linalg.norm(new, axis=1), 1e-30)
    old = vector[which]
    before = np.einsum("ij,ij->i", old, expected) / np.maximum(np.linalg.norm(old, axis=1), 1e-30)
    return (cosine < 0.4) & (cosine < before)
