"""The numbers that mean something: regions, rings and valve planes of an atrium, sides of its wall."""

from __future__ import annotations

REGIONS: dict[str, int] = {"anterior": 1, "posterior": 2, "septum": 3, "lateral": 4, "roof": 5}
OPENINGS: tuple[str, ...] = ("mv", "rspv", "ripv", "lspv", "lipv", "appendage")
RINGS: dict[str, int] = {name: 11 + i for i, name in enumerate(OPENINGS)}
PLANES: dict[str, int] = {name: 21 + i for i, name in enumerate(OPENINGS)}
ENDO, EPI, OTHER = 1, 2, 3
BODY_REGIONS: tuple[str, ...] = tuple(REGIONS)


def plane_of(label: int) -> str:
    """Name of the opening whose plane has this label."""
    return next(name for name, value in PLANES.items() if value == label)
