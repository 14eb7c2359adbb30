"""Coordinates, regions and fibres of a wall mesh whose boundary is tagged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lacli.anatomy.coordinates import fibres, regions, uac
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, EPI, OPENINGS, PLANES, REGIONS, RINGS, is_body, is_plane, is_ring, is_wall
from lacli.geometry import curves as paths
from lacli.geometry import laplace, subdivision
from lacli.geometry.tetrahedra import TET10_EDGES
from lacli.geometry.triangles import area_normals

RULES = ("laplace-dirichlet", "uac")


# Spacing of the triangles that coordinates are laid on, whatever the cells. On the cells' own nodes the lines of the coordinates,
# and with them the regions, follow the mesh: features of one atrium differed by up to 0.3 mm between 4 and 1.5 mm cells.
FINE_MM = 1.0
COARSEST_MM = 25.0  # mean edge; an atrium of larger triangles has no shape, and its fine ones would fill the memory


@dataclass(frozen=True)
class Layer:
    """One side of the wall, open at valve and veins: triangles (t, 3) of points (p, 3) mm, vessel names (t,).

    source (t,): the boundary triangle each came from. node (p,): the bundle's point that the point is, -1 for none.
    """

    points: FloatArray
    triangles: IntArray
    vessel: NDArray[np.str_]
    source: IntArray
    node: IntArray


@dataclass(frozen=True)
class Laid:
    """A layer and the coordinates (p, 2) of its points."""

    layer: Layer
    uac: FloatArray


@dataclass(frozen=True)
class Described:
    """A bundle with coordinates, regions and fibres; the regions' lines; how many triangles took the region around them."""

    bundle: Bundle
    lines: regions.Lines
    islands: int


def describe(bundle: Bundle, sides: Mapping[str, FloatArray] | None = None, rule: str = "laplace-dirichlet") -> Described:
    """Coordinates, regions and fibres for a bundle with transmural values, rings 11 - 16 and planes 21 - 26.

    ``sides``: points of landmarks.SIDES that win over what is found. ``rule``: one of RULES. A bundle that has its own fibres
    keeps them only if ``rule`` is "keep". Raises AnatomyError where an opening is missing or the coordinates cannot be laid.
    """
    if bundle.transmural is None:
        raise AnatomyError("the bundle has no transmural coordinate.")
    given = dict(sides or {})
    on = {}
    for side in (EPI, ENDO):
        layer = fine_layer_of(bundle, side)
        # however fine the cells: edges of a subdivision have three directions a face, so paths along them stay longer by a sixth
        line = paths.Ways.over(layer.points, layer.triangles).path
        on[side] = Laid(layer, uac.coordinates(_parts(layer, given), line))
    coordinate = _at_points(bundle, {side: (laid.layer, laid.uac) for side, laid in on.items()})
    inner = on[ENDO]
    lines = regions.lines_of(*(inner.uac[_rim(inner.layer, name)] for name in ("rspv", "lipv")))
    fine = {side: _fine_regions(bundle, laid, lines) for side, laid in on.items()}
    region, islands = _cell_regions(bundle, inner.layer, *fine[ENDO])
    fibre = bundle.fibre if rule == "keep" else _fibres(bundle, on, rule)
    xi = _pericardium_coordinate(bundle, {side: (laid.layer, fine[side][0]) for side, laid in on.items()})
    done = replace(bundle, region=region, fibre=fibre, uac=coordinate, pericardium_coordinate=xi)
    return Described(done, lines, islands)


def layer_of(bundle: Bundle, side: int) -> Layer:
    """The endocardium (ENDO) or the epicardium with the rings' outer faces (EPI) in the bundle's points.

    Faces are named by the cells behind them; 6-node faces are cut in four.
    """
    chosen, vessel = _faces(bundle, side)
    triangles = subdivision.straight(bundle.triangles[chosen])
    each = len(triangles) // max(len(chosen), 1)
    return Layer(
        bundle.points, triangles, np.repeat(vessel, each), np.repeat(chosen, each), np.arange(len(bundle.points), dtype=np.int64)
    )


def fine_layer_of(bundle: Bundle, side: int) -> Layer:
    """The same side in triangles of about FINE_MM, their points on the curved faces.

    Of a side in several parts the largest: cells kept as they were leave pieces of their cut faces beside the epicardium, where
    harmonic coordinates have no boundary values. Raises AnatomyError where the side has no triangle, or triangles of no atrium's
    size.
    """
    chosen, vessel = _faces(bundle, side)
    if len(chosen) == 0:
        raise AnatomyError(f"the wall has no {'endocardium' if side == ENDO else 'epicardium'}.")
    count, part = paths.triangle_components(bundle.triangles[chosen, :3])
    if count > 1:
        size = np.linalg.norm(area_normals(bundle.points[bundle.triangles[chosen, :3]]), axis=1)
        largest = part == np.argmax(np.bincount(part, size))
        chosen, vessel = chosen[largest], vessel[largest]
    faces = bundle.triangles[chosen]
    edge = bundle.points[faces[:, [1, 2, 0]]] - bundle.points[faces[:, :3]]
    length = float(np.linalg.norm(edge, axis=2).mean())
    if length > COARSEST_MM:
        raise AnatomyError(f"the wall's triangles are {length:.0f} mm long; are the lengths micrometres? The bundle is in mm.")
    # an even number along each edge: the nodes at the middles are among the points
    k = max(2, 2 * round(length / (2.0 * FINE_MM)))
    fine = subdivision.subdivide(bundle.points, faces, k)
    return Layer(fine.points, fine.triangles, vessel[fine.source], chosen[fine.source], fine.node)


def _faces(bundle: Bundle, side: int) -> tuple[IntArray, NDArray[np.str_]]:
    """Boundary triangles (t,) of a side, and the vessel whose ring is behind each ("" for the body)."""
    if side == ENDO:
        chosen = np.flatnonzero(bundle.tags == ENDO)
    else:
        chosen = np.flatnonzero((bundle.tags == EPI) | is_ring(bundle.tags))
    label = cell_label(bundle, bundle.triangles[chosen, :3])
    names = {RINGS[name]: name for name in OPENINGS if name != "mv"}
    return chosen, np.array([names.get(int(v), "") for v in label])


def cell_label(bundle: Bundle, faces: IntArray) -> IntArray:
    """Region of the cell behind each boundary face (t, 3)."""
    return bundle.region[cell_behind(bundle, faces)]


def cell_behind(bundle: Bundle, faces: IntArray) -> IntArray:
    """The cell (t,) behind each boundary face (t, 3)."""
    from lacli.geometry.tetrahedra import boundary_faces, row_keys

    outside, owner = boundary_faces(bundle.tets[:, :4])
    size = len(bundle.points)
    known = row_keys(np.sort(outside, axis=1), size)
    order = np.argsort(known)
    at = np.searchsorted(known[order], row_keys(np.sort(faces, axis=1), size))
    return owner[order[np.minimum(at, len(order) - 1)]]


def _rim(layer: Layer, name: str) -> IntArray:
    """Points (k,) of a vein's open rim: of those that its triangles reach the one they surround."""
    inside = layer.vessel == name
    if not inside.any():
        raise AnatomyError(f"the wall has no ring of {name.upper()}; coordinates need the rings of four veins.")
    own = np.unique(layer.triangles[inside])
    share = [(float(np.isin(loop, own).mean()), loop) for loop in paths.loops(paths.open_edges(layer.triangles))]
    most, rim = max(share, key=lambda one: one[0], default=(0.0, own))
    if most <= 0.5:
        raise AnatomyError(f"the ring of {name.upper()} has no open rim.")
    return rim


def _parts(layer: Layer, sides: Mapping[str, FloatArray]) -> uac.Parts:
    rims = paths.loops(paths.open_edges(layer.triangles))
    body = np.unique(layer.triangles[layer.vessel == ""])
    of_body = [loop for loop in rims if np.isin(loop, body).mean() > 0.5]
    if not of_body:
        raise AnatomyError("the wall has no opening at the mitral valve.")
    mitral = max(of_body, key=lambda loop: paths.perimeter(layer.points, loop))
    return uac.Parts(
        layer.points,
        layer.triangles,
        layer.vessel,
        mitral,
        **{k: sides.get(k) for k in ("lateral", "septal", "lspv_roof", "rspv_roof")},
    )


def _at_points(bundle: Bundle, sides: Mapping[int, tuple[Layer, FloatArray]]) -> FloatArray:
    """(n, c) at the bundle's points of values (p, c) on the layers of its two sides.

    Points of a side have its values (of the endocardium where both meet); those inside the wall, and of the planes, the values of
    the nearest point of the layer on their side.
    """
    assert bundle.transmural is not None
    out = np.full((len(bundle.points), sides[ENDO][1].shape[1]), np.nan)
    for side in (EPI, ENDO):
        layer, values = sides[side]
        own = layer.node >= 0
        out[layer.node[own]] = values[own]
    missing = np.flatnonzero(~np.isfinite(out).all(axis=1))
    for side, half in ((ENDO, bundle.transmural[missing] < 0.5), (EPI, bundle.transmural[missing] >= 0.5)):
        layer, values = sides[side]
        known = np.isfinite(values).all(axis=1)
        chosen = missing[half]
        if len(chosen):
            _, nearest = cKDTree(layer.points[known]).query(bundle.points[chosen])
            out[chosen] = values[known][nearest]
    return out


def _fine_regions(bundle: Bundle, laid: Laid, lines: regions.Lines) -> tuple[IntArray, FloatArray, int]:
    """Region and area (t,) of a layer's triangles, islands corrected, and how many were; rings keep their cells' labels."""
    points, triangles = laid.layer.points, laid.layer.triangles
    label = cell_label(bundle, bundle.triangles[laid.layer.source, :3])
    area = 0.5 * np.linalg.norm(area_normals(points[triangles]), axis=1)
    region, islands = regions.without_islands(triangles, regions.of_triangles(laid.uac, triangles, lines), area, is_body(label))
    return np.where(is_body(label), region, label), area, islands


def _cell_regions(bundle: Bundle, inner: Layer, region: IntArray, area: FloatArray, islands: int) -> tuple[IntArray, int]:
    """What ``_fine_regions`` gives on the endocardium carried to the cells behind; how many triangles and faces were islands."""
    points, triangles = inner.points, inner.triangles
    faces, face = np.unique(inner.source, return_inverse=True)
    corners = bundle.triangles[faces, :3]
    behind = cell_behind(bundle, corners)
    body = is_body(bundle.region[behind])
    under = body[face]
    cells = is_body(bundle.region)
    out = bundle.region.copy()
    out[cells] = region[under][_feet(bundle, cells, points[triangles[under]].mean(axis=1))]
    # features are means over the faces of the cells at the endocardium: these take what most of their faces' area is
    of_face = _most(face[under], region[under], area[under], len(faces))
    size = np.bincount(face, area).astype(np.float64)
    of_face, more = regions.without_islands(corners, of_face, size, body)
    owner = np.unique(behind[body])
    out[owner] = _most(behind[body], of_face[body], size[body], len(bundle.tets))[owner]
    return out, islands + more


def _most(group: IntArray, region: IntArray, area: FloatArray, count: int) -> IntArray:
    """The region (count,) with the largest area in each group, of members with group, region and area (k,)."""
    kinds = max(REGIONS.values()) + 1
    return np.bincount(group * kinds + region, area, count * kinds).reshape(count, kinds).argmax(axis=1)


def _feet(bundle: Bundle, cells: NDArray[np.bool_], centres: FloatArray) -> IntArray:
    """For each chosen cell the endocardial face under it: the foot of its centre, walked back along the transmural gradient."""
    assert bundle.transmural is not None
    corner = bundle.tets[cells, :4]
    grad = laplace.gradient(bundle.points, corner)
    slope = grad.of(bundle.transmural)
    depth = bundle.transmural[corner].mean(axis=1)
    size = np.maximum((slope**2).sum(axis=1), 1e-12)
    foot = bundle.points[corner].mean(axis=1) - (depth / size)[:, None] * slope
    return np.asarray(cKDTree(centres).query(foot)[1])


def _pericardium_coordinate(bundle: Bundle, on: Mapping[int, tuple[Layer, IntArray]]) -> FloatArray:
    """(n,) harmonic on either side of the wall, given as layer and regions (t,): 0 at the mitral ring, 1 in the roof region.

    On the fine layers, as the roof is: from cells, whose roof is as ragged as they are large, the springs that follow from it
    held a real atrium 5 % more at 4 than at 1.5 mm.
    """
    sides = {}
    for side, (layer, region) in on.items():
        triangles, points = layer.triangles, layer.points
        ring = np.unique(triangles[region == RINGS["mv"]])
        roof = np.setdiff1d(np.unique(triangles[region == REGIONS["roof"]]), ring)
        if len(ring) == 0 or len(roof) == 0:
            raise AnatomyError("the pericardium coordinate needs a mitral ring and a roof region.")
        matrix = laplace.stiffness(laplace.gradient(points, triangles), len(points))
        field = laplace.solve(matrix, {0.0: ring, 1.0: roof})
        sides[side] = (layer, np.clip(field, 0.0, 1.0)[:, None])
    return _at_points(bundle, sides)[:, 0]


def _fill_points(bundle: Bundle, field: FloatArray) -> FloatArray:
    """Edge middles from the corners they lie between; points of the planes from the nearest known point."""
    out = field.copy()
    if bundle.order == 2:
        for i, (a, b) in enumerate(TET10_EDGES):
            value = (field[bundle.tets[:, a]] + field[bundle.tets[:, b]]) / 2.0
            known = np.isfinite(value)
            out[bundle.tets[known, 4 + i]] = value[known]
    lost = ~np.isfinite(out)
    if lost.any():
        _, nearest = cKDTree(bundle.points[~lost]).query(bundle.points[lost])
        out[lost] = out[~lost][nearest]
    return out


def opening_points(bundle: Bundle) -> dict[str, IntArray]:
    """Corner point ids where each opening's wall meets its plane, through the whole thickness."""
    found = {}
    wall = np.unique(bundle.tets[is_wall(bundle.region), :4])
    for name in OPENINGS:
        plane = bundle.tets[bundle.region == PLANES[name], :4]
        if len(plane):
            found[name] = np.intersect1d(wall, plane)
    return found


def _fibres(bundle: Bundle, on: Mapping[int, Laid], rule: str) -> FloatArray:
    assert bundle.transmural is not None
    corner = bundle.tets[:, :4]
    endo = bundle.triangles[(bundle.tags == ENDO) | is_plane(bundle.tags), :3][:, ::-1]
    across = fibres.endocardial_normals(bundle.points, corner, endo)
    if rule == "uac":
        depth = bundle.transmural[corner].mean(axis=1)
        fibre = np.zeros((len(corner), 3))
        for side, half in ((ENDO, depth < 0.5), (EPI, depth >= 0.5)):
            points, triangles = on[side].layer.points, on[side].layer.triangles
            direction = fibres.uac_bundles(points, triangles, on[side].uac, side == EPI)
            _, nearest = cKDTree(points[triangles].mean(axis=1)).query(bundle.points[corner[half]].mean(axis=1))
            fibre[half] = direction[nearest]
        fibre -= np.sum(fibre * across, axis=1, keepdims=True) * across
        size = np.linalg.norm(fibre, axis=1, keepdims=True)
        return np.where(size > 1e-6, fibre / np.maximum(size, 1e-12), np.cross(across, [[0.6, 0.0, 0.8]]))
    if rule != "laplace-dirichlet":
        raise AnatomyError(f"unknown fibre rule '{rule}'; the known ones are {', '.join(RULES)}.")
    wall = is_wall(bundle.region)
    fields = fibres.solve_fields(bundle.points, corner[wall], fibres.boundary_sets(opening_points(bundle)))
    filled = {name: _fill_points(replace(bundle, tets=bundle.tets), field) for name, field in fields.items()}
    return fibres.laplace_dirichlet(bundle.points, corner, filled, across).fibre
