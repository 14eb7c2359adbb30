"""Openings that a file has closed by flat discs, as programs that clip and close a surface leave them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.geometry import curves as paths
from lacli.geometry.triangles import area_normals

LEAST_MM2 = 25.0
ROUND = 0.65  # 4 pi area / perimeter^2: 1 of a circle, 0.84 and 0.66 of ellipses twice and thrice as long as wide
FEWEST = 6  # triangles: a facet of a coarse surface is no disc
SHARP_DEG = 20.0  # between a disc and the wall


@dataclass(frozen=True)
class Kind:
    """How discs are drawn: neighbours that belong together, by the angle (degrees) between them or the length of their common
    edge (in median edges of the surface); how far points are off the plane at most (of the diameter); least sharp share of the
    rim."""

    most_deg: float
    least_edges: float
    height: float
    sharp: float


KINDS = (
    Kind(5.0, 0.0, 0.02, 0.8),  # cut by a plane, with the rounding of coordinates
    Kind(15.0, 0.0, 0.12, 0.8),  # drawn over a rim that is not quite plane
    Kind(40.0, 4.0, 0.06, 0.0),  # long triangles from rim to rim, the short ones at the rim left out
)


def flat_caps(points: FloatArray, triangles: IntArray) -> list[BoolArray]:
    """Masks (t,) of the triangles of each flat, round disc: sharply bordered, or of long triangles.

    The surface is consistently turned; points (n, 3) mm, triangles (t, 3).
    """
    vector = area_normals(points[triangles])
    size = np.linalg.norm(vector, axis=1)
    normal = vector / np.maximum(size, 1e-30)[:, None]
    edges, count, of = paths.edge_table(triangles)
    sides, edge = paths.side_pairs(of)
    pairs = sides // 3
    angle = np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", normal[pairs[:, 0]], normal[pairs[:, 1]]), -1.0, 1.0)))
    all_lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    length, usual = all_lengths[edge], float(np.median(all_lengths))
    found: list[BoolArray] = []
    taken = (count[of] == 1).any(axis=1)  # a cap has no open edge
    for kind in KINDS:
        joined = pairs[(angle < kind.most_deg) & (length >= kind.least_edges * usual)]
        graph = coo_matrix((np.ones(len(joined)), tuple(joined.T)), shape=(len(triangles),) * 2)
        _, part = connected_components(graph, directed=False)
        area = np.bincount(part, weights=0.5 * size)
        for one in np.flatnonzero((area >= LEAST_MM2) & (np.bincount(part) >= FEWEST)):
            mine = part == one
            border = mine[pairs[:, 0]] != mine[pairs[:, 1]]
            rim, sharp = float(length[border].sum()), float(length[border & (angle > SHARP_DEG)].sum())
            if rim == 0 or sharp < kind.sharp * rim or 4 * np.pi * area[one] < ROUND * rim**2 or (taken & mine).any():
                continue
            if _height(points[np.unique(triangles[mine])]) <= kind.height * np.sqrt(4 * area[one] / np.pi):
                found.append(mine)
                taken |= mine
    return found


def _height(points: FloatArray) -> float:
    """Largest distance of points (k, 3) from the plane through them."""
    relative = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(relative, full_matrices=False)
    return float(np.abs(relative @ axes[2]).max())
