"""Cuts that end in one closed curve: at the plane that was found, else moved along the vessel, turned, or at a distance from
its tip along the wall."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from lacli.anatomy.cuts import clipping
from lacli.anatomy.cuts.closing import CAP, close
from lacli.anatomy.openings.candidate import place
from lacli.anatomy.openings.landmarks import Opening
from lacli.anatomy.openings.ostium import across
from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry import isolines as isoline
from lacli.geometry.surface import Surface, compact

ALONG_MM = (-1.0, -2.0, 1.5, -3.0, 3.0, -4.5, -6.0)  # negative: into the atrium
TURNS_DEG = (12.0, 24.0)
LEVELS_MM = (0.0, -1.0, 1.0, -2.0, 2.0, -3.0, 3.0, 4.5)
LEAST_REACH_MM = 6.0
KNOWN_TIP_MM = 5.0  # a point beyond nearer than that is no tip that was found
MOST_AREA = 2.0  # of the opening's own (1.4 of its diameter): a larger section is the body's
FEWEST = 8  # points of a rim


def cut(surface: Surface, opening: Opening, label: int, what: str) -> tuple[Surface, str]:
    """The surface without what lies past the opening, closed by a cap of ``label`` with one rim; and what had to be done
    otherwise than asked, in words ("" where the plane itself did).

    Raises AnatomyError, with the reason why the plane itself failed, where no way ends in one closed curve.
    """
    reason: AnatomyError | None = None
    before = _pieces(surface, label)
    wanted = (before[0] + 1, before[1] + 1)
    for centre, normal, words in _planes(opening):
        try:
            done = clipping.cut(surface, centre, normal, opening.beyond, label, what)
        except AnatomyError as error:
            reason = reason or error
            continue
        if _pieces(done, label) == wanted and _fits(surface, done, opening, label):
            return done, f"the {what} was cut {words}: its plane ends in no closed curve" if words else ""
    done_along = _along_wall(surface, opening, label, wanted)
    if done_along is not None:
        return done_along, f"the {what} was cut at a fixed distance from its tip along the wall: no plane ends in a closed curve"
    raise reason or AnatomyError(
        f"the {what} at {place(opening.centre)} cannot be cut in one closed curve; move its centre along the vessel, or turn its "
        "normal, in landmarks.toml (--landmarks)."
    )


def _planes(opening: Opening) -> Iterator[tuple[FloatArray, FloatArray, str]]:
    """Centre, normal and words of each plane to try, the asked one first."""
    yield opening.centre, opening.normal, ""
    for step in ALONG_MM:
        yield opening.centre + step * opening.normal, opening.normal, f"{abs(step):g} mm farther {'in' if step < 0 else 'out'}"
    first = across(opening.normal)
    second = np.cross(opening.normal, first)
    for degrees in TURNS_DEG:
        for step in (0.0, -2.0):
            for axis in (first, -first, second, -second):
                turned = np.cos(np.radians(degrees)) * opening.normal + np.sin(np.radians(degrees)) * axis
                yield opening.centre + step * opening.normal, turned, f"turned by {degrees:g} degrees"


def _pieces(surface: Surface, label: int) -> tuple[int, int]:
    """How many pieces the plane of ``label`` has, and how many rims of at least FEWEST points."""
    mine = surface.label == label
    count, _ = paths.triangle_components(surface.triangles, mine)
    return count, sum(len(rim) >= FEWEST for rim in paths.loops(paths.border_edges(surface.triangles, mine))) if count else 0


def _fits(before: Surface, surface: Surface, opening: Opening, label: int) -> bool:
    """Whether some of the plane lies about the opening's centre, the vessel's tip went, and the plane is of a like size: a
    plane may end in one closed curve somewhere else, or round the whole body."""
    mine = surface.label == label
    points = surface.points[np.unique(surface.triangles[mine])]
    reach = max(0.75 * opening.diameter_mm, LEAST_REACH_MM) + max(abs(step) for step in ALONG_MM)
    if np.linalg.norm(points - opening.centre, axis=1).min() > reach:
        return False
    tip = before.points[int(np.argmin(np.linalg.norm(before.points - opening.beyond, axis=1)))]
    if np.linalg.norm(opening.beyond - opening.centre) > KNOWN_TIP_MM and (surface.points == tip).all(axis=1).any():
        return False
    area = float(surface.areas()[mine].sum() - before.areas()[before.label == label].sum())
    return opening.diameter_mm <= 0 or area < MOST_AREA * np.pi * max(opening.diameter_mm, LEAST_REACH_MM) ** 2 / 4


def _along_wall(surface: Surface, opening: Opening, label: int, wanted: tuple[int, int]) -> Surface | None:
    """Cut where the distance from the vessel's tip along edges is that at the opening's plane; None where none is one curve."""
    edges, _, _ = paths.edge_table(surface.triangles)
    length = np.linalg.norm(surface.points[edges[:, 0]] - surface.points[edges[:, 1]], axis=1)
    n = len(surface.points)
    graph = coo_matrix((length, (edges[:, 0], edges[:, 1])), shape=(n, n)).tocsr()
    tip = int(np.argmin(np.linalg.norm(surface.points - opening.beyond, axis=1)))
    distance = np.asarray(dijkstra(graph, directed=False, indices=tip))
    height = (surface.points - opening.centre) @ opening.normal
    beside = np.linalg.norm(surface.points - opening.centre - height[:, None] * opening.normal, axis=1)
    near = (np.abs(height) < 1.5) & (beside < max(opening.diameter_mm, 6.0)) & np.isfinite(distance)
    if not near.any():
        return None
    middle = float(np.median(distance[near]))
    for step in LEVELS_MM:
        if middle + step <= 2.0:
            continue
        done = _at_level(surface, distance - (middle + step), label)
        if done is not None and _pieces(done, label) == wanted and done.area_mm2() > 0.5 * surface.area_mm2():
            return done
    return None


def _at_level(surface: Surface, value: FloatArray, label: int) -> Surface | None:
    """Without the part where ``value`` (n,) is negative, a cap of ``label`` in its place; None where it has not one rim."""
    value = np.where(np.isfinite(value), value, 1e3)
    movable: BoolArray = np.ones(len(surface.points), dtype=bool)
    movable[surface.triangles[surface.label != 0]] = False
    surface, value = isoline.snap(surface, value, movable)
    surface, value = isoline.split(surface, value)
    keep = value[surface.triangles].sum(axis=1) > 0
    if keep.all() or not keep.any():
        return None
    kept = compact(replace(surface, triangles=surface.triangles[keep], label=surface.label[keep]))
    rims = paths.loops(paths.open_edges(kept.triangles))
    if len(rims) != 1:
        return None
    points, triangles, labels = close(kept.points, kept.triangles, rims, kept.label)
    return compact(Surface(points, triangles, np.where(labels == CAP, label, labels)))
