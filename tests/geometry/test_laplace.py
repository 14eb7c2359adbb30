"""Harmonic fields with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.base.errors import AnatomyError
from lacli.geometry import laplace


def box(n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Unit cube in 5 n^3 ... tetrahedra of a Delaunay triangulation, points jittered inside."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(3)
    points = np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    inner = ((points > 0) & (points < 1)).all(axis=1)
    points[inner] += rng.uniform(-0.05, 0.05, (int(inner.sum()), 3))
    tets = Delaunay(points).simplices.astype(np.int64)
    volume = np.abs(np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]))
    return points, tets[volume > 1e-6]


@given(a=st.floats(-3, 3), b=st.floats(-3, 3), c=st.floats(-3, 3), d=st.floats(-3, 3))
def test_a_linear_field_is_found_exactly_and_its_gradient_is_constant(a: float, b: float, c: float, d: float) -> None:
    points, tets = box()
    exact = a + points @ [b, c, d]
    outside = np.flatnonzero(((points == 0) | (points == 1)).any(axis=1))
    grad = laplace.gradient(points, tets)
    field = laplace.solve(laplace.stiffness(grad, len(points)), (outside, exact[outside]))
    # linear functions are harmonic and in the space of linear elements
    assert field == pytest.approx(exact, abs=1e-8)
    assert grad.of(field) == pytest.approx(np.tile([b, c, d], (len(tets), 1)), abs=1e-6)


def test_a_ring_has_the_logarithm_of_the_radius() -> None:
    # u = ln r / ln 2 between r = 1 and 2 on a flat annulus of triangles; second-order error
    rings, around = 17, 96
    r = np.linspace(1, 2, rings)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    points = np.array([[x * np.cos(t), x * np.sin(t), 0.0] for x in r for t in angle])
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    a, b = (i * around + j).ravel(), (i * around + (j + 1) % around).ravel()
    triangles = np.vstack([np.column_stack([a, a + around, b]), np.column_stack([b, a + around, b + around])])
    matrix = laplace.stiffness(laplace.gradient(points, triangles), len(points))
    field = laplace.solve(matrix, {0.0: np.arange(around), 1.0: np.arange(around) + (rings - 1) * around})
    assert field == pytest.approx(np.log(np.linalg.norm(points, axis=1)) / np.log(2), abs=1.5e-3)


def test_a_flat_cell_and_an_empty_boundary_are_refused() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    with pytest.raises(AnatomyError, match="no volume"):
        laplace.gradient(points, np.array([[0, 1, 2]]))
    points, tets = box(3)
    matrix = laplace.stiffness(laplace.gradient(points, tets), len(points))
    with pytest.raises(AnatomyError, match="boundary value 1"):
        laplace.solve(matrix, {0.0: np.array([0]), 1.0: np.zeros(0, dtype=np.int64)})


def test_a_part_without_a_boundary_value_is_refused() -> None:
    points, tets = box(3)
    both = np.vstack([points, points + np.array([5.0, 0, 0])])
    matrix = laplace.stiffness(laplace.gradient(both, np.vstack([tets, tets + len(points)])), len(both))
    ends = {0.0: np.flatnonzero(points[:, 0] == 0), 1.0: np.flatnonzero(points[:, 0] == 1)}
    with pytest.raises(AnatomyError, match="not connected to any boundary value"):
        laplace.solve(matrix, ends)
    ends[2.0] = np.array([len(points)])
    assert laplace.solve(matrix, ends)[len(points) :] == pytest.approx(2.0, abs=1e-8)
