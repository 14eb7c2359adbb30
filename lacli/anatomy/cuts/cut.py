"""Flat cuts through a closed surface: what lies beyond is removed, the opening closed by a labelled plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lacli.anatomy.coordinates.frame import unit
from lacli.anatomy.cuts.caps import crossing_points, project, rim_loops, triangulate_loop
from lacli.anatomy.cuts.doubles import part_doubles
from lacli.anatomy.cuts.parting import clear, part, touching_points
from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry.surface import Surface, check, compact


@dataclass(frozen=True)
class Cut:
    """A plane through ``centre`` (3,) mm, ``direction`` (3,) unit and outward; what is removed hangs together with the
    plane's opening and lies within ``reach_mm`` of the centre across the direction; ``label`` of the plane (PLANES)."""

    centre: FloatArray
    direction: FloatArray
    reach_mm: float
    label: int


def cut_open(surface: Surface, cut: Cut) -> Surface:
    """Remove what lies beyond ``cut`` and close the opening by a flat plane with its label.

    Raises AnatomyError where the plane does not cross the surface in one closed curve near its centre.
    """
    relative = surface.points - cut.centre
    height = relative @ cut.direction
    across = np.linalg.norm(relative - height[:, None] * cut.direction, axis=1)
    height = np.where(across < cut.reach_mm, height, np.minimum(height, -1.0))
    movable = np.ones(len(height), dtype=bool)
    while True:
        points, kept, label = _kept(surface, height, movable, cut)
        fault = _faults(points, kept, cut)
        if len(fault) == 0 or not movable.any():
            break
        # where no point is moved and none lies in the plane, its section of a surface is a curve that does not meet itself
        height = clear(height) if movable.all() else height
        moved = movable & np.isin(np.arange(len(movable)), fault)
        movable &= ~moved if moved.any() else False
    loop, direction = _loop(points, kept, cut), unit(cut.direction)
    inner, cap = triangulate_loop(points, loop, direction)
    points = np.vstack([points, inner])
    middle, cap, stays = part_doubles(points, cap, kept, direction)
    result = compact(
        Surface(
            np.vstack([points, middle]),
            np.vstack([kept[stays], cap]),
            np.concatenate([label[stays], np.full(len(cap), cut.label)]),
        )
    )
    check(result, f"surface cut at ({_text(cut.centre)})")
    return result


def _kept(surface: Surface, height: FloatArray, movable: BoolArray, cut: Cut) -> tuple[FloatArray, IntArray, IntArray]:
    """All points, and triangles and labels of the largest piece below the plane."""
    parted, beyond = part(surface, height, movable)
    if not beyond.any() or beyond.all():
        raise AnatomyError(f"The plane at ({_text(cut.centre)}) does not cut the surface.")
    return parted.points, *_largest(parted.triangles[~beyond], parted.label[~beyond])


def _faults(points: FloatArray, kept: IntArray, cut: Cut) -> IntArray:
    """Ids of the points where rims touch, or else where the plane's rim crosses itself."""
    touching = touching_points(kept)
    if len(touching):
        return touching
    loop = _loop(points, kept, cut)
    return loop[crossing_points(project(points[loop], unit(cut.direction))[0])]


def _loop(points: FloatArray, kept: IntArray, cut: Cut) -> IntArray:
    """The one rim of the kept triangles that lies in the plane near its centre."""
    loops = [loop for loop in rim_loops(kept) if np.abs((points[loop] - cut.centre) @ cut.direction).max() < 1e-3]
    loops = [loop for loop in loops if np.linalg.norm(points[loop].mean(axis=0) - cut.centre) < cut.reach_mm]
    if len(loops) != 1:
        raise AnatomyError(
            f"The plane at ({_text(cut.centre)}) cuts the surface in {len(loops)} closed curves, expected one; "
            "move it along the vessel."
        )
    return loops[0]


def _largest(triangles: IntArray, label: IntArray) -> tuple[IntArray, IntArray]:
    n = int(triangles.max()) + 1
    graph = coo_matrix((np.ones(2 * len(triangles)), (triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel())), shape=(n, n))
    _, piece = connected_components(graph, directed=False)
    of_triangle = piece[triangles[:, 0]]
    keep = of_triangle == np.bincount(of_triangle).argmax()
    return triangles[keep], label[keep]


def _text(point: FloatArray) -> str:
    return ", ".join(f"{x:.1f}" for x in point)
