"""A common trunk: its one opening parted by a carina, so that each of its two veins has an opening, a ring and a plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lacli.anatomy.cuts import closed_cut
from lacli.anatomy.openings.landmarks import Opening
from lacli.contracts.labels import PLANES
from lacli.geometry import isolines as isoline
from lacli.geometry.surface import Surface

CARINA_MM = 4.0  # width of the strip of wall between the two openings; both rings meet in it


def part(surface: Surface, one: Opening, two: Opening) -> Surface:
    """The surface with the trunk's plane as two, a strip of wall between them; cut first where it has no cap yet.

    ``one``, ``two``: the veins' openings, their centres on either side of the carina, their cut the same.
    """
    label = PLANES[one.name]
    if not one.cap:
        middle = (one.centre + two.centre) / 2
        surface, _ = closed_cut.cut(surface, replace(one, centre=middle), label, f"{one.name} and {two.name}".upper())
    elif one.cap:
        surface = Surface(surface.points, surface.triangles, np.where(surface.label == PLANES[two.name], label, surface.label))
    across = two.centre - one.centre
    across = across / np.linalg.norm(across)
    middle = (one.centre + two.centre) / 2
    width = min(CARINA_MM, 0.5 * float(np.linalg.norm(two.centre - one.centre)))
    for side, name in ((1.0, two.name), (-1.0, one.name)):
        mine = surface.label == label
        value = side * ((surface.points - middle) @ across) - 0.5 * width
        inner = np.ones(len(surface.points), dtype=bool)
        inner[surface.triangles[~mine]] = False
        surface, value = isoline.snap(surface, value, inner)
        surface, value = isoline.split(surface, value, _touching(surface, mine))
        past = (surface.label == label) & (value[surface.triangles].sum(axis=1) > 0)
        # a number of no opening until both sides are done: the vein that named the cut may be either
        surface = Surface(surface.points, surface.triangles, np.where(past, -PLANES[name], surface.label))
    rest = np.where(surface.label == label, 0, surface.label)
    return Surface(surface.points, surface.triangles, np.abs(rest))


def _touching(surface: Surface, member: np.ndarray) -> np.ndarray:
    """(e,) whether a triangle of an edge is a member (t,)."""
    from lacli.geometry.surface import unique_edges

    edges, of_triangle = unique_edges(surface.triangles)
    touching = np.zeros(len(edges), dtype=bool)
    touching[of_triangle[member].ravel()] = True
    return touching
