"""Faces cut into smaller triangles: no gaps, on the curved geometry, the mesh's own nodes among the points."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import icosphere

from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry.quadrature import enclosed_volume_ml
from lacli.geometry.subdivision import straight, subdivide
from lacli.geometry.triangles import area_normals

RADIUS = 20.0


def ball(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of 80 faces that start at different corners; the middles of 6-node faces lie on the sphere."""
    surface = icosphere(RADIUS, 1)
    turn = (np.arange(len(surface.triangles))[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(surface.triangles, turn, axis=1)
    if nodes == 3:
        return surface.points, faces
    edges, _, of = paths.edge_table(faces)
    middle = surface.points[edges].mean(axis=1)
    middle *= RADIUS / np.linalg.norm(middle, axis=1, keepdims=True)
    return np.vstack([surface.points, middle]), np.hstack([faces, len(surface.points) + of])


def area(points: np.ndarray, triangles: np.ndarray) -> float:
    return float(np.linalg.norm(area_normals(points[triangles]), axis=1).sum() / 2.0)


@pytest.mark.parametrize(("nodes", "k"), [(3, 1), (3, 2), (3, 5), (6, 2), (6, 4), (6, 6)])
def test_a_closed_surface_stays_closed(nodes: int, k: int) -> None:
    points, faces = ball(nodes)
    fine = subdivide(points, faces, k)
    edges, count, _ = paths.edge_table(fine.triangles)
    assert len(fine.triangles) == len(faces) * k * k
    assert (count == 2).all()
    assert len(edges) == 3 * len(fine.triangles) // 2
    assert len(fine.points) - len(edges) + len(fine.triangles) == 2
    assert np.array_equal(np.unique(fine.triangles), np.arange(len(fine.points)))
    # all turned as their faces: outward, and each near the face that it names
    middle = fine.points[fine.triangles].mean(axis=1)
    assert (np.einsum("td,td->t", area_normals(fine.points[fine.triangles]), middle) > 0).all()
    face = points[faces[fine.source, :3]].mean(axis=1)
    assert np.linalg.norm(middle - face, axis=1).max() < np.linalg.norm(points[faces[:, 0]] - points[faces[:, 1]], axis=1).max()


@pytest.mark.parametrize(("nodes", "k"), [(3, 3), (6, 2), (6, 4)])
def test_own_nodes_are_points_of_their_own(nodes: int, k: int) -> None:
    points, faces = ball(nodes)
    fine = subdivide(points, faces, k)
    own = fine.node >= 0
    assert np.array_equal(np.sort(fine.node[own]), np.unique(faces))
    assert np.array_equal(fine.points[own], points[fine.node[own]])


def test_faces_that_run_an_edge_opposite_ways_or_alike_share_its_points() -> None:
    points = np.array([[0.0, 0, 0], [6, 0, 0], [3, 5, 0], [3, -5, 0]])
    for second in ([1, 0, 3], [0, 1, 3]):
        fine = subdivide(points, np.array([[0, 1, 2], second]), 3)
        assert len(fine.points) == 10 + 10 - 4
        assert len(np.unique(fine.points, axis=0)) == 16
        assert len(paths.open_edges(fine.triangles)) == 12


def test_points_lie_on_the_curved_faces() -> None:
    points, faces = ball(6)
    fine = [subdivide(points, faces, k) for k in (2, 4, 8, 16)]
    areas = [area(f.points, f.triangles) for f in fine]
    volumes = [enclosed_volume_ml(f.triangles, f.points) for f in fine]
    # flat triangles miss a share that falls with their size squared
    for values in (areas, volumes):
        assert (values[1] - values[0]) / (values[2] - values[1]) == pytest.approx(4.0, rel=0.05)
        assert (values[2] - values[1]) / (values[3] - values[2]) == pytest.approx(4.0, rel=0.02)
    # the limits: the curved faces' own volume, integrated exactly, and their area, 0.14 % below the sphere's
    assert volumes[3] + (volumes[3] - volumes[2]) / 3.0 == pytest.approx(enclosed_volume_ml(faces, points), rel=1e-6)
    assert areas[3] + (areas[3] - areas[2]) / 3.0 == pytest.approx(4.0 * np.pi * RADIUS**2, rel=2e-3)
    flat = subdivide(*ball(3), 4)
    assert area(flat.points, flat.triangles) == pytest.approx(area(*ball(3)), rel=1e-12)


def test_quarters_are_the_subdivision_by_two() -> None:
    points, faces = ball(6)
    fine = subdivide(points, faces, 2)
    assert np.array_equal(fine.node[fine.triangles], straight(faces))
    assert np.array_equal(straight(faces[:, :3]), faces[:, :3])


def test_middles_that_are_no_points_of_the_lattice_are_refused() -> None:
    with pytest.raises(AnatomyError, match="6 nodes cannot be cut in 3"):
        subdivide(*ball(6), 3)
    with pytest.raises(AnatomyError, match="3 nodes cannot be cut in 0"):
        subdivide(*ball(3), 0)
