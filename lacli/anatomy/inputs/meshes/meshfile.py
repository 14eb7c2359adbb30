"""A bundle as one mesh file of other tools (CARP, VTK, VTU, Gmsh and meshio's formats), and fibres from such a file."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lacli.anatomy.inputs.meshes import apart, carp
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError, InputError, UsageError
from lacli.base.quiet import quiet
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, EPI, OTHER, PLANES, REGIONS, RINGS, is_body

# meshio writes these without a tetrahedron, or as pictures
_NO_CELLS = frozenset([".stl", ".ply", ".obj", ".off", ".svg", ".tikz", ".wkt", ".post", ".gz", ".hmf"])


def write(bundle: Bundle, path: Path) -> None:
    """Write the wall: ``path`` ends in .pts/.elem (CARP: micrometres, corners of the cells), or as meshio knows it.

    Raises AnatomyError where meshio cannot write the format.
    """
    if path.suffix in (".pts", ".elem", ".lon"):
        carp.write(carp.CarpMesh(bundle.points[_corners(bundle)], "Tt", _renumbered(bundle), bundle.region, bundle.fibre), path)
        return
    points = {n: v for n in ("transmural", "uac", "pericardium_coordinate") if (v := getattr(bundle, n)) is not None}
    cells: dict[str, list[Any]] = {"region": [bundle.region.astype(np.int32)]}
    if bundle.fibre is not None:
        cells["fibre"] = [bundle.fibre]
    kind = "tetra" if bundle.order == 1 else "tetra10"
    if path.suffix == ".vtk" and "uac" in points:
        # legacy VTK has scalars and 3-vectors only
        points["uac"] = np.column_stack([points["uac"], np.zeros(len(bundle.points))])
    temporary = path.with_name(f".part-{os.getpid()}-{path.name}")
    try:
        with quiet(meshio=True):
            if path.suffix == ".msh":
                meshio.gmsh.write(temporary, _gmsh(bundle), fmt_version="2.2", binary=True)
            else:
                meshio.write(temporary, meshio.Mesh(bundle.points, [(kind, bundle.tets)], point_data=points, cell_data=cells))
    except Exception as error:
        temporary.unlink(missing_ok=True)
        raise AnatomyError(f"{path}: meshio cannot write this format ({type(error).__name__}: {error}).") from None
    temporary.replace(path)


def _gmsh(bundle: Bundle) -> meshio.Mesh:
    """Cells and boundary with Gmsh's physical groups: regions (dimension 3) and tags (dimension 2) by number and name."""
    volume, face = ("tetra", "triangle") if bundle.order == 1 else ("tetra10", "triangle6")
    regions = {**REGIONS, **{f"ring_{n}": v for n, v in RINGS.items()}, **{f"plane_{n}": v for n, v in PLANES.items()}}
    sides = {"endocardium": ENDO, "epicardium": EPI, "other": OTHER}
    sides |= {f"surface_ring_{n}": v for n, v in RINGS.items()} | {f"surface_plane_{n}": v for n, v in PLANES.items()}
    names = {n: np.array([v, 3]) for n, v in regions.items() if np.any(bundle.region == v)}
    names |= {n: np.array([v, 2]) for n, v in sides.items() if np.any(bundle.tags == v)}
    groups = [bundle.region.astype(np.int32), bundle.tags.astype(np.int32)]
    points = {n: v for n in ("transmural", "pericardium_coordinate") if (v := getattr(bundle, n)) is not None}
    if bundle.uac is not None:
        points["uac"] = np.column_stack([bundle.uac, np.zeros(len(bundle.points))])
    data: dict[str, list[Any]] = {"gmsh:physical": groups, "gmsh:geometrical": groups}
    if bundle.fibre is not None:
        data["fibre"] = [bundle.fibre, np.zeros((len(bundle.triangles), 3))]
    return meshio.Mesh(bundle.points, [(volume, bundle.tets), (face, bundle.triangles)], points, data, field_data=names)


def check_surface(path: Path) -> None:
    """Raise InputError where a file that is given as a surface says at its beginning that it holds an image or a grid."""
    if path.suffix.lower() not in (".vtk", ".vtp", ".vtu", ".vti", ".vtr", ".vts") or not path.is_file():
        return
    with path.open("rb") as stream:
        head = stream.read(4096)
    found = re.search(rb"^\s*DATASET\s+(\w+)", head, re.M | re.I) or re.search(rb"<VTKFile[^>]*?type\s*=\s*[\"'](\w+)", head)
    kind = found[1].decode().upper().replace("_", "") if found else ""
    if kind in ("STRUCTUREDPOINTS", "IMAGEDATA"):
        raise InputError(
            f"{path}: the file holds an image (VTK {found[1].decode() if found else ''}), not a surface. "
            "A label map is read as NRRD, NIfTI or MetaImage: convert it."
        )
    if kind in ("RECTILINEARGRID", "STRUCTUREDGRID", "FIELD", "TABLE"):
        raise InputError(f"{path}: the file holds a {found[1].decode() if found else ''} of VTK, not a surface of triangles.")


def check_ending(path: Path) -> None:
    """Raises UsageError where ``write`` knows no format by this name's ending."""
    if path.suffix in _NO_CELLS or path.suffix not in (".pts", ".elem", ".lon", *meshio.extension_to_filetypes):
        raise UsageError(f"{path}: no format of tetrahedra has the ending '{path.suffix}'; use .pts (CARP), .vtk, .vtu or .msh.")


def _corners(bundle: Bundle) -> NDArray[np.int64]:
    return np.unique(bundle.tets[:, :4])


def _renumbered(bundle: Bundle) -> NDArray[np.int64]:
    place = np.full(len(bundle.points), -1, dtype=np.int64)
    corners = _corners(bundle)
    place[corners] = np.arange(len(corners))
    return place[bundle.tets[:, :4]]


def read_fibres(path: Path) -> tuple[FloatArray, FloatArray]:
    """Cell centres (m, 3) mm and unit fibres (m, 3) of a CARP mesh (.lon with its .pts and .elem) or a file with a cell array
    'fibre'.

    Raises InputError where there are none, or one is not finite or zero.
    """
    if path.name.removesuffix(".gz").endswith((".lon", ".pts", ".elem")):
        mesh = carp.read(path)
        if mesh.fibre is None:
            raise InputError(f"{path}: there is no .lon file beside the mesh.")
        centre, fibre = mesh.points[mesh.cells].mean(axis=1), mesh.fibre
    else:
        found = apart.content(path, "fibres")
        centre, fibre = found["centre"], found["fibre"]
    if not np.isfinite(centre).all() or np.abs(centre).max() > carp.FURTHEST_MM:
        raise InputError(f"{path}: a point of the mesh is not finite, or further away than a heart can be.")
    with quiet():
        size = np.linalg.norm(fibre, axis=1, keepdims=True)
    if not np.isfinite(size).all() or (size < 1e-6).any():
        raise InputError(f"{path}: {int((~np.isfinite(size) | (size < 1e-6)).sum())} fibres are zero or not finite.")
    return centre, fibre / size


def carry_fibres(bundle: Bundle, centre: FloatArray, fibre: FloatArray, reach_mm: float = 3.0) -> FloatArray:
    """The user's fibres on the bundle's cells: each takes its nearest one's.

    Raises AnatomyError where most cells find none within ``reach_mm``: the two meshes do not lie in one place.
    """
    query = cKDTree(centre).query(bundle.points[bundle.tets[:, :4]].mean(axis=1))
    distance, nearest = (np.asarray(values) for values in query)
    wall = is_body(bundle.region)
    if np.median(distance[wall]) > reach_mm:
        raise AnatomyError(
            f"the fibres' mesh lies {np.median(distance[wall]):.1f} mm away from the wall (median); "
            "it must be the same heart in the same frame."
        )
    return fibre[nearest]
