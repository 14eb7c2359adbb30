"""Cuts of a closed surface: a ball loses its exact cap, stays closed, and a plane that makes no sense is refused."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import icosphere

from lacli.anatomy.cuts.clipping import cut, fill_rim
from lacli.base.errors import AnatomyError
from lacli.geometry.surface import check
from lacli.geometry.triangles import area_normals

UP = np.array([0.0, 0, 1])


def test_a_cut_ball_is_closed_and_its_cap_is_a_disc() -> None:
    ball = icosphere(20.0, 4)
    done = cut(ball, np.array([0.0, 0, 12]), UP, np.array([0.0, 0, 20]), 21, "mitral valve")
    check(done, "cut ball")
    cap = done.label == 21
    # radius^2 = 20^2 - 12^2 = 256
    assert done.areas()[cap].sum() == pytest.approx(np.pi * 256, rel=0.01)
    assert (done.normals()[cap] @ UP).min() > 0.999
    assert done.points[:, 2].max() < 12 + 1e-9
    # a ball's zone up to z = 12: 2 pi r (20 + 12)
    assert done.areas()[~cap].sum() == pytest.approx(2 * np.pi * 20 * 32, rel=0.01)


def test_only_the_piece_beyond_goes() -> None:
    ball = icosphere(20.0, 3)
    done = cut(ball, np.array([0.0, 0, 15]), UP, np.array([0.0, 0, 20]), 22, "vein")
    assert done.points[:, 2].min() == pytest.approx(ball.points[:, 2].min())


@pytest.mark.parametrize(
    ("height", "direction", "words"), [(30.0, UP, "does not meet the surface"), (12.0, -UP, "more than half of the atrium")]
)
def test_planes_that_make_no_sense(height: float, direction: np.ndarray, words: str) -> None:
    with pytest.raises(AnatomyError, match=words) as told:
        cut(icosphere(20.0, 3), np.array([0.0, 0, height]), direction, np.array([0.0, 0, -20.0]), 21, "LSPV")
    assert "LSPV" in str(told.value) and "landmarks.toml" in str(told.value)


def test_a_rim_is_filled_against_its_neighbours() -> None:
    # an open box's floor is missing: rim 0 1 2 3, walls to the upper points 4 .. 7
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    walls = np.array([t for i in range(4) for j in [(i + 1) % 4] for t in ([i, j, j + 4], [i, j + 4, i + 4])])
    out, floor = fill_rim(points, np.arange(4), walls)
    vector = area_normals(out[floor])
    assert (vector[:, 2] < 0).all()  # the walls look outward, so the floor looks down
    assert len(floor) == 2 and np.unique(floor).tolist() == [0, 1, 2, 3]
