"""Open rims of a surface: evened where ragged, and each closed by a smooth cap with a label of its own."""

from __future__ import annotations

import numpy as np

from lacli.anatomy.cuts import clipping
from lacli.anatomy.cuts.caps import triangulate_loop
from lacli.anatomy.cuts.doubles import part_doubles
from lacli.anatomy.openings.candidate import area_vector
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry.surface import nearest, unique_edges

CAP = 101  # label of the first cap; PLANES take over once the openings have names
RAGGED = 0.25  # of the rim's mean edge: farther off its own running mean it is evened out


def close(
    points: FloatArray, triangles: IntArray, rims: list[IntArray], label: IntArray | None = None
) -> tuple[FloatArray, IntArray, IntArray]:
    """Points, triangles and labels of the surface with a cap over each rim (ordered point ids): CAP, CAP + 1 ... in their order.

    The triangles are consistently turned; the caps follow them. ``label``: of the triangles (t,), 0 if not given. A rim whose
    projection crosses itself gets cut ears; a triangle at a rim that its cap has too goes with it (see ``part_doubles``).
    """
    label = np.zeros(len(triangles), dtype=np.int64) if label is None else label
    directed = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    for k, rim in enumerate(rims):
        # the cap runs against the wall's direction along the rim
        along = ((directed[:, 0] == rim[0]) & (directed[:, 1] == rim[1])).any()
        ring = rim[::-1] if along else rim
        normal = _unit(area_vector(points[ring]))
        try:
            inner, cap = triangulate_loop(points, ring, normal)
            points = np.vstack([points, inner])
            middle, cap, stays = part_doubles(points, cap, triangles, normal)
            points, triangles, label = np.vstack([points, middle]), triangles[stays], label[stays]
        except AnatomyError:
            points, cap = clipping.fill_rim(points, rim, triangles)
        triangles = np.vstack([triangles, cap])
        label = np.concatenate([label, np.full(len(cap), CAP + k, dtype=np.int64)])
    return points, triangles, label


def even(points: FloatArray, triangles: IntArray, rims: list[IntArray], reach_mm: float = 4.0) -> tuple[FloatArray, list[int]]:
    """Points with ragged rims smoothed out, the wall near them following; and which rims were ragged.

    A ragged rim (cells cut along their faces, maps drawn by hand) is averaged along itself by about three edges and scaled back
    to its area; points of the wall within ``reach_mm`` of it take the mean of their neighbours, fading with distance.
    """
    ragged = [k for k, rim in enumerate(rims) if _raggedness(points[rim]) > RAGGED]
    return (even_all(points, triangles, [rims[k] for k in ragged], reach_mm) if ragged else points), ragged


def even_all(points: FloatArray, triangles: IntArray, rims: list[IntArray], reach_mm: float = 4.0) -> FloatArray:
    """As ``even``, every rim given."""
    points = points.copy()
    fixed = np.zeros(len(points), dtype=bool)
    for rim in rims:
        ring = points[rim]
        smooth = _running_mean(ring, 10)
        middle = smooth.mean(axis=0)
        size = [float(np.linalg.norm(area_vector(x))) for x in (ring, smooth)]
        points[rim] = middle + (smooth - middle) * np.sqrt(size[0] / max(size[1], 1e-12))
        fixed[rim] = True
    edges, _ = unique_edges(triangles)
    used = np.unique(triangles)
    distance = np.full(len(points), np.inf)
    distance[used] = nearest(points[fixed], points[used])[0]
    weight = np.where(fixed, 0.0, np.clip(1.0 - distance / reach_mm, 0.0, 1.0))[:, None]
    count = np.maximum(np.bincount(edges.ravel(), minlength=len(points)), 1)[:, None]
    for _ in range(10):
        total = np.zeros_like(points)
        np.add.at(total, edges[:, 0], points[edges[:, 1]])
        np.add.at(total, edges[:, 1], points[edges[:, 0]])
        points = points + weight * (total / count - points)
    return points


def _raggedness(ring: FloatArray) -> float:
    edge = np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).mean()
    away = ring - _running_mean(ring, 2)
    return float(np.sqrt((away**2).sum(axis=1).mean()) / max(float(edge), 1e-12))


def _running_mean(ring: FloatArray, times: int) -> FloatArray:
    for _ in range(times):
        ring = 0.5 * ring + 0.25 * (np.roll(ring, 1, axis=0) + np.roll(ring, -1, axis=0))
    return ring


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / max(float(np.linalg.norm(v)), 1e-12))
