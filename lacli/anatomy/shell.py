"""The wall as a shell of tetrahedra around the closed cavity surface."""

from __future__ import annotations

from lacli.anatomy.bundle import Bundle
from lacli.anatomy.surface import FloatArray, Surface


def mesh_shell(
    cavity: Surface, thickness_mm: float | FloatArray, cell_size_mm: float, order: int = 2, outer: Surface | None = None
) -> Bundle:
    """Tetrahedra between ``cavity`` and its outward offset by ``thickness_mm`` (a number, or one per point of ``cavity``)."""
    raise NotImplementedError
