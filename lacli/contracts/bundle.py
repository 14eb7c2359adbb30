"""The anatomy bundle: a folder with the wall mesh, its tagged boundary and a description. All lengths in mm."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from lacli.base import vtkxml
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError
from lacli.base.quiet import quiet, reason
from lacli.contracts.labels import ENDO, EPI, OTHER, PLANES, REGIONS, RINGS, is_plane
from lacli.geometry.quadrature import enclosed_volume_ml
from lacli.geometry.tetrahedra import TET10_EDGES, boundary_faces, curved_jacobian
from lacli.geometry.tetrahedra import volumes as cell_volumes

LEAST_CAVITY_ML, MOST_CAVITY_ML = 0.9, 1500.0
FURTHEST_MM = 1e5
SAME_POINT_MM = 0.01


@dataclass(frozen=True)
class Bundle:
    """An anatomy as the simulation takes it.

    points (n, 3) mm; tets (m, 4) or (m, 10), VTK order; region (m,) of REGIONS, RINGS, PLANES;
    fibre (m, 3) unit vectors or None; transmural (n,), uac (n, 2), pericardium_coordinate (n,) or None.
    triangles (t, 3) or (t, 6): the boundary, point ids of ``points``, normals out of the wall's material;
    tags (t,): ENDO (wall and rings, cavity side), EPI, OTHER, RINGS (the rings' outer faces), PLANES (the valve
    planes' cavity side; their far side is OTHER). ENDO and PLANES together are one closed surface, the cavity's.
    """

    points: FloatArray
    tets: IntArray
    region: IntArray
    triangles: IntArray
    tags: IntArray
    fibre: FloatArray | None = None
    transmural: FloatArray | None = None
    uac: FloatArray | None = None
    pericardium_coordinate: FloatArray | None = None
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def order(self) -> int:
        """1 for straight cells, 2 for 10-node cells."""
        return 1 if self.tets.shape[1] == 4 else 2

    def cavity_triangles(self) -> IntArray:
        """Triangles of the closed cavity surface (endocardium and valve planes)."""
        keep = (self.tags == ENDO) | is_plane(self.tags)
        return self.triangles[keep]

    def cavity_volume_ml(self) -> float:
        """Volume enclosed by the endocardium and the valve planes, curved faces included, mL."""
        # normals point out of the wall's material, so into the cavity: the sign turns
        return -enclosed_volume_ml(self.cavity_triangles(), self.points)

    def wall_volume_ml(self) -> float:
        """Volume of the wall and its rings, without the valve planes, curved faces included, mL."""
        wall = self.tets[~is_plane(self.region)]
        corners, _ = boundary_faces(wall)
        return enclosed_volume_ml(corners if self.order == 1 else _with_middles(corners, wall), self.points)


def save(bundle: Bundle, folder: Path) -> None:
    """Write ``wall.vtu``, ``boundary.vtp`` and ``anatomy.json`` into ``folder`` (made if absent)."""
    import pyvista as pv

    folder.mkdir(parents=True, exist_ok=True)
    point_data = {
        name: value for name in ("transmural", "uac", "pericardium_coordinate") if (value := getattr(bundle, name)) is not None
    }
    cell_data: dict[str, list[Any]] = {"region": [bundle.region.astype(np.int32)]}
    if bundle.fibre is not None:
        cell_data["fibre"] = [bundle.fibre]
    kind = "tetra" if bundle.order == 1 else "tetra10"
    meshio.Mesh(bundle.points, [(kind, bundle.tets)], point_data=point_data, cell_data=cell_data).write(
        folder / "wall.vtu", binary=True, compression="zlib"
    )
    used, local = np.unique(bundle.triangles[:, :3], return_inverse=True)
    faces = np.column_stack([np.full(len(local.reshape(-1, 3)), 3), local.reshape(-1, 3)])
    surface = pv.PolyData(bundle.points[used], faces.ravel())
    surface.point_data["wall_point"] = used.astype(np.int64)
    surface.cell_data["tag"] = bundle.tags.astype(np.int32)
    surface.save(folder / "boundary.vtp")
    (folder / "anatomy.json").write_text(json.dumps(bundle.info, indent=2) + "\n")


def load(folder: Path) -> Bundle:
    """Read and check a bundle.

    Raises AnatomyError where a file is missing or damaged, a coordinate is not finite, a cell is inverted,
    the wall is not connected, or the cavity surface is open.
    """
    import pyvista as pv

    wall_file, boundary_file, info_file = (folder / n for n in ("wall.vtu", "boundary.vtp", "anatomy.json"))
    for file in (wall_file, boundary_file, info_file):
        if not file.is_file():
            raise AnatomyError(
                f"{folder}: not an anatomy bundle, {file.name} is missing. `lacli synthesize` or `lacli mesh` writes one."
            )
    info = read_json(info_file, error=AnatomyError)
    if not isinstance(info, dict):
        raise AnatomyError(f"{info_file}: the bundle cannot be read, it must hold a table of names and values. Write it again.")
    for file in (wall_file, boundary_file):
        try:
            vtkxml.check(file)
        except (vtkxml.UnfitError, OSError) as error:
            raise AnatomyError(
                f"{folder}: the bundle cannot be read, {file.name} is damaged ({error}). Write it again."
            ) from None
    try:
        with quiet(meshio=True):
            wall = meshio.vtu.read(wall_file)  # meshio.read ends the whole program on a damaged file
            boundary = pv.read(boundary_file)
    except (Exception, SystemExit) as error:  # readers raise all sorts of things on damaged files
        raise AnatomyError(
            f"{folder}: the bundle cannot be read, a file is damaged ({reason(error)}). Write it again."
        ) from error
    try:
        with quiet():
            bundle = _assemble(wall, boundary, wall_file, boundary_file, info)
    except (ValueError, TypeError, IndexError, OverflowError) as error:  # arrays of other shapes or types than ours
        raise AnatomyError(
            f"{folder}: the bundle cannot be read, an array is damaged ({reason(error)}). Write it again."
        ) from error
    check(bundle, str(folder))
    return bundle


def _assemble(wall: meshio.Mesh, boundary: Any, wall_file: Path, boundary_file: Path, info: dict[str, Any]) -> Bundle:
    kinds = [b.type for b in wall.cells]
    if len(kinds) != 1 or kinds[0] not in ("tetra", "tetra10"):
        raise AnatomyError(f"{wall_file}: expected one block of tetra or tetra10 cells, found {kinds}.")
    tets = np.asarray(wall.cells[0].data, dtype=np.int64)
    points = np.asarray(wall.points, dtype=np.float64)
    if "region" not in wall.cell_data:
        raise AnatomyError(f"{wall_file}: the cell array 'region' is missing; write 1 everywhere if there is one region.")
    region = np.asarray(wall.cell_data["region"][0], dtype=np.int64).ravel()
    fibre = wall.cell_data["fibre"][0] if "fibre" in wall.cell_data else None
    if tets.size == 0 or tets.min() < 0 or tets.max() >= len(points):
        raise AnatomyError(f"{wall_file}: a cell names a point that does not exist, or there is none. Write the bundle again.")
    corners, tags = _read_boundary(boundary, boundary_file, points)
    triangles = corners if tets.shape[1] == 4 else _with_middles(corners, tets)
    return Bundle(
        points=points,
        tets=tets,
        region=region,
        triangles=triangles,
        tags=tags,
        fibre=None if fibre is None else np.asarray(fibre, dtype=np.float64),
        transmural=_optional(wall, "transmural"),
        uac=_optional(wall, "uac"),
        pericardium_coordinate=_optional(wall, "pericardium_coordinate"),
        info=info,
    )


def _read_boundary(surface: Any, file: Path, points: FloatArray) -> tuple[IntArray, IntArray]:
    """Corner point ids (t, 3) and tags (t,) of ``boundary.vtp``."""
    for data, name in ((surface.point_data, "wall_point"), (surface.cell_data, "tag")):
        if name not in data:
            raise AnatomyError(f"{file}: the array {name!r} is missing. Write the bundle again.")
    if not surface.n_cells or not surface.is_all_triangles:
        raise AnatomyError(f"{file}: expected triangles only, and at least one.")
    given = np.asarray(surface.point_data["wall_point"])
    ids = given.astype(np.int64)
    if ids.shape != (surface.n_points,) or np.any(ids != given) or ids.min() < 0 or ids.max() >= len(points):
        raise AnatomyError(f"{file}: 'wall_point' names a point that wall.vtu does not have.")
    faces = surface.faces.reshape(-1, 4)[:, 1:]
    if faces.min() < 0 or faces.max() >= len(ids):
        raise AnatomyError(f"{file}: a triangle names a point that does not exist. Write the bundle again.")
    apart = np.linalg.norm(np.asarray(surface.points, dtype=np.float64) - points[ids], axis=1)
    if not np.all(apart <= SAME_POINT_MM):  # NaN too; single precision at some decimetres from the origin is 3e-5 mm
        worst = int(np.argmax(np.where(np.isfinite(apart), apart, np.inf)))
        raise AnatomyError(
            f"{file}: point {worst} lies {apart[worst]:.3g} mm from its point {ids[worst]} of wall.vtu; "
            f"{int((~(apart <= SAME_POINT_MM)).sum())} points differ. One of the files is damaged or of another bundle."
        )
    return ids[faces], np.asarray(surface.cell_data["tag"], dtype=np.int64)


def as_order(bundle: Bundle, order: int) -> Bundle:
    """The bundle with cells of that order: edge middles dropped for 1. Raises AnatomyError where they would be needed."""
    if order == bundle.order:
        return bundle
    if order == 2:
        raise AnatomyError("numerics.order is 2 but the bundle has 4-node cells: set numerics.order to 1, or mesh with order 2.")
    used, local = np.unique(bundle.tets[:, :4], return_inverse=True)
    new = np.full(len(bundle.points), -1, dtype=np.int64)
    new[used] = np.arange(len(used))

    def pick(values: FloatArray | None) -> FloatArray | None:
        return None if values is None else values[used]

    return Bundle(
        points=bundle.points[used],
        tets=local.reshape(-1, 4),
        region=bundle.region,
        triangles=new[bundle.triangles[:, :3]],
        tags=bundle.tags,
        fibre=bundle.fibre,
        transmural=pick(bundle.transmural),
        uac=pick(bundle.uac),
        pericardium_coordinate=pick(bundle.pericardium_coordinate),
        info=bundle.info,
    )


def _optional(mesh: meshio.Mesh, name: str) -> FloatArray | None:
    return np.asarray(mesh.point_data[name], dtype=np.float64) if name in mesh.point_data else None


def _with_middles(corners: IntArray, tets: IntArray) -> IntArray:
    """(t, 3) corner triangles -> (t, 6) with the mid-edge nodes of the 10-node cells that carry those edges."""
    pairs = np.concatenate([np.sort(tets[:, list(e)], axis=1) for e in TET10_EDGES])
    middles = np.concatenate([tets[:, 4 + i] for i in range(6)])
    size = int(tets.max()) + 1
    keys = pairs[:, 0] * size + pairs[:, 1]
    keys, first = np.unique(keys, return_index=True)
    middles = middles[first]
    columns = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = np.sort(corners[:, [i, j]], axis=1)
        wanted = edge[:, 0] * size + edge[:, 1]
        at = np.searchsorted(keys, wanted)
        if np.any(at >= len(keys)) or np.any(keys[np.minimum(at, len(keys) - 1)] != wanted):
            raise AnatomyError("boundary.vtp: a triangle is not a face of the wall's cells (wall_point does not fit wall.vtu).")
        columns.append(middles[at])
    return np.column_stack([corners, *columns])


def check(bundle: Bundle, where: str) -> None:
    """Raise AnatomyError where the bundle breaks its contract; ``where`` starts the message."""
    if not np.isfinite(bundle.points).all():
        bad = int(np.flatnonzero(~np.isfinite(bundle.points).all(axis=1))[0])
        raise AnatomyError(f"{where}: point {bad} of the wall has a coordinate that is not finite (NaN or infinite).")
    if np.abs(bundle.points).max(initial=0.0) > FURTHEST_MM:
        furthest = np.abs(bundle.points).max()
        raise AnatomyError(f"{where}: a point of the wall lies at {furthest:.3g} mm, further away than a heart can be.")
    if bundle.tets.min() < 0 or bundle.tets.max() >= len(bundle.points):
        raise AnatomyError(f"{where}: a cell names a point that does not exist.")
    volume = cell_volumes(bundle.points, bundle.tets)
    if np.any(volume <= 0):
        bad = int(np.argmin(volume))
        raise AnatomyError(
            f"{where}: {int((volume <= 0).sum())} inverted or flat cells, the worst is {bad} ({volume[bad]:.3g} mm3). Mesh again."
        )
    bent = curved_jacobian(bundle.points, bundle.tets)
    if np.any(bent <= 0):
        bad = int(np.argmin(bent))
        raise AnatomyError(
            f"{where}: {int((bent <= 0).sum())} curved cells are folded by the nodes on their edges, the worst is {bad} "
            f"(its Jacobian falls to {bent[bad]:.3g} of the mean). Mesh again, or move those nodes to the edges' middles."
        )
    if len(bundle.region) != len(bundle.tets) or len(bundle.tags) != len(bundle.triangles):
        raise AnatomyError(f"{where}: 'region' or 'tag' does not have one value per cell.")
    allowed = {*REGIONS.values(), *RINGS.values(), *PLANES.values()}
    unknown = sorted(set(np.unique(bundle.region).tolist()) - allowed)
    if unknown:
        raise AnatomyError(f"{where}: unknown region {unknown[0]}; the known ones are {sorted(allowed)}.")
    if bundle.fibre is not None:
        if bundle.fibre.shape != (len(bundle.tets), 3):
            raise AnatomyError(f"{where}: 'fibre' needs three components for each cell, its shape is {bundle.fibre.shape}.")
        norm = np.linalg.norm(bundle.fibre, axis=1)
        if not np.isfinite(norm).all() or np.any(np.abs(norm - 1) > 1e-3):
            raise AnatomyError(f"{where}: fibres must be finite unit vectors, one per cell.")
    tags = {ENDO, EPI, OTHER, *RINGS.values(), *PLANES.values()}
    unknown = sorted(set(np.unique(bundle.tags).tolist()) - tags)
    if unknown:
        raise AnatomyError(f"{where}: unknown tag {unknown[0]} on the boundary; the known ones are {sorted(tags)}.")
    for name in ("transmural", "uac", "pericardium_coordinate"):
        value = getattr(bundle, name)
        shape = (len(bundle.points), 2) if name == "uac" else (len(bundle.points),)
        if value is not None and (value.shape != shape or not np.isfinite(value).all()):
            raise AnatomyError(f"{where}: '{name}' needs one finite value for every point of the wall.")
    diameter = float(np.ptp(bundle.points, axis=0).max())
    if diameter > 1000:
        raise AnatomyError(f"{where}: the wall is {diameter:.0f} mm wide; are the lengths micrometres? The bundle is in mm.")
    if diameter < 1:
        raise AnatomyError(f"{where}: the wall is {diameter:.3g} mm wide; are the lengths metres? The bundle is in mm.")
    _check_connected(bundle, where)
    _check_cavity(bundle, where, diameter)


def _check_cavity(bundle: Bundle, where: str, diameter: float) -> None:
    """The closed cavity's volume is an atrium's; centimetres and decimetres are told by it."""
    volume = bundle.cavity_volume_ml()
    if LEAST_CAVITY_ML <= volume <= MOST_CAVITY_ML:
        return
    if volume <= 0:
        raise AnatomyError(f"{where}: the cavity's volume is {volume:.3g} mL; its boundary is turned inside out.")
    units = (("metres", 1e3), ("decimetres", 100.0), ("inches", 25.4), ("centimetres", 10.0), ("micrometres", 1e-3))
    fitting = [unit for unit, factor in units if 20.0 <= volume * factor**3 <= 600.0]
    meant = f"are the lengths {' or '.join(fitting)}? The bundle is in mm" if fitting else "that is no left atrium in mm"
    raise AnatomyError(f"{where}: the cavity has {volume:.3g} mL and the wall is {diameter:.3g} mm wide; {meant}.")


def _check_connected(bundle: Bundle, where: str) -> None:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(bundle.points)
    rows = np.repeat(bundle.tets[:, 0], bundle.tets.shape[1] - 1)
    graph = coo_matrix((np.ones(len(rows)), (rows, bundle.tets[:, 1:].ravel())), shape=(n, n))
    count, labels = connected_components(graph, directed=False)
    pieces = len(np.unique(labels[bundle.tets[:, 0]]))
    if pieces > 1:
        raise AnatomyError(f"{where}: the wall falls into {pieces} unconnected pieces; keep one.")
    if count > pieces:
        raise AnatomyError(f"{where}: {count - pieces} points belong to no cell; remove them.")
    _check_boundary(bundle, where)
    _check_closed(bundle, where)


def _oriented(triangles: IntArray) -> IntArray:
    """Rows turned so that the smallest point comes first; the sense of rotation stays."""
    first = np.argmin(triangles, axis=1)
    return np.take_along_axis(triangles, (first[:, None] + np.arange(3)) % 3, axis=1)


def _check_boundary(bundle: Bundle, where: str) -> None:
    """The triangles are the faces that one cell only has, each once, seen from outside the material."""
    n = len(bundle.points)
    cells = bundle.tets[:, :4]
    faces = np.concatenate([cells[:, list(f)] for f in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))])
    key = np.sort(faces, axis=1) @ np.array([n * n, n, 1])
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    if count.max() > 2:
        raise AnatomyError(f"{where}: {int((count > 2).sum())} faces belong to three or more cells; cells overlap. Mesh again.")
    weights = np.array([n * n, n, 1])
    outer = _oriented(faces[first[count == 1]]) @ weights
    given = _oriented(bundle.triangles[:, :3]) @ weights
    strangers = np.flatnonzero(~np.isin(given, outer))
    if len(strangers):
        raise AnatomyError(
            f"{where}: {len(strangers)} boundary triangles (first {strangers[0]}) are no outer faces of the wall, or turned."
        )
    if len(np.unique(given)) != len(given):
        raise AnatomyError(f"{where}: a boundary triangle is there twice.")
    if len(given) != len(outer):
        raise AnatomyError(f"{where}: {len(outer) - len(given)} outer faces of the wall have no boundary triangle, so no tag.")


def _check_closed(bundle: Bundle, where: str) -> None:
    """Every edge of the cavity surface is run through in both directions equally often."""
    triangles = bundle.cavity_triangles()[:, :3]
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    n = len(bundle.points)
    forward, backward = edges @ np.array([n, 1]), edges @ np.array([1, n])
    loose = np.flatnonzero(~np.isin(forward, backward))
    if len(loose):
        x, y, z = bundle.points[edges[loose[0], 0]]
        raise AnatomyError(
            f"{where}: the cavity surface (tags {ENDO} and 21-26) is open along {len(loose)} edges, one of them at "
            f"({x:.1f}, {y:.1f}, {z:.1f}) mm; a valve plane or a tag is missing."
        )
