"""Whatever mesh there is of an atrium - surface, shells, tagged triangles, tetrahedra - as points, triangles and tags."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.inputs.meshes import apart, carp, solid, surfacefile
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import InputError

TAG_NAMES = ("elemtag", "tag", "tags", "label", "labels", "region", "regions", "elemtags", "id", "cellentityids")


@dataclass(frozen=True)
class Mesh:
    """points (n, 3) in the file's unit; triangles (t, 3); tag (t,), None where the file has none; what was done in words;
    outer (s, 3): triangles of the wall's outer side where known."""

    points: FloatArray
    triangles: IntArray
    tag: IntArray | None
    notes: tuple[str, ...] = ()
    outer: IntArray | None = None


def is_mesh(path: Path) -> bool:
    """Whether the name ends as a mesh file's does."""
    return path.name.removesuffix(".gz").endswith((".elem", ".pts")) or path.suffix.lower() in surfacefile.SUFFIXES


def read(path: Path) -> Mesh:
    """Read a surface or a wall. Raises InputError where it is missing, damaged, or has no triangles or tetrahedra."""
    if path.name.removesuffix(".gz").endswith((".elem", ".pts")):
        mesh = carp.read(path)
        points = mesh.points * 1000.0  # as in the file: what the unit is follows from the size
        if mesh.kind == "Tt":
            return _wall(points, mesh.cells, mesh.tag)
        return Mesh(points, mesh.cells, mesh.tag)
    found = apart.content(path, "surface")
    tag = _tag(found)
    if len(found["tets"]):
        return _wall(*_tetrahedra(path, found, tag))
    points, triangles = surfacefile.checked(path, found)
    return Mesh(points, triangles, tag if tag is not None and len(tag) == len(triangles) else None)


def _wall(points: FloatArray, tets: IntArray, tag: IntArray) -> Mesh:
    scale, _ = surfacefile.unit_scale(points[np.unique(tets)])
    triangles, tags, outer = solid.shells(points * scale, tets, tag)
    words = f"{len(tets)} tetrahedra: their inner and outer sides are taken, and the wall between them meshed anew"
    return Mesh(points, triangles, tags, (words,), outer)


def _tetrahedra(path: Path, found: dict[str, Any], tag: IntArray | None) -> tuple[FloatArray, IntArray, IntArray]:
    points, tets = found["grid_points"], found["tets"]
    if tets.min() < 0 or tets.max() >= len(points):
        raise InputError(f"{path}: a cell names a point that does not exist; export the file again.")
    if not np.isfinite(points[np.unique(tets)]).all():
        raise InputError(f"{path}: a point has a coordinate that is not finite; export the file again.")
    return points, tets, np.zeros(len(tets), dtype=np.int64) if tag is None else tag


def _tag(found: dict[str, Any]) -> IntArray | None:
    for i, name in enumerate(found["cell_names"].tolist()):
        values = found[f"cell_{i}"]
        if name.lower() in TAG_NAMES and np.isfinite(values).all() and (values == np.round(values)).all():
            return values.astype(np.int64)
    return None
