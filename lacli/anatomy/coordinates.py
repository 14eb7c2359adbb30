"""Coordinates, regions and fibres of a wall mesh whose boundary is tagged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lacli.anatomy import fibres, laplace, paths, regions, uac
from lacli.anatomy.bundle import ENDO, EPI, OPENINGS, PLANES, REGIONS, RINGS, TET10_EDGES, Bundle
from lacli.errors import AnatomyError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

RULES = ("laplace-dirichlet", "uac")


@dataclass(frozen=True)
class Layer:
    """One side of the wall, open at valve and veins: triangles (t, 3) of the bundle's points, vessel names (t,), source (t,)
    the boundary triangle each came from (10-node faces are cut in four)."""

    triangles: IntArray
    vessel: NDArray[np.str_]
    source: IntArray


@dataclass(frozen=True)
class Described:
    """A bundle with coordinates, regions and fibres, and the counts that the report names."""

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
    coordinate = np.full((len(bundle.points), 2), np.nan)
    on = {}
    for side in (EPI, ENDO):  # the endocardium last: it rules where both meet
        on[side] = layer = layer_of(bundle, side)
        found = uac.coordinates(_parts(bundle.points, layer, given))
        ids = np.unique(layer.triangles)
        coordinate[ids] = found[ids]
    coordinate = _through_the_wall(bundle, on, coordinate)
    inner = on[ENDO]
    rims = {name: _rim(inner, name) for name in ("rspv", "lipv")}
    lines = regions.lines_of(coordinate[rims["rspv"]], coordinate[rims["lipv"]])
    region, islands = _cell_regions(bundle, inner, coordinate, lines)
    fibre = bundle.fibre if rule == "keep" else _fibres(bundle, on, coordinate, rule)
    xi = pericardium_coordinate(bundle, region)
    done = replace(bundle, region=region, fibre=fibre, uac=coordinate, pericardium_coordinate=xi)
    return Described(done, lines, islands)


def layer_of(bundle: Bundle, side: int) -> Layer:
    """The endocardium (ENDO) or the epicardium with the rings' outer faces (EPI), named by the cells behind the faces."""
    if side == ENDO:
        chosen = np.flatnonzero(bundle.tags == ENDO)
    else:
        chosen = np.flatnonzero((bundle.tags == EPI) | ((bundle.tags >= 11) & (bundle.tags <= 16)))
    faces = bundle.triangles[chosen]
    label = cell_label(bundle, faces[:, :3])
    names = {RINGS[name]: name for name in OPENINGS if name != "mv"}
    vessel = np.array([names.get(int(v), "") for v in label])
    if faces.shape[1] == 3:
        return Layer(faces, vessel, chosen)
    a, b, c, ab, bc, ca = faces.T
    quarters = np.stack([np.column_stack(t) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))], axis=1).reshape(
        -1, 3
    )
    return Layer(quarters, np.repeat(vessel, 4), np.repeat(chosen, 4))


def cell_label(bundle: Bundle, faces: IntArray) -> IntArray:
    """Region of the cell behind each boundary face (t, 3)."""
    from lacli.anatomy.cells import boundary_faces, row_keys

    outside, owner = boundary_faces(bundle.tets[:, :4])
    size = len(bundle.points)
    known = row_keys(np.sort(outside, axis=1), size)
    order = np.argsort(known)
    at = np.searchsorted(known[order], row_keys(np.sort(faces, axis=1), size))
    return bundle.region[owner[order[np.minimum(at, len(order) - 1)]]]


def _rim(layer: Layer, name: str) -> IntArray:
    inside = layer.vessel == name
    if not inside.any():
        raise AnatomyError(f"the wall has no ring of {name.upper()}; coordinates need the rings of four veins.")
    open_ids = np.unique(paths.open_edges(layer.triangles))
    rim = np.intersect1d(open_ids, np.unique(layer.triangles[inside]))
    if len(rim) < 3:
        raise AnatomyError(f"the ring of {name.upper()} has no open rim.")
    return rim


def _parts(points: FloatArray, layer: Layer, sides: Mapping[str, FloatArray]) -> uac.Parts:
    rims = paths.loops(paths.open_edges(layer.triangles))
    body = np.unique(layer.triangles[layer.vessel == ""])
    of_body = [loop for loop in rims if np.isin(loop, body).mean() > 0.5]
    if not of_body:
        raise AnatomyError("the wall has no opening at the mitral valve.")
    mitral = max(of_body, key=lambda loop: paths.perimeter(points, loop))
    return uac.Parts(
        points,
        layer.triangles,
        layer.vessel,
        mitral,
        **{k: sides.get(k) for k in ("lateral", "septal", "lspv_roof", "rspv_roof")},
    )


def _through_the_wall(bundle: Bundle, on: Mapping[int, Layer], coordinate: FloatArray) -> FloatArray:
    """Points inside the wall, and of the planes, take the coordinates of the nearest point of the layer on their side."""
    assert bundle.transmural is not None
    out = coordinate.copy()
    missing = np.flatnonzero(~np.isfinite(coordinate).all(axis=1))
    for side, half in ((ENDO, bundle.transmural[missing] < 0.5), (EPI, bundle.transmural[missing] >= 0.5)):
        ids = np.unique(on[side].triangles)
        ids = ids[np.isfinite(coordinate[ids]).all(axis=1)]
        chosen = missing[half]
        if len(chosen):
            _, nearest = cKDTree(bundle.points[ids]).query(bundle.points[chosen])
            out[chosen] = coordinate[ids[nearest]]
    return out


def _cell_regions(bundle: Bundle, inner: Layer, coordinate: FloatArray, lines: regions.Lines) -> tuple[IntArray, int]:
    """Regions of the endocardial faces, islands corrected, carried to the cells behind them."""
    region = regions.of_triangles(coordinate, inner.triangles, lines)
    label = cell_label(bundle, bundle.triangles[inner.source, :3])
    body = label < 10
    a, b, c = (bundle.points[inner.triangles[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    region, islands = regions.without_islands(inner.triangles, region, area, body)
    cells = bundle.region < 10
    out = bundle.region.copy()
    nearest = _feet(bundle, cells, (a + b + c)[body] / 3.0)
    out[cells] = region[body][nearest]
    return out, islands


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


def pericardium_coordinate(bundle: Bundle, region: IntArray) -> FloatArray:
    """(n,) harmonic in the wall: 0 at the mitral ring, 1 in the roof region."""
    corner, wall = _linear(bundle, region < 20)
    ring = np.unique(corner[wall == RINGS["mv"]])
    roof = np.setdiff1d(np.unique(corner[wall == REGIONS["roof"]]), ring)
    if len(ring) == 0 or len(roof) == 0:
        raise AnatomyError("the pericardium coordinate needs a mitral ring and a roof region.")
    matrix = laplace.stiffness(laplace.gradient(bundle.points, corner), len(bundle.points))
    field = laplace.solve(matrix, {0.0: ring, 1.0: roof})
    return np.clip(_fill_points(bundle, field), 0.0, 1.0)


def _linear(bundle: Bundle, keep: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    return bundle.tets[keep, :4], bundle.region[keep]


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
    wall = np.unique(bundle.tets[bundle.region < 20, :4])
    for name in OPENINGS:
        plane = bundle.tets[bundle.region == PLANES[name], :4]
        if len(plane):
            found[name] = np.intersect1d(wall, plane)
    return found


def _fibres(bundle: Bundle, on: Mapping[int, Layer], coordinate: FloatArray, rule: str) -> FloatArray:
    assert bundle.transmural is not None
    corner = bundle.tets[:, :4]
    endo = bundle.triangles[(bundle.tags == ENDO) | (bundle.tags >= 21), :3][:, ::-1]
    across = fibres.endocardial_normals(bundle.points, corner, endo)
    if rule == "uac":
        depth = bundle.transmural[corner].mean(axis=1)
        fibre = np.zeros((len(corner), 3))
        for side, half in ((ENDO, depth < 0.5), (EPI, depth >= 0.5)):
            layer = on[side]
            direction = fibres.uac_bundles(bundle.points, layer.triangles, coordinate, side == EPI)
            _, nearest = cKDTree(bundle.points[layer.triangles].mean(axis=1)).query(bundle.points[corner[half]].mean(axis=1))
            fibre[half] = direction[nearest]
        fibre -= np.sum(fibre * across, axis=1, keepdims=True) * across
        size = np.linalg.norm(fibre, axis=1, keepdims=True)
        return np.where(size > 1e-6, fibre / np.maximum(size, 1e-12), np.cross(across, [[0.6, 0.0, 0.8]]))
    if rule != "laplace-dirichlet":
        raise AnatomyError(f"unknown fibre rule '{rule}'; the known ones are {', '.join(RULES)}.")
    wall = bundle.region < 20
    fields = fibres.solve_fields(bundle.points, corner[wall], fibres.boundary_sets(opening_points(bundle)))
    filled = {name: _fill_points(replace(bundle, tets=bundle.tets), field) for name, field in fields.items()}
    return fibres.laplace_dirichlet(bundle.points, corner, filled, across).fibre
