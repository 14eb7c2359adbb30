"""Whatever mesh there is of an atrium - surface, shells, tagged triangles, tetrahedra - as points, triangles and tags."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.inputs import carp, solid, surfacefile
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
    grid = _tetrahedra(path)
    if grid is not None:
        return _wall(*grid)
    points, triangles = surfacefile.read(path)
    return Mesh(points, triangles, _tags(path, len(triangles)))


def _wall(points: FloatArray, tets: IntArray, tag: IntArray) -> Mesh:
    scale, _ = surfacefile.unit_scale(points[np.unique(tets)])
    triangles, tags, outer = solid.shells(points * scale, tets, tag)
    words = f"{len(tets)} tetrahedra: their inner and outer sides are taken, and the wall between them meshed anew"
    return Mesh(points, triangles, tags, (words,), outer)


def _open(path: Path) -> Any:
    """The data set, None where it cannot be read (the surface reader says why)."""
    import pyvista as pv
    import vtk

    vtk.vtkObject.GlobalWarningDisplayOff()
    verbosity = vtk.vtkLogger.GetCurrentVerbosityCutoff()
    vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)
    try:
        return pv.read(path)
    except Exception:  # readers raise all sorts of things on damaged files
        return None
    finally:
        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.ConvertToVerbosity(verbosity))


def _tetrahedra(path: Path) -> tuple[FloatArray, IntArray, IntArray] | None:
    if path.suffix.lower() not in (".vtk", ".vtu") or not path.is_file():
        return None
    data = _open(path)
    cells = getattr(data, "cells_dict", None)
    if not cells:
        return None
    kinds = {10: 4, 24: 10}  # VTK_TETRA, VTK_QUADRATIC_TETRA
    found = [k for k in kinds if k in cells]
    if not found:
        return None
    kind = found[0]
    tets = np.asarray(cells[kind], dtype=np.int64)[:, :4]
    mine = np.asarray(data.celltypes) == kind
    tag = _array(data)
    points = np.asarray(data.points, dtype=np.float64)
    if not np.isfinite(points[np.unique(tets)]).all():
        raise InputError(f"{path}: a point has a coordinate that is not finite; export the file again.")
    return points, tets, np.zeros(len(tets), dtype=np.int64) if tag is None else tag[mine]


def _tags(path: Path, count: int) -> IntArray | None:
    data = _open(path) if path.suffix.lower() in (".vtk", ".vtp", ".vtu", ".ply") else None
    tag = None if data is None else _array(data)
    return tag if tag is not None and len(tag) == count else None


def _array(data: Any) -> IntArray | None:
    for name in data.cell_data:
        values = np.asarray(data.cell_data[name])
        if name.lower() in TAG_NAMES and values.ndim == 1 and np.isfinite(values).all() and (values == np.round(values)).all():
            return values.astype(np.int64)
    return None
