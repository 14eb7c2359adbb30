"""Tubes that leave a ball: found where they are, as wide and as long as they are."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings.branches import NECK_FACTOR, find

SIZE = 61  # 1 mm voxels, the ball's middle at the origin


def pool(*tubes: tuple[np.ndarray, float, float], radius: float = 14.0) -> Image:
    """A ball with tubes (direction, radius, end), mm from the middle."""
    axis = np.arange(SIZE) - SIZE // 2
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    place = np.stack([x, y, z], axis=-1).astype(float)
    inside = np.linalg.norm(place, axis=-1) <= radius
    for direction, wide, end in tubes:
        along = place @ direction
        across = np.linalg.norm(place - along[..., None] * direction, axis=-1)
        inside |= (along > 0) & (along <= end) & (across <= wide)
    return Image(inside.astype(np.float32), np.ones(3), np.full(3, -float(SIZE // 2)), np.eye(3))


def test_a_ball_has_no_branch() -> None:
    found = find(pool())
    assert found.branches == ()
    assert found.middle == pytest.approx([0, 0, 0], abs=1.01)
    assert found.radius_mm == pytest.approx(14.5, abs=1.0)


def test_two_tubes_are_two_branches() -> None:
    up, side = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    found = find(pool((up, 4.0, 29.0), (side, 5.0, 26.0)))
    assert len(found.branches) == 2
    long, short = found.branches
    assert long.tip @ up == pytest.approx(29, abs=1.5) and short.tip @ side == pytest.approx(26, abs=1.5)
    for branch, way, wide in ((long, up, 8.0), (short, side, 10.0)):
        assert branch.axis @ way > 0.98
        # the neck may have NECK_FACTOR times the tube's area, and half a voxel all around
        assert wide - 0.5 < branch.diameter_mm < np.sqrt(NECK_FACTOR) * wide + 0.5
        assert 11 < branch.centre @ way < 20  # near the ball's surface at 14 mm
        assert np.linalg.norm(branch.centre - (branch.centre @ way) * way) < 1.0


def test_a_stump_is_no_branch_and_the_least_length_is_asked_for() -> None:
    up = np.array([0.0, 0, 1])
    assert find(pool((up, 4.0, 16.0))).branches == ()
    assert len(find(pool((up, 4.0, 27.0)), least_length_mm=5.0).branches) == 1
    assert find(pool((up, 4.0, 27.0)), least_length_mm=20.0).branches == ()
