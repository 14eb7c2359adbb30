"""The numbers that mean something: regions, rings and valve planes of an atrium, sides of its wall.

Cells and faces bear one number each. ``is_body``, ``is_ring`` and ``is_plane`` say of arrays of them what they are.
"""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import BoolArray, IntArray

REGIONS: dict[str, int] = {"anterior": 1, "posterior": 2, "septum": 3, "lateral": 4, "roof": 5}
OPENINGS: tuple[str, ...] = ("mv", "rspv", "ripv", "lspv", "lipv", "appendage")
RINGS: dict[str, int] = {name: 11 + i for i, name in enumerate(OPENINGS)}
PLANES: dict[str, int] = {name: 21 + i for i, name in enumerate(OPENINGS)}
ENDO, EPI, OTHER = 1, 2, 3
BODY_REGIONS: tuple[str, ...] = tuple(REGIONS)
# Okabe and Ito's palette: told apart by colour-blind readers, and in this order by their grey value too
REGION_COLOURS: dict[str, str] = {
    "anterior": "#0072B2",
    "posterior": "#D55E00",
    "septum": "#009E73",
    "lateral": "#CC79A7",
    "roof": "#E69F00",
}
RING_COLOUR, PLANE_COLOUR = "#8C8C8C", "#E4E4E4"


def is_body(label: IntArray) -> BoolArray:
    """Where a region's number is one of the atrial body's five."""
    return np.isin(label, list(REGIONS.values()))


def is_ring(label: IntArray) -> BoolArray:
    """Where a number is a ring's, the strip of wall along an opening."""
    return np.isin(label, list(RINGS.values()))


def is_plane(label: IntArray) -> BoolArray:
    """Where a number is a valve plane's, which closes an opening."""
    return np.isin(label, list(PLANES.values()))


def is_wall(label: IntArray) -> BoolArray:
    """Where a region's number is the wall's: body or ring."""
    return is_body(label) | is_ring(label)


def ring_beside(plane: IntArray) -> IntArray:
    """The number of the ring around each valve plane."""
    known, rings = np.array(list(PLANES.values())), np.array(list(RINGS.values()))
    return rings[np.searchsorted(known, plane)]


def plane_of(label: int) -> str:
    """Name of the opening whose plane has this label."""
    return next(name for name, value in PLANES.items() if value == label)
