"""Tetrahedra with named boundary surfaces (a four-chamber heart's left atrium) -> bundle."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.coordinates.describe import describe
from lacli.anatomy.coordinates.frame import frame_from_openings, height, sectors, sweep, two_layer_fibres, unit
from lacli.anatomy.cuts import closing
from lacli.anatomy.cuts.caps import Plate, extrude_plate, rim_loops, triangulate_loop
from lacli.anatomy.cuts.doubles import part_doubles
from lacli.anatomy.inputs.meshes import apart, surfacefile
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, EPI, OPENINGS, OTHER, PLANES, RINGS, is_plane, is_ring
from lacli.geometry import laplace
from lacli.geometry.surface import Surface, check, compact, nearest
from lacli.geometry.tetrahedra import boundary_faces, elevate, row_keys, volumes

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
    """points (n, 3) mm; tets (m, 4); endo (t, 3) point ids; rims: opening -> rim (k,) of point ids; cavity: closed surface."""

    points: FloatArray
    tets: IntArray
    endo: IntArray
    rims: dict[str, IntArray]
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
    rule: str = "laplace-dirichlet",
) -> Bundle:
    """Read tetrahedra, their named surfaces and the names' ids into a bundle.

    ``cell_size_mm`` None keeps the tetrahedra as they are and adds the valve planes (each cap and the wall's cut face
    around it, extruded outward by ``thickness_mm``); a number remeshes the closed cavity surface to that edge
    length and builds a wall of ``thickness_mm`` round it. ``chamber`` is the prefix of its surfaces' names. ``rule``: of
    coordinates.RULES, with regions by universal atrial coordinates, or "simple": both by the atrium's axes (see frame).
    Raises AnatomyError where a file, a name or a surface does not fit.
    """
    mesh = read_mesh(Path(tets_file), Path(surfaces_file), Path(names_json), chamber)
    if cell_size_mm is not None:
        from lacli.anatomy.wall.shell import mesh_shell

        bundle = mesh_shell(mesh.cavity, thickness_mm, cell_size_mm, order=order, ring_width_mm=ring_width_mm)
        bundle = replace(bundle, info={"source": str(tets_file), **bundle.info})
    else:
        bundle = _as_is(mesh, order, thickness_mm, ring_width_mm, str(tets_file))
    return bundle if rule == "simple" else describe(bundle, rule=rule).bundle


def read_mesh(tets_file: Path, surfaces_file: Path, names_json: Path, chamber: str) -> TaggedMesh:
    """Read the three files; surfaces are tied to the tetrahedra by position (their point numbering differs)."""
    names = _names(names_json)
    volume, surface = apart.content(tets_file, "surface"), apart.content(surfaces_file, "surface")
    points, tets = volume["grid_points"], volume["tets"]
    if not len(tets):
        raise AnatomyError(f"{tets_file}: there are no tetrahedra in it.")
    if not np.isfinite(points).all():
        raise AnatomyError(f"{tets_file}: a point is not finite (NaN or infinite).")
    turned = volumes(points, tets) < 0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    surface_points, faces = surfacefile.checked(surfaces_file, surface)
    ids = _surface_ids(surfaces_file, surface, len(faces))
    if not np.isfinite(surface_points).all():
        raise AnatomyError(f"{surfaces_file}: a point is not finite (NaN or infinite).")

    def named(words: tuple[str, ...], exact: bool = False) -> IntArray:
        present = [i for i in np.unique(ids) if i in names]
        if exact:
            hit = [i for i in present if names[i].lower() == words[0].lower()]
        else:
            hit = [
                i
                for i in present
                if all(w in names[i].lower() for w in words) and "_" not in names[i] and "border" not in names[i]
            ]
        if len(hit) != 1:
            found = ", ".join(names[i] for i in present)
            raise AnatomyError(
                f"{surfaces_file.name}: wanted one surface named {' '.join(words)!r}, found {len(hit)} among: {found}."
            )
        return faces[ids == hit[0]]

    distance, at = nearest(points, surface_points)
    endo = at[named((f"{chamber} endocardium",), exact=True)]
    if distance[np.unique(named((f"{chamber} endocardium",), exact=True))].max() > 1e-3:
        raise AnatomyError(f"{surfaces_file}: the endocardium's points are not points of {tets_file.name}; the files do not fit.")
    outside, _ = boundary_faces(tets)
    endo = outside[np.isin(row_keys(outside, len(points)), row_keys(endo, len(points)))]
    caps = {opening: surface_points[np.unique(named(CAP_WORDS[opening]))] for opening in OPENINGS}
    rims = _rims(endo, points, caps, str(surfaces_file))
    return TaggedMesh(points, tets, endo, rims, _closed(points, endo, rims))


def _names(file: Path) -> dict[int, str]:
    """Names of the surfaces by their number. Raises AnatomyError."""
    document = read_json(file, error=AnatomyError)
    table = document.get("_surface_id_to_name") if isinstance(document, dict) else None
    if not isinstance(table, dict) or not all(re.fullmatch(r"-?\d{1,9}", key) for key in table):
        raise AnatomyError(f"{file}: needs a table _surface_id_to_name of numbers and names.")
    return {int(key): str(value) for key, value in table.items()}


def _surface_ids(file: Path, surface: dict[str, Any], count: int) -> IntArray:
    """The number of each triangle's surface (t,). Raises AnatomyError."""
    places = np.flatnonzero(surface["cell_names"] == "surface_id")
    ids = surface[f"cell_{places[0]}"] if len(places) else None
    if ids is None or len(ids) != count or not np.isfinite(ids).all() or np.abs(ids).max() > 1e9:
        raise AnatomyError(f"{file}: needs triangles alone, and a cell array surface_id with a number for each.")
    return np.asarray(ids, np.int64)


def _rims(endo: IntArray, points: FloatArray, caps: dict[str, FloatArray], where: str) -> dict[str, IntArray]:
    """Each opening's rim (k,) of point ids: the endocardium's open loop that lies on its cap."""
    loops = rim_loops(endo)
    if len(loops) != len(caps):
        raise AnatomyError(f"{where}: the endocardium has {len(loops)} openings, expected {len(caps)} ({', '.join(caps)}).")
    apart = np.array([[nearest(cap, points[loop])[0].mean() for loop in loops] for cap in caps.values()])
    best = apart.argmin(axis=1)
    if len(set(best.tolist())) != len(loops):
        raise AnatomyError(f"{where}: two of the caps lie on the same opening of the endocardium.")
    return {name: loops[k] for name, k in zip(caps, best, strict=True)}


def _closed(points: FloatArray, endo: IntArray, rims: dict[str, IntArray]) -> Surface:
    """The endocardium, turned outward, and a smooth triangulation over each rim (the files' own caps are fans)."""
    points = closing.even_all(points, endo, list(rims.values()))
    centre = points[np.unique(endo)].mean(axis=0)
    triangles, label = [endo[:, ::-1]], [np.zeros(len(endo), dtype=np.int64)]
    everything = points
    for name, rim in rims.items():
        ring = points[rim]
        # the endocardium's triangles look into the cavity, so its rim runs clockwise seen from outside
        normal = unit(np.cross(ring - ring.mean(axis=0), np.roll(ring, -1, axis=0) - ring.mean(axis=0)).sum(axis=0))
        outward = normal if normal @ (ring.mean(axis=0) - centre) > 0 else -normal
        inner, cap = triangulate_loop(everything, rim, outward)
        everything = np.vstack([everything, inner])
        middle, cap, stays = part_doubles(everything, cap, triangles[0], outward)
        everything = np.vstack([everything, middle])
        triangles[0], label[0] = triangles[0][stays], label[0][stays]
        triangles.append(cap)
        label.append(np.full(len(cap), PLANES[name]))
    surface = compact(Surface(everything, np.vstack(triangles), np.concatenate(label)))
    check(surface, "cavity of the named surfaces")
    return surface


def _as_is(mesh: TaggedMesh, order: int, thickness: float, ring_width: float, where: str) -> Bundle:
    """The tetrahedra untouched, valve planes added."""
    points, tets = mesh.points, mesh.tets
    outside, _ = boundary_faces(tets)
    size = len(points)
    is_endo = np.isin(row_keys(outside, size), row_keys(mesh.endo, size))
    endo, rest = outside[is_endo], outside[~is_endo]
    centre = mesh.cavity.points.mean(axis=0)
    region = np.zeros(len(tets), dtype=np.int64)
    caps: list[tuple[IntArray, int]] = []
    middle = points[tets].mean(axis=1)
    ring_distance = np.full(len(tets), np.inf)
    for name in OPENINGS:
        plate: Plate = extrude_plate(points, mesh.rims[name], rest, centre, thickness)
        points = np.vstack([points, plate.points])
        tets = np.vstack([tets, plate.tets])
        region = np.append(region, np.full(len(plate.tets), PLANES[name]))
        caps.append((plate.cap, PLANES[name]))
        # across the cut face, or from its inner edge through the wall's thickness
        near = nearest(mesh.points[np.union1d(plate.annulus, mesh.rims[name])], middle)[0]
        near = np.minimum(near, nearest(mesh.points[mesh.rims[name]], middle)[0] - 0.5 * thickness)
        closer = (near < ring_width) & (near < ring_distance)
        region[: len(middle)][closer] = RINGS[name]
        ring_distance = np.minimum(ring_distance, near)
    openings = {name: points[mesh.rims[name]].mean(axis=0) for name in OPENINGS}
    frame = frame_from_openings(centre, openings)
    body = region == 0
    region[body] = sectors(frame, points[tets[body]].mean(axis=1))
    triangles, owner = boundary_faces(tets)
    size = len(points)
    tags = np.where(is_plane(region[owner]), OTHER, np.where(is_ring(region[owner]), region[owner], EPI))
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
    from lacli.anatomy.coordinates.frame import AtrialFrame

    assert isinstance(frame, AtrialFrame)
    grad = laplace.gradient(points, tets)
    inside = np.unique(triangles[(tags == ENDO) | is_plane(tags)])
    far = np.setdiff1d(np.unique(triangles[(tags == EPI) | (tags == OTHER) | is_ring(tags)]), inside)
    transmural = laplace.solve(laplace.stiffness(grad, len(points)), {0.0: inside, 1.0: far})
    depth = grad.of(transmural)
    normals = depth / np.maximum(np.linalg.norm(depth, axis=1, keepdims=True), 1e-12)
    fibre = two_layer_fibres(frame, normals, transmural[tets].mean(axis=1))
    if order == 2:
        edges_from = len(points)
        points, tets, triangles = elevate(points, tets, triangles)
        from lacli.geometry.tetrahedra import TET10_EDGES

        full = np.concatenate([transmural, np.zeros(len(points) - edges_from)])
        for i, (a, b) in enumerate(TET10_EDGES):
            full[tets[:, 4 + i]] = (transmural[tets[:, a]] + transmural[tets[:, b]]) / 2
        transmural = full
    return Bundle(
        points, tets, region, triangles, tags, fibre, transmural, sweep(frame, points), height(frame, points), dict(info)
    )
