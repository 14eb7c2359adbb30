"""Poor cells of a shell get better and good ones are left; nothing moves farther than half its length."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import icosphere

from lacli.anatomy.wall.polish import polish
from lacli.geometry.prisms import shorter_diagonals, split_prisms
from lacli.geometry.surface import unique_edges
from lacli.geometry.tetrahedra import scaled_jacobian

BALL = icosphere(20.0, 2)


def prepared(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edges, of_triangle = unique_edges(BALL.triangles)
    starts = shorter_diagonals(BALL.points, vector, BALL.triangles, edges, of_triangle)
    return starts, split_prisms(BALL.triangles, BALL.triangles + len(BALL.points), starts)


def quality(vector: np.ndarray, tets: np.ndarray) -> np.ndarray:
    return scaled_jacobian(np.vstack([BALL.points, BALL.points + vector]), tets)


def test_a_good_shell_is_left_as_it_is() -> None:
    vector = 0.1 * BALL.points
    starts, tets = prepared(vector)
    fair = np.full(len(tets), 0.9 * quality(vector, tets).min())
    assert (polish(BALL.points, vector, BALL.triangles, starts, fair) == vector).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_pushed_point_s_cells_get_better_and_far_ones_stay(seed: int) -> None:
    vector = 0.1 * BALL.points
    rng = np.random.default_rng(seed)
    bad = int(rng.integers(len(vector)))
    side = np.cross(BALL.points[bad], rng.normal(size=3))
    vector[bad] += 6.0 * side / np.linalg.norm(side)
    starts, tets = prepared(vector)
    before = quality(vector, tets)
    fair = np.full(len(tets), 0.2)
    assert before.min() < 0.2
    done = polish(BALL.points, vector, BALL.triangles, starts, fair)
    after = quality(done, tets)
    assert after.min() > before.min()
    moved = np.flatnonzero(np.linalg.norm(done - vector, axis=1) > 0)
    near = np.unique(tets[before < 0.2] % len(vector))
    assert len(moved) > 0 and set(moved) <= set(np.unique(BALL.triangles[np.isin(BALL.triangles, near).any(axis=1)]).tolist())
    length = np.linalg.norm(vector, axis=1)
    assert (np.linalg.norm(done - vector, axis=1) <= 0.5 * length + 1e-12).all()
    # the same once more: its steps are seeded
    assert (polish(BALL.points, vector, BALL.triangles, starts, fair) == done).all()
