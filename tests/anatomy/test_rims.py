"""Rims, the triangles that fill them, and cutting planes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from shapes import icosphere

from lacli.anatomy.cuts.caps import crosses_itself, harmonic_heights, rim_loops, triangulate_loop
from lacli.anatomy.cuts.clipping import SNAP, cut
from lacli.base.errors import AnatomyError

TURN = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
RING = np.column_stack([np.cos(TURN), np.sin(TURN), np.zeros(24)])


def test_an_open_surface_has_its_rims_as_loops() -> None:
    ball = icosphere(10.0, 3)
    middle = ball.points[ball.triangles].mean(axis=1)
    loops = rim_loops(ball.triangles[np.abs(middle[:, 2]) < 7.0])
    assert len(loops) == 2
    z = sorted(float(ball.points[loop][:, 2].mean()) for loop in loops)
    assert z[0] < -6.0 and z[1] > 6.0
    assert rim_loops(ball.triangles) == []
    with pytest.raises(AnatomyError, match="rim touches itself"):
        rim_loops(np.array([[0, 1, 2], [0, 3, 4]]))  # two triangles that meet in a point


def test_a_disc_is_filled_to_its_area_and_faces_the_normal() -> None:
    for normal in ([0.0, 0, 1], [0.0, 0, -1]):
        inner, triangles = triangulate_loop(RING, np.arange(24), np.array(normal))
        points = np.vstack([RING, inner])
        vectors = np.cross(points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]])
        assert (vectors @ normal > 0).all()
        # a regular 24-gon: 12 sin(15 deg)
        assert 0.5 * np.linalg.norm(vectors, axis=1).sum() == pytest.approx(12.0 * np.sin(np.pi / 12))
        sides = {tuple(sorted(s)) for t in triangles.tolist() for s in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0]))}
        assert all(tuple(sorted((i, (i + 1) % 24))) in sides for i in range(24)), "the rim's own edges are kept"


def test_a_rim_out_of_its_plane_is_filled_harmonically() -> None:
    saddle = RING + [0, 0, 0.2] * np.cos(2 * TURN)[:, None]
    inner, _ = triangulate_loop(saddle, np.arange(24), np.array([0.0, 0, 1]))
    exact = 0.2 * (inner[:, 0] ** 2 - inner[:, 1] ** 2)  # r^2 cos 2 phi is harmonic
    assert np.abs(inner[:, 2] - exact).max() < 0.03
    assert np.abs(inner[:, 2]).max() < 0.2, "the maximum principle"
    flat = harmonic_heights(np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]]), np.array([1.0, 2.0, 6.0]), 4)
    assert flat[3] == pytest.approx(3.0)


def test_a_rim_that_crosses_itself_is_refused() -> None:
    eight = RING.copy()
    eight[[3, 15]] = eight[[15, 3]]
    assert crosses_itself(eight[:, :2]) and not crosses_itself(RING[:, :2])
    assert crosses_itself(np.vstack([RING[:, :2], RING[-1:, :2]])), "a side without length"
    with pytest.raises(AnatomyError, match="crosses itself"):
        triangulate_loop(eight, np.arange(24), np.array([0.0, 0, 1]))


@settings(max_examples=25, deadline=None)
@given(st.floats(-6.0, 9.0), st.integers(0, 2))
@example(0.75, 0)  # 46 % of the surface is beyond the plane, 51 % with the triangles that it goes through
def test_a_plane_cuts_a_ball_s_cap_off(height: float, axis: int) -> None:
    ball, radius = icosphere(10.0, 3), 10.0
    normal = np.eye(3)[axis]
    found = cut(ball, height * normal, normal, 20.0 * normal, 21, "LSPV") if height > 0.5 else None
    if found is None:
        with pytest.raises(AnatomyError, match="more than half of the atrium"):
            cut(ball, (height - 1.0) * normal, normal, 20.0 * normal, 21, "LSPV")
        return
    assert rim_loops(found.triangles) == []
    cap = np.pi * (radius - height) ** 2 * (2 * radius + height) / 3.0
    lost = ball.volume_ml() - found.volume_ml()
    # the ball's triangles enclose 1 % less than it; rim points less than SNAP of an edge (1.5 mm) from the plane move to it
    snapped = 2 * np.pi * np.sqrt(radius**2 - height**2) * SNAP * 1.5**2 / 2
    assert 1000.0 * lost == pytest.approx(cap, abs=0.02 * cap + snapped)
    assert ((found.points @ normal) < height + 0.2).all()
    flat = found.points[found.triangles[found.label == 21]].reshape(-1, 3) @ normal
    assert np.abs(flat - height).max() < 1e-6


def test_a_plane_that_misses_is_refused_with_its_name() -> None:
    with pytest.raises(AnatomyError, match="plane of the LSPV does not meet the surface"):
        cut(icosphere(10.0, 2), np.array([0.0, 0, 30]), np.array([0.0, 0, 1]), np.array([0.0, 0, 40]), 21, "LSPV")
