"""Tetrahedra with named boundary surfaces (a four-chamber heart's left atrium) -> bundle."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy import laplace
from lacli.anatomy.bundle import ENDO, EPI, OPENINGS, OTHER, PLANES, RINGS, Bundle
from lacli.anatomy.caps import Plate, extrude_plate, rim_loops
from lacli.anatomy.cells import boundary_faces, elevate, row_keys, volumes
from lacli.anatomy.frame import frame_from_openings, height, sectors, sweep, two_layer_fibres
from lacli.anatomy.surface import FloatArray, IntArray, Surface, compact
from lacli.errors import AnatomyError

# opening -> words that all occur in its cap's name
CAP_WORDS: dict[str, tuple[str, ...]] = {
    "mv": ("mitral-valve-atrium",),
    "rspv": ("right", "superior", "vein"),
    "ripv": ("right", "inferior", "vein"),
    "lspv": ("left", "superior", "vein"),
    "lipv": ("left", "inferior", "vein"),
    "appendage": ("atrium-appendage",),
}


@dataclass(frozen=True)
class TaggedMesh:
    """points (n, 3) mm; tets (m, 4); endo (t, 3) point ids; caps: opening -> rim points (k, 3) mm; cavity: closed surface."""

    points: FloatArray
    tets: IntArray
    endo: IntArray
    caps: dict[str, FloatArray]
    cavity: Surface


def read_tagged(
    tets_file: Path,
    surfaces_file: Path,
    names_json: Path,
    cell_size_mm: float | None = None,
    order: int = 2,
    thickness_mm: float = 2.0,
    ring_width_mm: float = 2.5,
    chamber: str = "Left atrium",
) -> Bundle:
    """Read tetrahedra, their named surfaces and the names' ids into a bundle.

    ``cell_size_mm`` None keeps the tetrahedra as they are and adds the valve planes (each cap and the wall's cut face
    around it, extruded outward by ``thickness_mm``); a number remeshes the closed cavity surface to that edge
    length and builds a wall of ``thickness_mm`` round it. ``chamber`` is the prefix of its surfaces' names.
    Raises AnatomyError where a file, a name or a surface does not fit.
    """
    mesh = read_mesh(Path(tets_file), Path(surfaces_file), Path(names_json), chamber)
    if cell_size_mm is not None:
        from lacli.anatomy.shell import mesh_shell

        return mesh_shell(mesh.cavity, thickness_mm, cell_size_mm, order=order)
    return _as_is(mesh, order, thickness_mm, ring_width_mm, str(tets_file))


def read_mesh(tets_file: Path, surfaces_file: Path, names_json: Path, chamber: str) -> TaggedMesh:
    """Read the three files; surfaces are tied to the tetrahedra by position (their point numbering differs)."""
    import pyvista as pv

    for file in (tets_file, surfaces_file, names_json):
        if not file.is_file():
            raise AnatomyError(f"{file}: no such file.")
    try:
        volume = meshio.read(tets_file)
        surface = pv.read(surfaces_file)
        names = {int(k): str(v) for k, v in json.loads(names_json.read_text())["_surface_id_to_name"].items()}
    except Exception as error:  # readers raise all sorts of things on damaged files
        raise AnatomyError(f"{tets_file.parent}: the files cannot be read ({type(error).__name__}: {error}).") from error
    points = np.asarray(volume.points, dtype=np.float64)
    if "tetra" not in volume.cells_dict:
        raise AnatomyError(f"{tets_file}: there are no linear tetrahedra in it.")
    tets = np.asarray(volume.cells_dict["tetra"], dtype=np.int64)
    turned = volumes(points, tets) < 0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    faces = surface.faces.reshape(-1, 4)[:, 1:].astype(np.int64)
    surface_points = np.asarray(surface.points, dtype=np.float64)
    ids = np.asarray(surface.cell_data["surface_id"]).astype(np.int64)

    def named(words: tuple[str, ...], exact: bool = False) -> IntArray:
        present = [i for i in np.unique(ids) if i in names]
        if exact:
            hit = [i for i in present if names[i].lower() == words[0].lower()]
        else:
            hit = [i for i in present if all(w in names[i].lower() for w in words) and "_" not in names[i] and "border" not in names[i]]
        if len(hit) != 1:
            found = ", ".join(names[i] for i in present)
            raise AnatomyError(f"{surface_file_name}: wanted one surface named {' '.join(words)!r}, found {len(hit)} among: {found}.")
        return faces[ids == hit[0]]

    surface_file_name = surfaces_file.name
    distance, nearest = cKDTree(points).query(surface_points)
    endo = nearest[named((f"{chamber} endocardium",), exact=True)]
    if distance[np.unique(named((f"{chamber} endocardium",), exact=True))].max() > 1e-3:
        raise AnatomyError(f"{surfaces_file}: the endocardium's points are not points of {tets_file.name}; the files do not fit.")
    cavity_faces = named((f"{chamber} cavity",), exact=True)
    caps = {}
    label = np.zeros(len(cavity_faces), dtype=np.int64)
    size = len(surface_points)
    _, weld = cKDTree(surface_points).query(surface_points, distance_upper_bound=1e-3)
    cavity_keys = row_keys(weld[cavity_faces], size)
    for opening in OPENINGS:
        cap = named(CAP_WORDS[opening])
        caps[opening] = surface_points[np.unique(cap)]
        label[np.isin(cavity_keys, row_keys(weld[cap], size))] = PLANES[opening]
    cavity = compact(Surface(surface_points, weld[cavity_faces], label))
    if cavity.volume_ml() < 0:
        cavity = Surface(cavity.points, cavity.triangles[:, ::-1].copy(), cavity.label)
    return TaggedMesh(points, tets, endo, caps, cavity)


def _as_is(mesh: TaggedMesh, order: int, thickness: float, ring_width: float, where: str) -> Bundle:
    """The tetrahedra untouched, valve planes added."""
    points, tets = mesh.points, mesh.tets
    outside, _ = boundary_faces(tets)
    size = len(points)
    is_endo = np.isin(row_keys(outside, size), row_keys(mesh.endo, size))
    endo, rest = outside[is_endo], outside[~is_endo]
    loops = rim_loops(endo)
    if len(loops) != len(OPENINGS):
        raise AnatomyError(f"{where}: the endocardium has {len(loops)} openings, expected {len(OPENINGS)}.")
    centre = mesh.cavity.points.mean(axis=0)
    region = np.zeros(len(tets), dtype=np.int64)
    caps: list[tuple[IntArray, int]] = []
    middle = points[tets].mean(axis=1)
    best = {name: min(loops, key=lambda loop: cKDTree(mesh.caps[name]).query(points[loop])[0].mean()) for name in OPENINGS}
    ring_distance = np.full(len(tets), np.inf)
    for name in OPENINGS:
        plate: Plate = extrude_plate(points, best[name], rest, centre, thickness)
        points = np.vstack([points, plate.points])
        tets = np.vstack([tets, plate.tets])
        region = np.append(region, np.full(len(plate.tets), PLANES[name]))
        caps.append((plate.cap, PLANES[name]))
        near = cKDTree(mesh.points[np.union1d(plate.annulus, best[name])]).query(middle)[0]
        closer = (near < ring_width) & (near < ring_distance)
        region[: len(middle)][closer] = RINGS[name]
        ring_distance = np.minimum(ring_distance, near)
    openings = {name: points[best[name]].mean(axis=0) for name in OPENINGS}
    frame = frame_from_openings(centre, openings)
    body = region == 0
    region[body] = sectors(frame, points[tets[body]].mean(axis=1))
    triangles, owner = boundary_faces(tets)
    size = len(points)
    tags = np.where(region[owner] >= 21, OTHER, np.where(region[owner] >= 11, region[owner], EPI))
    keys = row_keys(triangles, size)
    tags[np.isin(keys, row_keys(endo, size))] = ENDO
    for cap, label in caps:
        tags[np.isin(keys, row_keys(cap, size))] = label
    return finish(points, tets, region, triangles, tags, frame, order, {"source": where})


def finish(
    points: FloatArray,
    tets: IntArray,
    region: IntArray,
    triangles: IntArray,
    tags: IntArray,
    frame: object,
    order: int,
    info: dict[str, object],
) -> Bundle:
    """Coordinates and fibres by the frame's rules, second order if asked, into a bundle."""
    from lacli.anatomy.frame import AtrialFrame

    assert isinstance(frame, AtrialFrame)
    grad = laplace.gradient(points, tets)
    inside = np.unique(triangles[(tags == ENDO) | (tags >= 21)])
    far = np.setdiff1d(np.unique(triangles[(tags == EPI) | (tags == OTHER) | ((tags >= 11) & (tags <= 16))]), inside)
    transmural = laplace.solve(laplace.stiffness(grad, len(points)), {0.0: inside, 1.0: far})
    depth = grad.of(transmural)
    normals = depth / np.maximum(np.linalg.norm(depth, axis=1, keepdims=True), 1e-12)
    fibre = two_layer_fibres(frame, normals, transmural[tets].mean(axis=1))
    if order == 2:
        edges_from = len(points)
        points, tets, triangles = elevate(points, tets, triangles)
        from lacli.anatomy.bundle import TET10_EDGES

        full = np.concatenate([transmural, np.zeros(len(points) - edges_from)])
        for i, (a, b) in enumerate(TET10_EDGES):
            full[tets[:, 4 + i]] = (transmural[tets[:, a]] + transmural[tets[:, b]]) / 2
        transmural = full
    return Bundle(
        points, tets, region, triangles, tags, fibre, transmural, sweep(frame, points), height(frame, points), dict(info)
    )
