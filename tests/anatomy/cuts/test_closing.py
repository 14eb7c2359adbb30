"""Open rims: evened only where ragged, closed by caps that follow the wall's turn."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import cut_ball

from lacli.anatomy.cuts.closing import CAP, close, even
from lacli.geometry import curves
from lacli.geometry.surface import Surface, check, compact


def bowl() -> tuple[Surface, np.ndarray]:
    """A ball that is open above z = 14 mm, and its rim."""
    ball = cut_ball()
    open_ = compact(Surface(ball.points, ball.triangles[ball.label == 0], ball.label[ball.label == 0]))
    (rim,) = curves.loops(curves.open_edges(open_.triangles))
    return open_, rim


@pytest.mark.parametrize("turn", [1, -1])
def test_a_cap_closes_the_bowl_whatever_way_its_rim_is_read(turn: int) -> None:
    open_, rim = bowl()
    points, triangles, label = close(open_.points, open_.triangles, [rim[::turn]])
    done = Surface(points, triangles, label)
    check(done, "closed bowl")
    assert done.areas()[label == CAP].sum() == pytest.approx(np.pi * (20**2 - 14**2), rel=0.02)
    assert set(label.tolist()) == {0, CAP}


def test_a_smooth_rim_is_left_and_a_ragged_one_evened_in_place() -> None:
    open_, rim = bowl()
    same, ragged = even(open_.points, open_.triangles, [rim])
    assert ragged == [] and (same == open_.points).all()
    points = open_.points.copy()
    points[rim[::2], 2] += 1.5  # a saw
    evened, ragged = even(points, open_.triangles, [rim])
    assert ragged == [0]
    assert np.ptp(evened[rim, 2]) < 0.5 * np.ptp(points[rim, 2])
    # the rim keeps its area: a circle of 204 mm2 times pi
    ring = evened[rim] - evened[rim].mean(axis=0)
    area = 0.5 * np.linalg.norm(np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0))
    assert area == pytest.approx(np.pi * 204, rel=0.03)
    far = np.linalg.norm(points[:, None] - points[rim][None], axis=2).min(axis=1) > 4.0
    assert (evened[far] == points[far]).all()
