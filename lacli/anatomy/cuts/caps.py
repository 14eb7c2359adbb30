"""Valve planes on tetrahedra whose wall ends in cut faces: each opening's plate, extruded outward, conformal with the wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from lacli.anatomy.coordinates.frame import unit
from lacli.anatomy.wall.polish import polish
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry.prisms import shorter_diagonals, split_prisms
from lacli.geometry.surface import nearest, unique_edges
from lacli.geometry.tetrahedra import row_keys, volumes


@dataclass(frozen=True)
class Plate:
    """New points (p, 3) mm numbered after the wall's; tets (m, 4); cap (c, 3): its cavity side; annulus: its wall points."""

    points: FloatArray
    tets: IntArray
    cap: IntArray
    annulus: IntArray


def rim_loops(triangles: IntArray) -> list[IntArray]:
    """Closed loops of point ids along the open edges, each in the direction of the triangles' sides."""
    directed = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    size = int(triangles.max()) + 1
    alone = ~np.isin(directed[:, 0] * size + directed[:, 1], directed[:, 1] * size + directed[:, 0])
    following = dict(directed[alone].tolist())
    if len(following) != int(alone.sum()):
        raise AnatomyError("An opening's rim touches itself or another rim; repair the surface there.")
    loops = []
    while following:
        start, at = following.popitem()
        loop = [start]
        while at != start:
            loop.append(at)
            at = following.pop(at)
        loops.append(np.array(loop, dtype=np.int64))
    return loops


def extrude_plate(points: FloatArray, rim: IntArray, outer_faces: IntArray, centre: FloatArray, thickness: float) -> Plate:
    """Plate over the opening with the given ``rim`` (k,) of point ids, ``thickness`` mm thick.

    Its foot is a fresh triangulation of the opening and those of the wall's ``outer_faces`` (t, 3) that continue it
    sideways: within twice the thickness of the rim, facing the same way.
    """
    ring = points[rim]
    middle = ring.mean(axis=0)
    normal = unit(np.cross(ring - middle, np.roll(ring, -1, axis=0) - middle).sum(axis=0))
    if normal @ (middle - centre) < 0:
        normal = -normal
    inner, cap = triangulate_loop(points, rim, normal)
    # a cap's triangle between three rim points may be a face of the wall already: it must not be glued to it
    size = len(points) + len(inner)
    shared = np.isin(row_keys(cap, size), row_keys(outer_faces, size))
    if shared.any():
        ear = cap[shared]
        middle_ids = size + np.arange(len(ear))
        # its middle goes a little inward, so that a flat ear gives no flat cells
        reach = np.linalg.norm(points[ear[:, 0]] - points[ear[:, 1]], axis=1)
        inner = np.vstack([inner, points[ear].mean(axis=1) - 0.4 * reach[:, None] * normal])
        fans = [np.column_stack([ear[:, k], ear[:, (k + 1) % 3], middle_ids]) for k in range(3)]
        outer_faces = outer_faces[~np.isin(row_keys(outer_faces, size), row_keys(ear, size))]
        cap = np.vstack([cap[~shared], *fans])
    annulus = _annulus(points, rim, outer_faces, normal, 1.6 * thickness)
    # the wall's faces look out of the wall, along the plate's direction: so do the cap's
    foot = np.vstack([cap, annulus])
    everything = np.vstack([points, inner])
    used, local = np.unique(foot, return_inverse=True)
    top_ids = len(everything) + np.arange(len(used))
    local = local.reshape(-1, 3)
    base = everything[used]
    edges, of_triangle = unique_edges(local)
    vector = _even_tops(base, local, edges, thickness * normal)
    starts = shorter_diagonals(base, vector, local, edges, of_triangle)
    vector = polish(base, vector, local, starts, np.full(3 * len(local), 0.2))
    everything = np.vstack([everything, base + vector])
    tets = split_prisms(foot, top_ids[local], starts)
    bad = volumes(everything, tets) <= 0
    if bad.any():
        raise AnatomyError(f"The plate over an opening has {int(bad.sum())} inverted cells: its cut is too uneven.")
    return Plate(everything[len(points) :], tets, cap, np.unique(annulus))


def _even_tops(base: FloatArray, triangles: IntArray, edges: IntArray, step: FloatArray) -> FloatArray:
    """Vectors (k, 3) mm from the foot to the far side: that of a foot with its bumps smoothed, moved by ``step``, but nowhere
    nearer than 0.6 of it."""
    degree = np.maximum(np.bincount(edges.ravel(), minlength=len(base)), 1)[:, None]
    smooth = base
    for _ in range(6):
        total = np.zeros_like(base)
        np.add.at(total, edges[:, 0], smooth[edges[:, 1]])
        np.add.at(total, edges[:, 1], smooth[edges[:, 0]])
        smooth = 0.5 * smooth + 0.5 * total / degree
    normal = unit(step)
    rise = (smooth - base) @ normal
    limit = 0.4 * np.linalg.norm(step)
    vector: FloatArray = step + np.clip(rise, -limit, limit)[:, None] * normal
    return vector


def _annulus(points: FloatArray, rim: IntArray, faces: IntArray, normal: FloatArray, reach: float) -> IntArray:
    corner = points[faces]
    facing = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])) @ normal
    near = nearest(points[rim], corner.reshape(-1, 3))[0].reshape(-1, 3).max(axis=1)
    chosen = faces[(facing > 0.55) & (near < reach)]
    # only what hangs together with the rim
    reached = np.zeros(len(points), dtype=bool)
    reached[rim] = True
    keep = np.zeros(len(chosen), dtype=bool)
    while True:
        grown = keep | (reached[chosen].sum(axis=1) >= 2)
        if grown.sum() == keep.sum():
            return chosen[keep]
        keep = grown
        reached[chosen[keep]] = True


def triangulate_loop(points: FloatArray, rim: IntArray, normal: FloatArray) -> tuple[FloatArray, IntArray]:
    """New inner points (k, 3) mm, and triangles (t, 3) over the loop, facing ``normal``; new ids follow ``points``.

    The rim's edges are kept; gmsh meshes its projection along ``normal``, heights follow harmonically.
    """
    import gmsh

    ring = points[rim]
    flat, middle, plane = project(ring, normal)
    before = np.roll(flat, 1, axis=0)
    if np.sum(before[:, 0] * flat[:, 1] - before[:, 1] * flat[:, 0]) < 0:
        rim, ring, flat = rim[::-1], ring[::-1], flat[::-1]
    if crosses_itself(flat):  # gmsh may never return from such a curve
        raise AnatomyError("An opening's rim cannot be filled with triangles: its projection crosses itself.")
    gmsh.initialize(["lacli", "-v", "0"], readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 1)
        corner = [gmsh.model.geo.addPoint(x, y, 0.0) for x, y in flat]
        lines = [gmsh.model.geo.addLine(p, q) for p, q in zip(corner, corner[1:] + corner[:1], strict=True)]
        for line in lines:
            gmsh.model.geo.mesh.setTransfiniteCurve(line, 2)
        face = gmsh.model.geo.addPlaneSurface([gmsh.model.geo.addCurveLoop(lines)])
        gmsh.model.geo.synchronize()
        gmsh.model.mesh.generate(2)
        tags, xyz, _ = gmsh.model.mesh.getNodes()
        _, nodes = gmsh.model.mesh.getElementsByType(2, face)
    except Exception as error:  # gmsh raises bare Exception
        raise AnatomyError(f"An opening's rim cannot be filled with triangles ({error}).") from error
    finally:
        gmsh.finalize()
    order = np.argsort(tags)
    position = xyz.reshape(-1, 3)[order][:, :2]
    triangles = np.searchsorted(tags[order], nodes).reshape(-1, 3)
    if len(position) < len(rim) or not np.allclose(position[: len(rim)], flat, atol=1e-9):
        raise AnatomyError("An opening's rim cannot be filled with triangles: its projection crosses itself.")
    height = harmonic_heights(triangles, (ring - middle) @ normal, len(position))
    inner = middle + position[len(rim) :] @ plane + height[len(rim) :, None] * normal
    ids = np.concatenate([rim, len(points) + np.arange(len(inner))])
    return inner, ids[triangles]


def project(ring: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A curve (k, 3) along the unit ``normal``: (k, 2) about its middle (3,), in the plane of two unit vectors (2, 3)."""
    across = unit(np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0]))
    plane = np.stack([across, np.cross(normal, across)])
    middle = ring.mean(axis=0)
    return (ring - middle) @ plane.T, middle, plane


def crosses_itself(ring: FloatArray) -> bool:
    """Whether two sides of a closed plane curve (k, 2) cross or touch (neighbours apart), or a side has no length."""
    return len(crossing_points(ring)) > 0


def crossing_points(ring: FloatArray) -> IntArray:
    """Which points of a closed plane curve (k, 2) end a side that crosses or touches another (neighbours apart), or has no
    length."""
    a, b = ring, np.roll(ring, -1, axis=0)
    size = float(np.ptp(ring, axis=0).max())
    short = np.linalg.norm(b - a, axis=1) < 1e-6 * size

    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        u, v = q[:, None] - p[:, None], r[None] - p[:, None]
        return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    k = len(ring)
    first, second = side(a, b, a), side(a, b, b)
    crossed = (first * second <= 0) & (first * second <= 0).T
    gap = np.abs(np.arange(k)[:, None] - np.arange(k)[None])
    sides = np.flatnonzero(short | (crossed & (gap > 1) & (gap < k - 1)).any(axis=1))
    return np.unique(np.concatenate([sides, (sides + 1) % k]))


def harmonic_heights(triangles: IntArray, rim_height: FloatArray, size: int) -> FloatArray:
    """Heights (size,) that equal ``rim_height`` on the first points and the mean of the neighbours elsewhere."""
    fixed = len(rim_height)
    height = np.concatenate([rim_height, np.zeros(size - fixed)])
    if size == fixed:
        return height
    sides, _ = unique_edges(triangles)
    ones = np.ones(2 * len(sides))
    graph = coo_matrix(
        (ones, (np.concatenate([sides[:, 0], sides[:, 1]]), np.concatenate([sides[:, 1], sides[:, 0]]))), (size, size)
    )
    laplacian = (diags(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsc()
    height[fixed:] = spsolve(laplacian[fixed:, fixed:], -laplacian[fixed:, :fixed] @ height[:fixed])
    return height
