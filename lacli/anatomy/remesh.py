"""Isotropic remeshing of a labelled surface."""

from __future__ import annotations

from lacli.anatomy.surface import Surface


def remesh(surface: Surface, size_mm: float) -> Surface:
    """Isotropic triangles of edge length ``size_mm`` (mm) on the same surface; label borders are kept as curves."""
    raise NotImplementedError
