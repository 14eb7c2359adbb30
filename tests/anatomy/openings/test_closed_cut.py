"""Cuts of a tube: whatever plane is asked, one closed curve ends it, or a message says where and what to give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lacli.anatomy.cuts import closed_cut
from lacli.anatomy.inputs import extraction
from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings.landmarks import Opening
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry.surface import Surface, check

PLANE = 23
OPENING = Opening("lspv", np.array([0.0, 0, 26.0]), np.array([0.0, 0, 1.0]), np.array([0.0, 0, 38.0]), 12.0, 1.0, "branch")


@pytest.fixture(scope="module")
def flask() -> Surface:
    """A ball of radius 20 about the origin with a neck of radius 6 up to z = 38."""
    axis = np.arange(-26.0, 44.0)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    ball = np.sqrt(x**2 + y**2 + z**2) - 20.0
    neck = np.maximum(np.hypot(x, y) - 6.0, np.abs(z - 19.0) - 19.0)
    field = 0.5 - 0.5 * np.clip(np.minimum(ball, neck), -1.0, 1.0)
    return extraction.isosurface(Image(field, np.full(3, 1.0), np.full(3, -26.0), np.eye(3)), 0.5)


def one_rim(surface: Surface) -> bool:
    check(surface, "cut")
    return len(paths.loops(paths.border_edges(surface.triangles, surface.label == PLANE))) == 1


def test_a_plane_that_cuts_is_kept(flask: Surface) -> None:
    cut, words = closed_cut.cut(flask, OPENING, PLANE, "LSPV")
    assert words == "" and one_rim(cut)
    # the neck's section is a disc of 6 mm: 113 mm2, at z = 26
    assert cut.areas()[cut.label == PLANE].sum() == pytest.approx(np.pi * 36, rel=0.05)
    assert cut.points[cut.triangles[cut.label == PLANE], 2] == pytest.approx(26.0, abs=1e-6)


def test_a_plane_past_the_tip_moves_in(flask: Surface) -> None:
    cut, words = closed_cut.cut(flask, replace(OPENING, centre=np.array([0.0, 0, 40.0])), PLANE, "LSPV")
    assert "farther in" in words and one_rim(cut)
    assert cut.points[cut.triangles[cut.label == PLANE], 2].min() > 33.0


def test_a_plane_along_the_vessel_gives_way_to_the_distance_from_the_tip(flask: Surface) -> None:
    along = replace(OPENING, normal=np.array([1.0, 0, 0]), centre=np.array([12.0, 0, 28.0]))
    cut, words = closed_cut.cut(flask, along, PLANE, "LSPV")
    assert words and one_rim(cut)
    assert cut.points[:, 2].max() < 38.0


def test_a_level_of_distance_from_the_tip_is_one_curve(flask: Surface) -> None:
    cut = closed_cut._along_wall(flask, OPENING, PLANE, (1, 1))
    assert cut is not None and one_rim(cut)
    # along the rounded end (6 mm of radius) and down the neck: the same height all round
    height = cut.points[np.unique(cut.triangles[cut.label == PLANE]), 2]
    assert np.ptp(height) < 3.0 and abs(height.mean() - 26.0) < 2.5


def test_what_cannot_be_cut_says_what_to_give(flask: Surface) -> None:
    far = replace(OPENING, centre=np.array([300.0, 0, 0]), normal=np.array([1.0, 0, 0]), beyond=np.array([310.0, 0, 0]))
    with pytest.raises(AnatomyError, match=r"LSPV.*landmarks\.toml"):
        closed_cut.cut(flask, far, PLANE, "LSPV")
