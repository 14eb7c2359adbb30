"""The surface while it is remeshed: what kind its points are, what would turn, and collapsing short edges."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import cut_ball, icosphere

from lacli.anatomy.cuts.caps import rim_loops
from lacli.anatomy.remeshing.collapse import collapse
from lacli.anatomy.remeshing.projection import Reference
from lacli.anatomy.remeshing.workmesh import BORDER, INNER, WorkMesh, project, turned
from lacli.geometry.surface import Surface


def work(surface: Surface, size: float) -> WorkMesh:
    mesh = WorkMesh(surface.points.copy(), surface.triangles.copy(), surface.label.copy(), np.full(len(surface.points), size))
    mesh.refresh()
    return mesh


def test_points_of_a_cut_ball_are_inside_or_on_its_rim() -> None:
    ball = cut_ball()
    mesh = work(ball, 3.0)
    rim = np.isclose(ball.points[:, 2], 14.0) & np.isclose(np.hypot(*ball.points[:, :2].T), np.sqrt(20.0**2 - 14.0**2), atol=0.05)
    assert (mesh.kind[rim] == BORDER).all() and (mesh.kind[~rim] == INNER).all()
    assert len(ball.points) - len(mesh.edges) + len(mesh.triangles) == 2  # Euler
    assert mesh.valence.sum() == 2 * len(mesh.edges)
    a, b = mesh.edges[0]
    assert mesh.length[0] == pytest.approx(np.linalg.norm(ball.points[a] - ball.points[b]))


def test_points_go_back_to_their_patch_and_their_border() -> None:
    ball = cut_ball()
    mesh, before = work(ball, 3.0), ball.points.copy()
    rng = np.random.default_rng(1)
    mesh.points += 0.2 * rng.normal(size=mesh.points.shape)
    project(mesh, np.arange(len(mesh.points)), Reference(ball))
    border = mesh.kind == BORDER
    assert np.abs(mesh.points[border, 2] - 14.0).max() < 1e-6
    cap = np.unique(ball.triangles[ball.label == 21])
    assert np.abs(mesh.points[cap, 2] - 14.0).max() < 1e-6
    assert np.abs(np.linalg.norm(mesh.points[~np.isin(np.arange(len(before)), cap)], axis=1) - 20.0).max() < 0.1


def test_a_triangle_that_is_turned_over_is_seen_and_one_that_is_not_is_not() -> None:
    mesh = work(icosphere(10.0, 2), 3.0)
    everywhere = np.arange(len(mesh.triangles))
    assert not turned(mesh, mesh.points, everywhere).any()
    position = mesh.points.copy()
    a, b, c = mesh.triangles[0]
    position[a] = position[b] + position[c] - position[a]  # over its opposite side
    assert turned(mesh, position, np.array([0])).all()


def test_short_edges_go_and_the_shape_stays() -> None:
    ball = cut_ball()
    mesh = work(ball, 5.0)
    before = len(mesh.triangles)
    collapse(mesh, Reference(ball), lambda points: np.full(len(points), 5.0))
    mesh.refresh()
    assert len(mesh.triangles) < 0.5 * before
    assert np.quantile(mesh.length, 0.1) > 0.6 * 5.0 and np.quantile(mesh.length, 0.9) < 1.5 * 5.0
    assert rim_loops(mesh.triangles) == [], "closed still"
    assert set(np.unique(mesh.label)) == {0, 21}
    made = Surface(mesh.points, mesh.triangles, mesh.label)
    assert made.volume_ml() == pytest.approx(ball.volume_ml(), rel=0.05)
    assert len(mesh.points) - len(mesh.edges) + len(mesh.triangles) == 2
