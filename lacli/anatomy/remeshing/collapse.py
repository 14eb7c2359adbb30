"""Collapsing short edges of a surface, an independent set at a time."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix

from lacli.anatomy.remeshing.projection import Reference
from lacli.anatomy.remeshing.workmesh import CORNER, INNER, Asked, WorkMesh, project, turned
from lacli.base.arrays import FloatArray, IntArray
from lacli.geometry.triangles import shape_quality


def collapse(mesh: WorkMesh, reference: Reference, asked: Asked) -> None:
    """Remove edges shorter than 4/5 of the asked length, an independent set at a time."""
    rng = np.random.default_rng(7)
    mesh.refusals = np.zeros(len(mesh.points))
    idle = 0
    for _ in range(120):
        mesh.refresh()
        short = mesh.length < 0.8 * mesh.wanted
        a, b = mesh.edges.T
        ka, kb = mesh.kind[a], mesh.kind[b]
        # a border shrinks along itself only; two borders are never pulled together
        allowed = mesh.is_border | (ka == INNER) | (kb == INNER)
        allowed &= ~((ka == CORNER) & (kb == CORNER))
        allowed &= (mesh.valence[mesh.opposite] > 3).all(axis=1)
        candidate = np.flatnonzero(short & allowed)
        if len(candidate) == 0:
            return
        candidate = candidate[_common_neighbours(mesh, candidate) == 2]
        # an edge that was refused must not stand in its neighbours' way again
        patience = mesh.refusals[mesh.edges[candidate]].min(axis=1) * mesh.size.max()
        chosen = _independent(mesh, candidate, patience + mesh.length[candidate] * (1 + 0.3 * rng.random(len(candidate))))
        if len(chosen) == 0:
            return
        done = _apply(mesh, chosen, reference, asked)
        idle = idle + 1 if done < max(1, 0.002 * len(mesh.edges)) else 0
        if idle > 3:
            return


def _common_neighbours(mesh: WorkMesh, candidate: IntArray) -> IntArray:
    n = len(mesh.points)
    graph = coo_matrix((np.ones(len(mesh.edges)), (mesh.edges[:, 0], mesh.edges[:, 1])), shape=(n, n)).tocsr()
    graph = graph + graph.T
    a, b = mesh.edges[candidate].T
    return np.asarray(graph[a].multiply(graph[b]).sum(axis=1)).ravel().astype(np.int64)


def _independent(mesh: WorkMesh, candidate: IntArray, priority: FloatArray) -> IntArray:
    """Those candidates that are the most urgent among all that touch their points' neighbourhoods."""
    n = len(mesh.points)
    rank = np.empty(len(candidate))
    rank[np.argsort(priority)] = np.arange(len(candidate))
    nearest = np.full(n, np.inf)
    for k in range(2):
        np.minimum.at(nearest, mesh.edges[candidate, k], rank)
    around = nearest.copy()
    np.minimum.at(around, mesh.edges[:, 0], nearest[mesh.edges[:, 1]])
    np.minimum.at(around, mesh.edges[:, 1], nearest[mesh.edges[:, 0]])
    a, b = mesh.edges[candidate].T
    return candidate[(around[a] >= rank) & (around[b] >= rank)]


def _apply(mesh: WorkMesh, chosen: IntArray, reference: Reference, asked: Asked) -> int:
    a, b = mesh.edges[chosen].T
    # the point that stays: the one on a border or corner, else either, moved to the middle
    stay = np.where(mesh.kind[b] > mesh.kind[a], b, a)
    gone = np.where(stay == a, b, a)
    same = mesh.kind[a] == mesh.kind[b]
    # the middle first; where that was refused before, one end
    tired = same & (mesh.refusals[mesh.edges[chosen]].max(axis=1) > 0)
    swap = tired & (mesh.refusals[mesh.edges[chosen]].sum(axis=1) % 2 == 1)
    stay, gone = np.where(swap, gone, stay), np.where(swap, stay, gone)
    same &= ~tired
    target = np.where(same[:, None], (mesh.points[a] + mesh.points[b]) / 2, mesh.points[stay])
    moved = WorkMesh(mesh.points.copy(), mesh.triangles, mesh.label, mesh.size)
    moved.edges, moved.kind, moved.is_border, moved.wing = mesh.edges, mesh.kind, mesh.is_border, mesh.wing
    moved.points[stay] = target
    project(moved, stay[same], reference)
    target = moved.points[stay]
    position = mesh.points.copy()
    position[stay] = position[gone] = target
    owner = np.full(len(mesh.points), -1)
    owner[a] = owner[b] = np.arange(len(chosen))
    touched = owner[mesh.triangles]
    edge_of = touched.max(axis=1)
    both = (touched >= 0).sum(axis=1) == 2
    ring = np.flatnonzero((edge_of >= 0) & ~both)
    bad = turned(mesh, position, ring)
    # worse than the worst that is there, and poor: refused
    star = np.flatnonzero(edge_of >= 0)
    poorest_before, poorest_after = np.full(len(chosen), np.inf), np.full(len(chosen), np.inf)
    np.minimum.at(poorest_before, edge_of[star], shape_quality(mesh.points[mesh.triangles[star]]))
    np.minimum.at(poorest_after, edge_of[ring], shape_quality(position[mesh.triangles[ring]]))
    worse = (poorest_after < 0.1) & (poorest_after < poorest_before)
    new = position[mesh.triangles[ring]]
    longest = np.linalg.norm(new - np.roll(new, 1, axis=1), axis=2).max(axis=1)
    before = np.linalg.norm(mesh.points[mesh.triangles[ring]] - np.roll(mesh.points[mesh.triangles[ring]], 1, axis=1), axis=2)
    bad |= longest > np.maximum(1.4 * mesh.size[mesh.triangles[ring]].mean(axis=1), before.max(axis=1) * 1.02)
    refused = worse
    refused[edge_of[ring][bad]] = True
    # two collapses may share an opposite point, and each takes one neighbour from it
    opposite = mesh.opposite[chosen]
    left = mesh.valence - np.bincount(opposite[~refused].ravel(), minlength=len(mesh.points))
    refused |= (left[opposite] < 3).any(axis=1)
    ok = ~refused
    np.add.at(mesh.refusals, mesh.edges[chosen[refused]].ravel(), 1.0)
    if not ok.any():
        return 0
    mesh.points[stay[ok]] = target[ok]
    mesh.refusals[stay[ok]] = 0.0
    mesh.size[stay[ok]] = asked(target[ok])
    to = np.arange(len(mesh.points))
    to[gone[ok]] = stay[ok]
    triangles = to[mesh.triangles]
    alive = (triangles[:, 0] != triangles[:, 1]) & (triangles[:, 1] != triangles[:, 2]) & (triangles[:, 2] != triangles[:, 0])
    used, local = np.unique(triangles[alive], return_inverse=True)
    mesh.points, mesh.size, mesh.refusals = mesh.points[used], mesh.size[used], mesh.refusals[used]
    mesh.triangles, mesh.label = local.reshape(-1, 3), mesh.label[alive]
    return int(ok.sum())
