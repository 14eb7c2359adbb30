"""The atrium's own axes: what they are for a heart in the image's axes, and in any other position."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lacli.anatomy.coordinates.frame import frame_from_openings, height, sectors, sweep, two_layer_fibres, unit
from lacli.contracts.labels import REGIONS

# left +x, anterior -y (veins open to the back, +y), roof +z
OPENINGS = {
    "mv": np.array([0.0, 0, -20]), "lspv": np.array([20.0, 15, 8]), "lipv": np.array([20.0, 15, -8]),
    "rspv": np.array([-20.0, 15, 8]), "ripv": np.array([-20.0, 15, -8]),
}  # fmt: skip
ZERO = np.zeros(3)


def test_axes_of_a_heart_that_stands_straight() -> None:
    frame = frame_from_openings(ZERO, OPENINGS)
    assert frame.left.tolist() == [1, 0, 0] and frame.roof.tolist() == [0, 0, 1] and frame.anterior.tolist() == [0, -1, 0]
    assert frame.components(np.array([[1.0, 2, 3]])).tolist() == [[1, -2, 3]]


def test_regions_are_a_cone_and_four_quadrants() -> None:
    frame = frame_from_openings(ZERO, OPENINGS)
    # 50 degrees from the roof's axis is the cone's side: 49 is roof, 51 is not
    at = lambda deg: np.array([np.sin(np.radians(deg)), 0, np.cos(np.radians(deg))])  # noqa: E731
    points = np.array([[0, 0, 9.0], at(49), at(51), [-9, 1, 0], [9, 1, 0], [1, 9, 0], [1, -9, 0]])
    names = ["roof", "roof", "lateral", "septum", "lateral", "posterior", "anterior"]
    assert sectors(frame, points).tolist() == [REGIONS[name] for name in names]


def test_height_and_sweep_at_their_ends() -> None:
    frame = frame_from_openings(ZERO, OPENINGS)
    points = np.array([[0, 0, -20.0], [0, 0, 0], [0, 0, 20], [0, 0, -30]])
    assert height(frame, points) == pytest.approx([0, 0.5, 1, 0])
    # alpha by angle from the septum to the lateral side; beta: 270 degrees from the back's foot over the roof to the front's
    ends = sweep(frame, np.array([[-5.0, 0, 0], [5, 0, 0], [0, 0, 5], [0, 5, 0], [0, -5, 0]]))
    assert ends[:, 0] == pytest.approx([0, 1, 0.5, 0.5, 0.5])
    assert ends[2:, 1] == pytest.approx([0.5, 0.5 - 90 / 270, 0.5 + 90 / 270])


@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.lists(st.floats(-90, 90), min_size=3, max_size=3))
def test_the_place_of_the_heart_in_the_image_changes_nothing(turn: list[float], shift: list[float]) -> None:
    moved = lambda x: Rotation.from_rotvec(turn).apply(x) + shift  # noqa: E731
    points = np.random.default_rng(3).normal(size=(40, 3)) * 20
    here, there = (
        frame_from_openings(ZERO, OPENINGS),
        frame_from_openings(moved(ZERO), {name: moved(x) for name, x in OPENINGS.items()}),
    )
    assert np.allclose(here.components(points), there.components(moved(points)), atol=1e-9)
    assert (sectors(here, points) == sectors(there, moved(points))).all()


def test_fibres_are_unit_in_the_wall_and_turn_a_right_angle_half_way() -> None:
    frame = frame_from_openings(ZERO, OPENINGS)
    normals = unit(np.random.default_rng(1).normal(size=(200, 3)))
    normals[0] = frame.roof
    inner = two_layer_fibres(frame, normals, np.full(200, 0.49))
    outer = two_layer_fibres(frame, normals, np.full(200, 0.5))
    for fibre in (inner, outer):
        assert np.linalg.norm(fibre, axis=1) == pytest.approx(1)
        assert np.abs(np.einsum("ij,ij->i", fibre, normals)).max() < 1e-12
    assert np.abs(np.einsum("ij,ij->i", inner, outer)).max() < 1e-12
    steep = np.hypot(normals[:, 0], normals[:, 1]) > 0.1  # else the rule has no direction
    assert steep.sum() > 150 and np.abs(inner[steep] @ frame.roof).max() < 1e-9  # round the valve's axis


def test_a_vector_of_no_length_stays() -> None:
    assert unit(np.array([[0.0, 0, 0], [3, 0, 4]])).tolist() == [[0, 0, 0], [0.6, 0, 0.8]]
