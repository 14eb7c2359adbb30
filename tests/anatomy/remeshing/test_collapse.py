"""Short edges collapse: fewer points, the same closed surface, the border still the border."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import HEIGHT, RIM, cut_ball

from lacli.anatomy.remeshing.collapse import collapse
from lacli.anatomy.remeshing.projection import Reference, border_edges
from lacli.anatomy.remeshing.workmesh import WorkMesh
from lacli.geometry.surface import Surface, defects


def collapsed(size: float) -> tuple[WorkMesh, Surface]:
    ball = cut_ball()
    mesh = WorkMesh(ball.points.copy(), ball.triangles.copy(), ball.label.copy(), np.full(len(ball.points), size))
    collapse(mesh, Reference(ball), lambda points: np.full(len(points), size))
    return mesh, ball


def test_the_surface_stays_closed_and_where_it_is() -> None:
    mesh, ball = collapsed(4.0)
    assert defects(mesh.triangles) == ""
    done = Surface(mesh.points, mesh.triangles, mesh.label)
    assert len(mesh.points) < 0.4 * len(ball.points)
    assert done.volume_ml() == pytest.approx(ball.volume_ml(), rel=0.02)
    assert set(mesh.label.tolist()) == {0, 21}
    mesh.refresh()
    assert np.median(mesh.length) > 0.8 * 4.0  # all were below 1.8 mm
    assert mesh.length.max() < 1.8 * 4.0
    rim = mesh.points[np.unique(border_edges(mesh.triangles, mesh.label))]
    assert rim[:, 2] == pytest.approx(HEIGHT, abs=1e-6)
    assert np.hypot(rim[:, 0], rim[:, 1]) == pytest.approx(RIM, abs=0.1)


def test_edges_that_are_long_enough_are_left() -> None:
    mesh, ball = collapsed(0.1)
    assert (mesh.points == ball.points).all() and (mesh.triangles == ball.triangles).all()
