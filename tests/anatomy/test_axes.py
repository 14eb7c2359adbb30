"""The atrium's own axes, and the regions, heights and fibres that follow by rule."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.anatomy.coordinates.frame import frame_from_openings, height, sectors, sweep, two_layer_fibres, unit
from lacli.contracts.labels import REGIONS

# LPS: x to the left, y to the back, z up; the valve below and a little to the left
OPENINGS = {
    "mv": np.array([10.0, 0.0, -30.0]), "rspv": np.array([-30.0, 10.0, 10.0]), "ripv": np.array([-30.0, 15.0, -10.0]),
    "lspv": np.array([30.0, 10.0, 10.0]), "lipv": np.array([30.0, 15.0, -10.0]),
}  # fmt: skip
FRAME = frame_from_openings(np.zeros(3), OPENINGS)


def test_the_axes_point_where_their_names_say() -> None:
    assert FRAME.left == pytest.approx([1.0, 0.0, 0.0])
    assert FRAME.roof == pytest.approx([0.0, 0.0, 1.0])  # the valve's shift to the left does not tilt it
    assert FRAME.anterior == pytest.approx([0.0, -1.0, 0.0])
    assert FRAME.components(np.array([[3.0, 5.0, 7.0]]))[0] == pytest.approx([3.0, -5.0, 7.0])


def test_a_mirrored_atrium_s_front_is_still_away_from_the_inferior_veins() -> None:
    mirrored = {name: place * [1.0, -1.0, 1.0] for name, place in OPENINGS.items()}
    assert frame_from_openings(np.zeros(3), mirrored).anterior == pytest.approx([0.0, 1.0, 0.0])


def test_regions_are_a_cone_and_four_quadrants() -> None:
    at = np.array([[0.0, 0, 9], [9, 0, 0], [-9, 1, 0], [1, -9, 0], [0, 9, -1]])
    names = {number: name for name, number in REGIONS.items()}
    assert [names[n] for n in sectors(FRAME, at)] == ["roof", "lateral", "septum", "anterior", "posterior"]
    edge = np.radians([49.0, 51.0])
    beside = np.column_stack([np.sin(edge), 0 * edge, np.cos(edge)])
    assert [names[n] for n in sectors(FRAME, beside)] == ["roof", "lateral"]


def test_height_runs_from_the_valve_to_the_top() -> None:
    line = np.linspace(0.0, 2.0, 5)[:, None] * (FRAME.centre - FRAME.mitral_centre) + FRAME.mitral_centre
    assert height(FRAME, line) == pytest.approx([0.0, 0.25, 0.5, 0.75, 1.0])
    assert height(FRAME, np.vstack([line, line[:1] - 5.0]))[-1] == 0.0


def test_coordinates_sweep_from_septal_to_lateral_and_over_the_roof() -> None:
    at = np.array([[-5.0, 0, 0], [5, 0, 0], [0, 0, 5], [0, 5, 0], [0, -5, 0]])
    found = sweep(FRAME, at)
    assert found[:3, 0] == pytest.approx([0.0, 1.0, 0.5])
    # beta: .5 at the roof, a quarter turn is 1/3 either way
    assert found[2:, 1] == pytest.approx([0.5, 0.5 - 1 / 3, 0.5 + 1 / 3])


def test_fibres_lie_in_the_wall_and_cross_between_the_layers() -> None:
    normals = unit(np.random.default_rng(2).normal(size=(200, 3)))
    normals[0] = unit(FRAME.centre - FRAME.mitral_centre)  # no direction of its own there
    inner, outer = (two_layer_fibres(FRAME, normals, np.full(200, t)) for t in (0.2, 0.8))
    for fibre in (inner, outer):
        assert np.linalg.norm(fibre, axis=1) == pytest.approx(1.0)
        assert np.abs(np.einsum("ij,ij->i", fibre, normals)).max() < 1e-9
    assert np.abs(np.einsum("ij,ij->i", inner, outer)).max() < 1e-9
    axis = unit(FRAME.centre - FRAME.mitral_centre)
    steep = np.abs(normals @ axis) < 0.9
    assert np.abs(inner[steep] @ axis).max() < 1e-9, "round the mitral axis"
    assert unit(np.zeros((1, 3))).tolist() == [[0.0, 0.0, 0.0]]
