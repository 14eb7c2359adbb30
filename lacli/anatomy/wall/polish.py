"""The last poor cells of a shell: their outer points moved one by one to where the worst cell around them is best."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.geometry.prisms import split_prisms
from lacli.geometry.tetrahedra import scaled_jacobian

ROUNDS = 8
TRIES = 30


def layer_quality(points: FloatArray, vector: FloatArray, tets: IntArray, layers: int) -> FloatArray:
    """Least scaled Jacobian (3t,) of the innermost and the outermost layer's cells of each prism; ``tets`` (3t, 4): the cells
    between ``points`` (n, 3) and their tops, numbered n and up."""
    return np.minimum.reduce(
        [scaled_jacobian(np.vstack([points + a * vector, points + b * vector]), tets) for a, b in _ends(layers)]
    )


def _ends(layers: int) -> list[tuple[float, float]]:
    """Share of the vector at the lower and upper side of the innermost and the outermost layer."""
    ends = [(0.0, 1.0 / layers)]
    return ends if layers == 1 else [*ends, (1.0 - 1.0 / layers, 1.0)]


def polish(
    points: FloatArray, vector: FloatArray, triangles: IntArray, starts: np.ndarray, fair: FloatArray, layers: int = 1
) -> FloatArray:
    """Vectors (n, 3) mm to the outer points, changed by at most about half their length near cells below ``fair`` (3t,).

    ``layers``: of cells that the vectors are cut in. A search by seeded random steps: the worst quality is not differentiable,
    and there are few such points. The diagonals ``starts`` (t, 3) of the prisms stay as they are.
    """
    rng = np.random.default_rng(11)
    n = len(points)
    tets = split_prisms(triangles, triangles + n, starts)
    vector = vector.copy()
    length = np.linalg.norm(vector, axis=1)
    first = vector.copy()
    order = np.argsort(tets.ravel() % n, kind="stable")
    begin = np.searchsorted((tets.ravel() % n)[order], np.arange(n + 1))
    for turn in range(ROUNDS):
        quality = layer_quality(points, vector, tets, layers)
        poor = quality < fair
        if not poor.any():
            break
        for v in np.unique(tets[poor] % n):
            around = np.unique(order[begin[v] : begin[v + 1]] // 4)
            local = tets[around]
            step = rng.normal(size=(TRIES, 3)) * (0.3 * 0.8**turn) * length[v] / np.sqrt(3)
            step[0] = 0.0
            step[1] = -0.15 * vector[v]
            candidate = vector[v] + step
            candidate = candidate[np.linalg.norm(candidate - first[v], axis=1) < 0.5 * length[v]]
            if len(candidate) == 0:
                continue
            value = np.minimum.reduce([_tried(points, vector, local, v, candidate, ends) for ends in _ends(layers)])
            # the worst cell rules; those that are good enough do not count
            score = np.minimum(value, np.minimum(fair[around], 0.25)).min(axis=1) + 1e-3 * np.minimum(value, 0.25).mean(axis=1)
            best = int(np.argmax(score))
            vector[v] = candidate[best]
    return vector


def _tried(
    points: FloatArray, vector: FloatArray, local: IntArray, v: int, candidate: FloatArray, ends: tuple[float, float]
) -> FloatArray:
    """Scaled Jacobian (c, k) of the cells ``local`` (k, 4) between two shares of the vectors, point v's being each candidate."""
    n = len(points)
    foot, share = local % n, np.where(local < n, *ends)
    place = points[foot] + share[..., None] * vector[foot]
    trial = np.broadcast_to(place, (len(candidate), *place.shape)).copy()
    mine = foot == v
    trial[:, mine] = points[v] + share[mine][:, None] * candidate[:, None]
    flat = trial.reshape(-1, 4, 3)
    return scaled_jacobian(flat.reshape(-1, 3), np.arange(4 * len(flat)).reshape(-1, 4)).reshape(len(candidate), -1)
