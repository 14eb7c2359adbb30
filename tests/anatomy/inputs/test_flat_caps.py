"""Flat discs that close a surface's openings: found, taken off where an atrium's are complete, else left."""

from __future__ import annotations

import numpy as np
import pytest
import pyvista as pv
from shapes import icosphere

from lacli.anatomy.cuts.clipping import cut
from lacli.anatomy.inputs.flat_caps import flat_caps
from lacli.anatomy.inputs.patches import of_triangles
from lacli.anatomy.inputs.repair import repair
from lacli.contracts.labels import PLANES, REGIONS, RINGS, is_plane
from lacli.geometry.surface import Surface
from lacli.synthetic.atrium import cavity, synthesize

AXES = np.vstack([np.eye(3), -np.eye(3)])


def ball_with_caps(count: int) -> Surface:
    """A ball of 20 mm radius, cut 17 mm from its middle along ``count`` axes: discs of 21 mm diameter that meet the wall at 58
    degrees (cos = 17 / 20)."""
    ball = icosphere(20.0, 4)
    for k in range(count):
        ball = cut(ball, 17.0 * AXES[k], AXES[k], 20.0 * AXES[k], 21 + k, "disc")
    return ball


@pytest.mark.parametrize("count", [0, 1, 4, 6])
def test_each_disc_is_found_and_nothing_else(count: int) -> None:
    ball = ball_with_caps(count)
    found = flat_caps(ball.points, ball.triangles)
    assert len(found) == count
    disc = np.pi * (20.0**2 - 17.0**2)
    for mask in found:
        assert len(set(ball.label[mask]) - {0}) == 1
        assert ball.areas()[mask].sum() == pytest.approx(disc, rel=0.05)


def test_facets_and_long_flats_are_no_openings() -> None:
    assert flat_caps(*_of(icosphere(20.0, 1))) == []  # 60 mm2 each, at sharp angles
    # sides 4 and 13 times as long as wide (4 pi 4 / 10^2 = 0.50), ends of 10 mm x 3 mm (4 pi 30 / 26^2 = 0.56)
    grid = np.array([[x, y, 0.0] for x in range(0, 41, 2) for y in range(0, 11, 2)])
    box = pv.PolyData(grid).delaunay_2d().extrude([0, 0, 3.0], capping=True).triangulate().clean()
    assert flat_caps(np.asarray(box.points, float), box.regular_faces) == []


def _of(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    return surface.points, surface.triangles


def test_a_capped_atrium_has_its_openings_as_an_open_one() -> None:
    whole = cavity(synthesized_shape())
    repaired = repair(whole.points, whole.triangles)
    assert len(repaired.rims) == 6
    assert any("6 flat caps" in note for note in repaired.notes)
    for value in PLANES.values():
        middle = whole.points[np.unique(whole.triangles[whole.label == value])].mean(axis=0)
        assert min(np.linalg.norm(rim.centre - middle) for rim in repaired.rims) < 2.0
    assert repaired.surface.volume_ml() == pytest.approx(whole.volume_ml(), rel=2e-3)


def synthesized_shape():
    from lacli.synthetic.atrium import sized

    return sized(3, 80.0)


def test_one_flat_valve_alone_is_left_as_it_is() -> None:
    ball = ball_with_caps(1)
    repaired = repair(ball.points, ball.triangles)
    assert repaired.rims == () and not any("flat caps" in note for note in repaired.notes)


def test_a_wall_of_our_own_says_which_ring_is_which() -> None:
    bundle, _ = synthesize(1, cell_size_mm=8.0, order=1)
    tissue = ~is_plane(bundle.region)
    faces, tag = bundle.tets[tissue, :3], bundle.region[tissue]
    tagged = of_triangles(bundle.points, faces, tag)
    assert tagged is not None and set(tagged.names.values()) == set(RINGS)
    body = np.isin(tag, list(REGIONS.values()))
    assert of_triangles(bundle.points, faces[body], tag[body]) is None, "regions alone name no opening"
