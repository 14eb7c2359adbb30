"""A label map painted from a surface and a thickness: of a ball, whose volumes are known."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import icosphere

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.segmentation.labelmap import Numbers, paint
from lacli.anatomy.segmentation.wall import OPEN, SEEN, Wall
from lacli.base.errors import AnatomyError

RADIUS, THICKNESS, SPACING = 10.0, 2.0, 1.0
NUMBERS = Numbers(la=2, wall=1, fat=9, lv=3)


def _ball(open_above: float = 99.0) -> tuple[Image, np.ndarray, np.ndarray, Wall]:
    """A CT of -80 HU (fat) around a ball, its distance from the centre, its rough pool, its wall; above a height it is open."""
    size = 49
    place = np.indices((size,) * 3)[::-1].astype(float) * SPACING - 24.0  # x, y, z
    away = np.linalg.norm(place, axis=0)
    image = Image(np.full((size,) * 3, -80, np.int16), np.full(3, SPACING), np.full(3, -24.0), np.eye(3))
    surface = icosphere(RADIUS, 4)
    n = len(surface.points)
    flag = np.where(surface.points[:, 2] > open_above, OPEN, SEEN)
    ones = np.ones(n)
    wall = Wall(
        surface, surface.points / RADIUS, THICKNESS * ones, np.inf * ones, flag, 0.1 * ones, 0.1 * ones, 0.1 * ones,
        4 * np.pi * RADIUS**2 / n * ones, 0.5, 100.0,
    )  # fmt: skip
    return image, away, away < RADIUS, wall


def test_blood_wall_and_fat_have_the_volumes_of_their_balls() -> None:
    image, away, pool, wall = _ball()
    lv = np.zeros_like(pool)
    lv[:3] = True
    made = paint(image, image.array.astype(float), pool, lv, wall, NUMBERS, 0.5)
    assert made.spacing == pytest.approx([0.5] * 3)
    share = {label: float((made.array == label).sum()) * 0.5**3 for label in (1, 2, 9)}
    ball = 4.0 / 3.0 * np.pi
    # a voxel of 0.5 mm on a ball of 10 mm: shells are true to about 3 %
    assert share[2] == pytest.approx(ball * 10.0**3, rel=0.03)
    assert share[1] == pytest.approx(ball * (12.0**3 - 10.0**3), rel=0.06)
    assert share[9] == pytest.approx(ball * (15.0**3 - 12.0**3), rel=0.06)  # within 5 mm of the blood
    assert away.max() > 20.0, "there is more fat in the image"


def test_where_blood_goes_on_there_is_no_wall() -> None:
    image, _, pool, wall = _ball(open_above=6.0)
    made = paint(image, image.array.astype(float), pool, None, wall, NUMBERS, 0.5)
    z = made.origin[2] + 0.5 * np.argwhere(made.array == NUMBERS.wall)[:, 0]
    assert z.min() < -11.0 and 5.0 < z.max() < 8.5
    assert NUMBERS.lv not in made.array


def test_a_grid_that_cannot_be_held_is_refused() -> None:
    image, _, pool, wall = _ball()
    with pytest.raises(AnatomyError, match=r"voxels of 0\.01 mm make a label map of .* too large"):
        paint(image, image.array.astype(float), pool, None, wall, NUMBERS, 0.01)
