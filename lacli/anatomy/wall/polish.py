"""The last poor cells of a shell: their outer points moved one by one to where the worst cell around them is best."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.geometry.prisms import split_prisms
from lacli.geometry.tetrahedra import scaled_jacobian

ROUNDS = 8
TRIES = 30


def polish(points: FloatArray, vector: FloatArray, triangles: IntArray, starts: np.ndarray, fair: FloatArray) -> FloatArray:
    """Vectors (n, 3) mm to the outer points, changed by at most about half their length near cells below ``fair`` (3t,).

    A search by seeded random steps: the worst quality is not differentiable, and there are few such points. The diagonals
    ``starts`` (t, 3) of the prisms stay as they are.
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
        position = np.vstack([points, points + vector])
        quality = scaled_jacobian(position, tets)
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
            trial = np.broadcast_to(position[local], (len(candidate), *local.shape, 3)).copy()
            trial[:, local == n + v] = (points[v] + candidate)[:, None]
            flat = trial.reshape(-1, 4, 3)
            value = scaled_jacobian(flat.reshape(-1, 3), np.arange(4 * len(flat)).reshape(-1, 4)).reshape(len(candidate), -1)
            # the worst cell rules; those that are good enough do not count
            score = np.minimum(value, np.minimum(fair[around], 0.25)).min(axis=1) + 1e-3 * np.minimum(value, 0.25).mean(axis=1)
            best = int(np.argmax(score))
            vector[v] = candidate[best]
            position[n + v] = points[v] + candidate[best]
    return vector
