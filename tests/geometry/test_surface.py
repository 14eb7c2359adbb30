"""Surfaces, cells, prisms: volumes and quality against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes import icosphere

from lacli.base.errors import AnatomyError
from lacli.geometry import curves
from lacli.geometry.prisms import shorter_diagonals, split_prisms
from lacli.geometry.quadrature import enclosed_volume_ml
from lacli.geometry.surface import Surface, check, defects, unique_edges
from lacli.geometry.tetrahedra import boundary_faces, curved_jacobian, elevate, scaled_jacobian, volumes

CORNER = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def corner(**changes: object) -> Surface:
    values = {"points": CORNER, "triangles": FACES, "label": np.zeros(4, dtype=np.int64), **changes}
    return Surface(**values)  # type: ignore[arg-type]


def test_a_box_corner_has_a_sixth_of_the_cube() -> None:
    assert corner().volume_ml() == pytest.approx(1000 / 6 / 1000, rel=1e-12)
    # three right triangles of 50 mm2 and an equilateral one of side sqrt(200): sqrt(3)/4 * 200
    assert corner().area_mm2() == pytest.approx(150 + np.sqrt(3) * 50, rel=1e-12)
    check(corner())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"triangles": FACES[:3], "label": np.zeros(3, dtype=np.int64)}, "3 open edges"),
        ({"triangles": FACES[:, ::-1]}, "inside out"),
        ({"triangles": np.vstack([FACES[:3], FACES[3:, ::-1]])}, "twice in one direction"),
        ({"points": CORNER * np.array([1, 1, np.nan])}, "not finite"),
        ({"label": np.zeros(3, dtype=np.int64)}, "one value per triangle"),
    ],
)
def test_bad_surfaces_are_named(changes: dict[str, object], words: str) -> None:
    with pytest.raises(AnatomyError, match=words):
        check(corner(**changes))


@settings(max_examples=20, deadline=None)
@given(st.floats(-3, 3), st.integers(0, 2))
def test_a_bent_edge_adds_a_third_of_area_times_height(height: float, axis: int) -> None:
    """The edge's shape function 4 l0 l1 has the mean 1/3 over a triangle, and moving it along one line is linear in volume."""
    points, tets, triangles = elevate(CORNER, np.array([[0, 1, 2, 3]]), FACES)
    assert enclosed_volume_ml(triangles, points) == pytest.approx(1 / 6, rel=1e-12)
    middle = tets[0, 4]  # of the edge along x, between the faces z = 0 and y = 0 (normals -z and -y, 50 mm2 each)
    moved = points.copy()
    moved[middle, axis] += height
    expected = {0: 0.0, 1: -height * 50 / 3, 2: -height * 50 / 3}[axis]
    assert 1000 * enclosed_volume_ml(triangles, moved) == pytest.approx(1000 / 6 + expected, abs=1e-9)


def test_curved_triangles_carry_a_sphere_to_fourth_order() -> None:
    exact = 4 / 3 * np.pi * 20**3 / 1000
    errors = []
    for subdivisions in (2, 3):
        sphere = icosphere(20.0, subdivisions)
        edges, of_triangle = unique_edges(sphere.triangles)
        middle = sphere.points[edges].mean(axis=1)
        middle *= 20.0 / np.linalg.norm(middle, axis=1, keepdims=True)
        six = np.column_stack([sphere.triangles, len(sphere.points) + of_triangle])
        errors.append(abs(enclosed_volume_ml(six, np.vstack([sphere.points, middle])) / exact - 1))
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] > 12  # 2^4 in the limit


def test_scaled_jacobian_of_known_shapes() -> None:
    regular = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    # the box corner: det = 1000; largest corner product of lengths at the far corners 10 * sqrt(200)^2 = 2000
    both = np.vstack([regular, CORNER])
    tets = np.array([[0, 2, 1, 3], [4, 5, 6, 7]])
    assert scaled_jacobian(both, tets) == pytest.approx(
        [np.sign(volumes(both, tets[:1]))[0], np.sqrt(2) * 1000 / 2000], rel=1e-12
    )


def test_a_quarter_point_node_folds_at_its_corner() -> None:
    """The slope along an edge at its first corner is 4 m - 3 x0 - x1: zero where the middle node sits at a quarter."""
    points, tets, _ = elevate(CORNER, np.array([[0, 1, 2, 3]]), FACES)
    assert curved_jacobian(points, tets) == pytest.approx([1.0])
    points[tets[0, 4]] = [2.5, 0, 0]
    assert curved_jacobian(points, tets) == pytest.approx([0.0], abs=1e-12)
    points[tets[0, 4]] = [2.0, 0, 0]
    assert curved_jacobian(points, tets)[0] < 0


@pytest.mark.parametrize("shorter", [False, True])
def test_split_prisms_fill_the_shell_and_fit_each_other(shorter: bool) -> None:
    sphere = icosphere(20.0, 2)
    rng = np.random.default_rng(1)
    vector = sphere.points * (0.1 + 0.03 * rng.random((len(sphere.points), 1)))
    n = len(sphere.points)
    edges, of_triangle = unique_edges(sphere.triangles)
    starts = shorter_diagonals(sphere.points, vector, sphere.triangles, edges, of_triangle) if shorter else None
    tets = split_prisms(sphere.triangles, sphere.triangles + n, starts)
    points = np.vstack([sphere.points, sphere.points + vector])
    assert volumes(points, tets).min() > 0
    faces, _ = boundary_faces(tets)
    assert len(faces) == 2 * len(sphere.triangles)  # nothing but the two spheres: all sides match
    assert defects(faces) == ""
    outer = Surface(points[n:], sphere.triangles, sphere.label)
    assert volumes(points, tets).sum() / 1000 == pytest.approx(outer.volume_ml() - sphere.volume_ml(), rel=1e-12)


def test_sides_that_share_an_edge() -> None:
    # two triangles over the edge 1 - 2: side 1 of the first, side 0 of the second
    sides, edge = curves.side_pairs(curves.edge_table(np.array([[0, 1, 2], [2, 1, 3]]))[2])
    assert sides.tolist() == [[1, 3]] and len(edge) == 1
