"""Where a vessel begins to flare, and lines over a coarse surface."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.anatomy.openings import ostium
from lacli.geometry import curves as paths


def profile(scale: float) -> np.ndarray:
    """Radii every 0.25 mm inward: a tapering tube, from 10 mm on r = 7 + (x - 10)^2 / 20, all times scale."""
    x = np.arange(0.0, 18.0, 0.25) / scale
    return scale * np.where(x < 10, 6.8 + 0.02 * x, 7.0 + (x - 10) ** 2 / 20)


@pytest.mark.parametrize("scale", [0.7, 1.0])
def test_the_flare_ends_where_the_wall_turns_by_its_angle(scale: float) -> None:
    # slope (x - 10) / 10 = tan 15 deg = 0.2679 at x = 12.68, whatever the calibre
    where = ostium.flare_end(profile(scale), 0.25)
    assert where is not None
    assert 0.25 * where / scale == pytest.approx(12.68, abs=0.1)


def test_a_rounded_tip_is_no_flare_and_a_tube_has_none() -> None:
    x = np.arange(0.0, 18.0, 0.25)
    tip = np.sqrt(np.maximum(49.0 - (7.0 - np.minimum(x + 0.5, 7.0)) ** 2, 0.0))
    where = ostium.flare_end(np.where(x < 7, np.minimum(tip, profile(1.0)), profile(1.0)), 0.25)
    assert where is not None
    assert 0.25 * where == pytest.approx(12.68, abs=0.1)
    assert ostium.flare_end(6.8 + 0.02 * x, 0.25) is None


def test_lines_over_a_coarse_mesh_are_straight() -> None:
    # a flat square of 10 x 10 mm cells' halves, all diagonals one way: along edges (0, 10) -> (10, 0) is 20 mm, straight 14.14
    n = np.arange(11)
    points = np.array([[x, y, 0.0] for y in n for x in n], dtype=float)
    a = (n[:-1, None] * 11 + n[None, :-1]).ravel()
    triangles = np.vstack([np.column_stack([a, a + 1, a + 12]), np.column_stack([a, a + 12, a + 11])])
    start, end = 110, 10
    way = paths.Ways.over(points, triangles)
    line = way.line(start, end)
    assert np.linalg.norm(np.diff(line, axis=0), axis=1).sum() == pytest.approx(np.hypot(10, 10), rel=0.01)
    path = way.path(start, end)
    assert path[0] == start and path[-1] == end
    everywhere = np.delete(np.arange(len(points)), 60)
    straight = np.linalg.norm(points[everywhere] - points[60], axis=1)
    longer = [np.linalg.norm(np.diff(way.line(60, int(end)), axis=0), axis=1).sum() for end in everywhere] / straight - 1.0
    # along edges up to 0.41; with one point on each edge 0.08, on average 0.03
    assert longer.min() > -1e-12 and longer.mean() < 0.01 and longer.max() < 0.03
    # the edge path keeps within one cell of the diagonal x + y = 10; plain edge paths may take the corner
    assert np.abs(points[path, :2].sum(axis=1) - 10.0).max() <= 1.0 + 1e-9


def test_a_line_ends_at_the_goal_it_reaches_not_at_another_in_the_same_place() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0]])
    way = paths.Ways.over(points, np.array([[0, 1, 2], [3, 4, 5]]))
    assert way.path(0, np.array([1, 3])).tolist() == [0, 1]
    assert way.path(4, np.array([1, 3])).tolist() == [4, 3]
