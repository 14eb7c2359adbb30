"""The wall as a shell of tetrahedra around the closed cavity surface: prisms along the offset direction, split conformally.

Cells may be longer than the wall is thick: the triangles of the remeshed cavity surface are extruded in one or more layers,
and each prism is cut into three tetrahedra. With 10-node cells the middles of the edges follow the smooth surface and its offset.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy.coordinates.frame import AtrialFrame, frame_from_openings, height, sectors, sweep, two_layer_fibres, unit
from lacli.anatomy.cuts.rims import RING_WIDTH_MM, label_rings
from lacli.anatomy.openings.candidate import place
from lacli.anatomy.remeshing.projection import Reference
from lacli.anatomy.remeshing.remesh import keep_volume, remesh_on
from lacli.anatomy.wall.offset import Offset, offset_surface
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, EPI, OPENINGS, OTHER, PLANES, REGIONS, is_plane, is_ring
from lacli.geometry.prisms import split_prisms
from lacli.geometry.quadrature import enclosed_volume_ml
from lacli.geometry.surface import Surface, check, unique_edges
from lacli.geometry.tetrahedra import TET10_EDGES, boundary_faces, curved_jacobian, edges_of, scaled_jacobian

MIN_JACOBIAN = 0.2


class TooTightError(AnatomyError):
    """The surface bends too tightly for a wall of this thickness in cells of this size."""


@dataclass(frozen=True)
class ShellReport:
    """Quality of a shell: scaled Jacobian of the straight cells, det J of the curved ones over the straight ones', and
    how much of the wall had to be made thinner than asked (share of the points) because the surface bends too tightly.
    unmet_share: of the wall's points, where the outer surface that was given is out of reach and the thickness holds; unmet_at:
    one in their middle, mm."""

    cells: int
    layers: int
    scaled_jacobian_min: float
    scaled_jacobian_share_below_02: float
    curved_jacobian_min: float
    straightened_edges: int
    thinned_share: float
    unmet_share: float = 0.0
    unmet_at: tuple[float, ...] = ()


def mesh_shell(
    cavity: Surface,
    thickness_mm: float | FloatArray,
    cell_size_mm: float,
    order: int = 2,
    outer: Surface | None = None,
    layers: int | None = None,
    ring_width_mm: float = RING_WIDTH_MM,
) -> Bundle:
    """Tetrahedra between ``cavity`` and its outward offset by ``thickness_mm`` (a number, or one per point of ``cavity``).

    cavity: closed surface, planes labelled 21 - 26 (none is legal); it is remeshed to ``cell_size_mm``, and stays the
    geometry that points and, with ``order`` 2, edge middles lie on: give it finer than the cells. ``outer``: a closed
    outer surface that replaces the thickness where it lies 0.3 - 3 times as far. ``layers``: of cells through the wall;
    None chooses the wall's thickness over the cell size, at least one.
    ``info["shell"]`` of the bundle has the quality. Raises AnatomyError where the surface is not closed, an argument is out of
    range, or cells stay inverted.
    """
    check(cavity, "cavity surface")
    # to a tenth of a micrometre: what rounding differs by between processors would turn one edge, and so make another mesh
    cavity = replace(cavity, points=np.round(cavity.points, 4))
    thickness = np.broadcast_to(np.asarray(thickness_mm, dtype=np.float64), (len(cavity.points),))
    if not np.isfinite(thickness).all() or thickness.min() <= 0:
        raise AnatomyError("The wall thickness must be positive and finite everywhere (mm).")
    if order not in (1, 2):
        raise AnatomyError(f"The element order must be 1 or 2, got {order}.")
    tree = cKDTree(cavity.points)
    labelled = label_rings(cavity, ring_width_mm)
    reference = Reference(labelled)
    surface = remesh_on(reference, cell_size_mm)
    if order == 1:
        surface = keep_volume(surface, cavity.volume_ml())
    edges, _ = unique_edges(surface.triangles)

    def asked(points: FloatArray) -> FloatArray:
        distance, near = (np.asarray(x) for x in tree.query(points, k=3))
        weight = 1.0 / (distance + 1e-6)
        return (weight * thickness[near]).sum(axis=1) / weight.sum(axis=1)

    count = layers or max(1, round(float(np.median(thickness)) / cell_size_mm))
    off = offset_surface(surface, edges, reference, asked, outer, order == 2, count)
    return _assemble(surface, edges, off, count, order)


def _assemble(surface: Surface, edges: IntArray, off: Offset, layers: int, order: int) -> Bundle:
    n = len(surface.points)
    level = np.arange(layers + 1) / layers
    points = np.concatenate([surface.points + s * off.vector for s in level])
    tets = np.concatenate(
        [split_prisms(surface.triangles + k * n, surface.triangles + (k + 1) * n, off.starts) for k in range(layers)]
    )
    prism = np.tile(np.repeat(np.arange(len(surface.triangles)), 3), layers)
    label = surface.label[prism]
    transmural = np.repeat(level, n)
    straightened = 0
    quality = scaled_jacobian(points, tets)
    if quality.min() <= 0:
        where = place(points[tets[int(quality.argmin())]].mean(axis=0))
        raise TooTightError(
            f"The wall has {int((quality <= 0).sum())} inverted cells, the worst at {where}: it is too thick for how tightly the "
            "surface bends. Ask for a thinner wall (--thickness-mm), or smooth the surface there."
        )
    triangles, owner = boundary_faces(tets)
    inner = (triangles < n).all(axis=1)
    side = label[owner]
    tags = np.where(
        inner, np.where(is_plane(side), side, ENDO), np.where(is_plane(side), OTHER, np.where(is_ring(side), side, EPI))
    )
    if order == 2:
        points, tets, triangles, straightened = _curve(points, tets, triangles, surface, edges, off, layers)
        middle = np.zeros(len(points))
        middle[: len(transmural)] = transmural
        for i, (a, b) in enumerate(TET10_EDGES):
            middle[tets[:, 4 + i]] = (middle[tets[:, a]] + middle[tets[:, b]]) / 2
        transmural = middle
    report = ShellReport(
        cells=len(tets),
        layers=layers,
        scaled_jacobian_min=float(quality.min()),
        scaled_jacobian_share_below_02=float((quality < 0.2).mean()),
        curved_jacobian_min=float(curved_jacobian(points, tets).min()),
        straightened_edges=straightened,
        thinned_share=float(off.thinned.mean()),
        **_unmet(surface, off),
    )
    return _describe(points, tets, label, triangles, tags, transmural, surface, report)


def _unmet(surface: Surface, off: Offset) -> dict[str, Any]:
    """Of ShellReport: how much of the wall is as thick as asked, not as given, and where."""
    if not off.unmet.any():
        return {}
    there = surface.points[off.unmet]
    middle = there[np.argmin(np.linalg.norm(there - there.mean(axis=0), axis=1))]
    wall = np.unique(surface.triangles[~is_plane(surface.label)])
    return {"unmet_share": float(off.unmet.sum() / len(wall)), "unmet_at": tuple(float(x) for x in np.round(middle, 1))}


def _curve(
    points: FloatArray, tets: IntArray, triangles: IntArray, surface: Surface, edges: IntArray, off: Offset, layers: int
) -> tuple[FloatArray, IntArray, IntArray, int]:
    """Mid-edge nodes: on the smooth surfaces along them, linear across the wall; pulled straight where a cell would fold."""
    n = len(surface.points)
    all_edges, of_cell = edges_of(tets)
    chord = points[all_edges].mean(axis=1)
    foot = all_edges % n
    level = (all_edges // n).mean(axis=1) / layers
    along = foot[:, 0] != foot[:, 1]
    key = np.sort(foot, axis=1) @ np.array([n, 1])
    at = np.searchsorted(edges[:, 0] * n + edges[:, 1], key[along])
    smooth = chord.copy()
    smooth[along] = off.middle[at] + level[along, None] * off.middle_vector[at]
    bend = smooth - chord
    factor = np.ones(len(all_edges))
    total = len(points)
    numbered = np.column_stack([tets, total + of_cell])
    for _ in range(12):
        nodes = np.vstack([points, chord + factor[:, None] * bend])
        folded = curved_jacobian(nodes, numbered) < MIN_JACOBIAN
        if not folded.any():
            break
        factor[np.unique(of_cell[folded])] *= 0.6
    while folded.any():  # straight cells do not fold, but a cell beside one that was straightened may
        bent = factor[of_cell[folded]] > 0
        if not bent.any():
            break
        factor[np.unique(of_cell[folded])] = 0.0
        nodes = np.vstack([points, chord + factor[:, None] * bend])
        folded = curved_jacobian(nodes, numbered) < MIN_JACOBIAN
    nodes = np.vstack([points, chord + factor[:, None] * bend])
    size = total
    keys = all_edges[:, 0] * size + all_edges[:, 1]
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    middle = total + np.searchsorted(keys, sides[..., 0] * size + sides[..., 1])
    return nodes, numbered, np.column_stack([triangles, middle]), int(((factor < 1) & along).sum())


def _describe(
    points: FloatArray,
    tets: IntArray,
    label: IntArray,
    triangles: IntArray,
    tags: IntArray,
    transmural: FloatArray,
    surface: Surface,
    report: ShellReport,
) -> Bundle:
    """Regions, coordinates and fibres by the simple rules of ``frame``, where the openings say where things are."""
    present = {name for name in OPENINGS if np.any(surface.label == PLANES[name])}
    region = np.where(label == 0, REGIONS["anterior"], label)
    cavity = triangles[(tags == ENDO) | is_plane(tags)]
    info = {"cavity_volume_ml": -enclosed_volume_ml(cavity, points), "shell": report.__dict__}
    if not {"mv", "rspv", "ripv", "lspv", "lipv"} <= present:
        return Bundle(points, tets, region, triangles, tags, transmural=transmural, info=info)
    frame = frame_of(surface)
    middle = points[tets[:, :4]].mean(axis=1)
    body = label == 0
    region[body] = sectors(frame, middle[body])
    fibre = two_layer_fibres(frame, across(points, tets, transmural), transmural[tets[:, :4]].mean(axis=1))
    return Bundle(points, tets, region, triangles, tags, fibre, transmural, sweep(frame, points), height(frame, points), info)


def across(points: FloatArray, tets: IntArray, transmural: FloatArray) -> FloatArray:
    """Unit gradient (m, 3) of the transmural coordinate, by corner values."""
    x = points[tets[:, :4]]
    t = transmural[tets[:, :4]]
    return unit(np.asarray(np.linalg.solve(x[:, 1:] - x[:, :1], (t[:, 1:] - t[:, :1])[..., None])[..., 0], dtype=np.float64))


def frame_of(surface: Surface) -> AtrialFrame:
    """Axes from the labelled planes' centres."""
    openings = {}
    middle = surface.points[surface.triangles].mean(axis=1)
    area = surface.areas()
    for name in OPENINGS:
        mine = surface.label == PLANES[name]
        if mine.any():
            openings[name] = np.average(middle[mine], axis=0, weights=area[mine])
    return frame_from_openings(np.average(middle, axis=0, weights=area), openings)
