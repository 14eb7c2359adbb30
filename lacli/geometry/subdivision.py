"""Boundary faces cut into smaller flat triangles whose points lie on the faces' own, curved geometry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths


@dataclass(frozen=True)
class Subdivided:
    """Faces cut into k * k triangles each: points (p, 3) mm, triangles (t * k * k, 3) of these points, turned as their faces.

    source (t * k * k,): the face each triangle came from. node (p,): the mesh's point that the point is, -1 for a new one;
    values at the mesh's own points are those where node >= 0.
    """

    points: FloatArray
    triangles: IntArray
    source: IntArray
    node: IntArray


@dataclass(frozen=True)
class Lattice:
    """A triangle cut in k * k: weights (n, 3) of the corners at the lattice's points, triangles (k * k, 3) of them.

    Points in the order of a face's nodes: corners, then k - 1 along 01, 12 and 20, then those inside.
    """

    weights: FloatArray
    triangles: IntArray


@lru_cache(maxsize=16)
def lattice(k: int) -> Lattice:
    """The lattice of k steps along each side."""
    steps = range(1, k)
    place = [(k, 0, 0), (0, k, 0), (0, 0, k)]
    place += [(k - s, s, 0) for s in steps] + [(0, k - s, s) for s in steps] + [(s, 0, k - s) for s in steps]
    place += [(k - i - j, i, j) for j in steps for i in range(1, k - j)]
    at = {(i, j): n for n, (_, i, j) in enumerate(place)}
    up = [(at[i, j], at[i + 1, j], at[i, j + 1]) for j in range(k) for i in range(k - j)]
    down = [(at[i + 1, j], at[i + 1, j + 1], at[i, j + 1]) for j in range(k - 1) for i in range(k - 1 - j)]
    return Lattice(np.array(place, dtype=np.float64) / k, np.array(up + down, dtype=np.int64))


def straight(faces: IntArray) -> IntArray:
    """6-node faces (t, 6) as four flat triangles of their own nodes each, one face's after the other's; (t, 3) unchanged."""
    return faces if faces.shape[1] == 3 else faces[:, lattice(2).triangles].reshape(-1, 3)


def subdivide(points: FloatArray, faces: IntArray, k: int) -> Subdivided:
    """Faces (t, 3) or (t, 6) of ``points`` (n, 3) mm as k * k triangles each.

    Points that faces share are one point, known by the edge and the step along it, not by position. On 6-node faces ``k`` is
    even, so that the nodes at the edges' middles are points of the lattice. Raises AnatomyError where it is not, or below 1.
    """
    if k < 1 or (faces.shape[1] == 6 and k % 2):
        raise AnatomyError(f"faces of {faces.shape[1]} nodes cannot be cut in {k} along each side.")
    cut = lattice(k)
    corners = faces[:, :3]
    used, corner = np.unique(corners, return_inverse=True)
    edges, _, of = paths.edge_table(corners)
    # along an edge steps count from its lower point; a face that runs it the other way reads them backwards
    step = np.broadcast_to(np.arange(k - 1), (len(faces), 3, k - 1))
    backwards = corners > np.roll(corners, -1, axis=1)
    step = np.where(backwards[:, :, None], k - 2 - step, step)
    on_edge = len(used) + of[:, :, None] * (k - 1) + step
    inner = (k - 1) * (k - 2) // 2
    first = len(used) + len(edges) * (k - 1)
    inside = first + np.arange(len(faces) * inner).reshape(len(faces), inner)
    ids = np.hstack([corner.reshape(-1, 3), on_edge.reshape(len(faces), -1), inside])
    node = np.full(first + inside.size, -1, dtype=np.int64)
    node[ids[:, :3]] = corners
    if faces.shape[1] == 6:
        node[on_edge[:, :, k // 2 - 1]] = faces[:, 3:]
    place = np.empty((len(node), 3))
    place[ids] = np.einsum("nk,tkd->tnd", _shapes(cut.weights, faces.shape[1]), points[faces])
    triangles = ids[:, cut.triangles].reshape(-1, 3)
    return Subdivided(place, triangles, np.repeat(np.arange(len(faces)), k * k), node)


def _shapes(weights: FloatArray, nodes: int) -> FloatArray:
    """Shape functions (n, nodes) of 3- or 6-node faces at corner weights (n, 3)."""
    if nodes == 3:
        return weights
    a, b, c = weights.T
    return np.column_stack([a * (2 * a - 1), b * (2 * b - 1), c * (2 * c - 1), 4 * a * b, 4 * b * c, 4 * c * a])
