"""Curvatures of shapes whose curvatures are known."""

from __future__ import annotations

import numpy as np
import pytest
import pyvista as pv

from lacli.geometry.curvature import curvature_sum


def of(mesh: pv.PolyData) -> tuple[np.ndarray, np.ndarray]:
    mesh = mesh.triangulate().clean()
    return np.asarray(mesh.points, dtype=float), mesh.regular_faces.astype(np.int64)


def test_a_ball_outside_and_inside() -> None:
    points, triangles = of(pv.Icosphere(radius=20.0, nsub=4))
    # 1 / r twice; a fit over 6 mm of a ball of 20 sees the fourth order too: a part in (6 / 20)^2 / 4 at most
    assert curvature_sum(points, triangles, 6.0) == pytest.approx(2 / 20, rel=0.03)
    assert curvature_sum(points, triangles[:, ::-1], 6.0) == pytest.approx(-2 / 20, rel=0.03)


def test_a_tube_and_a_saddle() -> None:
    tube = pv.CylinderStructured(radius=10.0, height=40.0, theta_resolution=80, z_resolution=50).extract_surface(algorithm=None)
    points, triangles = of(tube)
    middle = np.abs(points[:, 0]) < 12.0  # of its axis
    # 1 / r one way, none the other; a tube's own fourth order is (3 / 10)^2 / 5 of it within 3 mm
    assert np.abs(curvature_sum(points, triangles, 3.0)[middle]) == pytest.approx(1 / 10, rel=0.03)
    # z = (x^2 - y^2) / 40: 1 / 20 one way, -1 / 20 the other at the middle
    x, y = np.meshgrid(np.linspace(-15, 15, 31), np.linspace(-15, 15, 31))
    grid = pv.StructuredGrid(x, y, (x * x - y * y) / 40).extract_surface(algorithm=None)
    points, triangles = of(grid)
    at = np.linalg.norm(points[:, :2], axis=1).argmin()
    assert curvature_sum(points, triangles, 6.0)[at] == pytest.approx(0.0, abs=1e-6)


def test_where_too_few_nodes_are_near_there_is_no_curvature() -> None:
    points, triangles = of(pv.Icosphere(radius=20.0, nsub=1))
    found = curvature_sum(np.vstack([points, [[0.0, 0, 0]]]), triangles, 6.0)
    assert np.isnan(found).all()
