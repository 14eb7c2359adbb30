"""Edge lengths where a surface bends: short on tight bends, as asked on gentle ones, growing slowly in between."""

from __future__ import annotations

import numpy as np
import pytest
import pyvista as pv

from lacli.anatomy.remeshing import bends
from lacli.anatomy.remeshing.projection import Reference
from lacli.anatomy.remeshing.remesh import remesh_on
from lacli.geometry.surface import Surface, unique_edges


def capsule(radius: float, length: float, step: float) -> Surface:
    """A closed tube of ``radius`` mm with round ends."""
    n = np.ceil(np.array([2 * radius + 4, 2 * radius + 4, length + 2 * radius + 4]) / step).astype(int)
    grid = pv.ImageData(dimensions=n + 1, spacing=(step,) * 3, origin=-0.5 * n * step)
    x = np.asarray(grid.points)
    x = x - np.array([0, 0, 1]) * np.clip(x[:, 2], -length / 2, length / 2)[:, None]
    grid["d"] = np.linalg.norm(x, axis=1) - radius
    mesh = grid.contour([0.0], scalars="d").triangulate().clean()
    return Surface(np.asarray(mesh.points, dtype=float), mesh.regular_faces[:, ::-1], np.zeros(mesh.n_cells, dtype=np.int64))


def test_a_wide_ball_asks_for_nothing() -> None:
    ball = pv.Icosphere(radius=20.0, nsub=5)
    surface = Surface(np.asarray(ball.points, dtype=float), ball.regular_faces, np.zeros(ball.n_cells, dtype=np.int64))
    # a turn of TURN along one edge takes 20 mm x 1.3 = 26 mm on it
    assert bends.limits(surface, 3.5) is None


def test_a_thin_tube_gets_edges_by_its_radius() -> None:
    surface = capsule(2.0, 30.0, 0.5)
    asked = bends.limits(surface, 6.0)
    assert asked is not None
    middle = asked(np.array([[2.0, 0.0, 0.0]]))[0]
    # across the tube the normal turns by 1 rad per 2 mm, along it not at all: root mean square half of that in square
    assert middle == pytest.approx(bends.TURN * 2.0, rel=0.35)
    assert asked(np.array([[2.0 + 50.0, 0.0, 0.0]]))[0] == 6.0


def test_the_remeshed_tube_is_round_and_not_flat() -> None:
    surface = capsule(2.0, 30.0, 0.5)
    made = remesh_on(Reference(surface), 6.0)
    edges, _ = unique_edges(made.triangles)
    length = np.linalg.norm(made.points[edges[:, 0]] - made.points[edges[:, 1]], axis=1)
    assert length.max() < 6.0
    # four sides round the tube or more: a square's area is 2/pi of its circle's
    assert made.volume_ml() > 2.0 / np.pi * surface.volume_ml()
