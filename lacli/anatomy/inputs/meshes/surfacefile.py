"""Surface files as other tools write them: their triangles, and the unit of their lengths."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.inputs.meshes import apart
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError, InputError

SUFFIXES = (".vtp", ".vtk", ".stl", ".ply", ".obj", ".vtu")
UNITS = {"mm": (1.0, "millimetres"), "um": (1e-3, "micrometres"), "m": (1e3, "metres"), "cm": (10.0, "centimetres")}


def read(path: Path) -> tuple[FloatArray, IntArray]:
    """Points (n, 3) and triangles (t, 3) of a surface file; other polygons are cut in triangles.

    Raises InputError where the file is missing, damaged, or holds no triangle.
    """
    return checked(path, apart.content(path, "surface"))


def checked(path: Path, found: dict[str, Any]) -> tuple[FloatArray, IntArray]:
    """Points and triangles of what was read apart. Raises InputError where there are none, or they do not fit together."""
    points, triangles = found["points"], found["triangles"]
    if len(triangles) == 0 or len(points) == 0:
        raise InputError(f"{path}: the file holds no triangles; it may be truncated, or hold points or lines only.")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise InputError(f"{path}: a triangle names a point that does not exist; export the file again.")
    return points, triangles


def unit_scale(points: FloatArray, unit: str | None = None) -> tuple[float, str]:
    """Factor to millimetres and a sentence about it: of the ``unit`` given (of UNITS), else from the size, an atrium with its
    veins being 4 - 25 cm wide.

    Raises AnatomyError where the size fits no unit, or not the one given.
    """
    width = float(np.ptp(points, axis=0).max())
    if unit is not None:
        factor, name = UNITS[unit]
        if not 25.0 <= width * factor <= 400.0:
            raise AnatomyError(
                f"the surface is {width:.4g} units wide: in {name} that is {width * factor:.4g} mm, no left atrium; "
                "leave --unit out, and it is told from the size."
            )
        return factor, "" if factor == 1.0 else f"lengths in {name}, as said, were scaled to mm"
    for factor, unit in UNITS.values():
        if 25.0 <= width * factor <= 400.0:
            words = "" if factor == 1.0 else f"the surface is {width:.4g} units wide: taken as {unit}, scaled to mm"
            return factor, words
    raise AnatomyError(f"the surface is {width:.4g} units wide, which is no left atrium in mm, micrometres, cm or m; rescale it.")
