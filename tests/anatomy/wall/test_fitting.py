"""A CT, a blood pool and a bundle that are not of one patient are refused; what cannot be told is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import RADIUS, fibrous_ball, icosphere

from lacli import fat
from lacli.anatomy.inputs import image
from lacli.anatomy.inputs.image import Image
from lacli.anatomy.wall.fitting import check_bundle, check_pool
from lacli.base.errors import AnatomyError


def ball(blood_hu: float, size: int = 72) -> Image:
    """Blood to 20 mm, wall of 40 HU to 22 mm, fat beyond where x > 0; noise of 10 HU; voxels of 1 mm, the ball in the middle."""
    axis = np.arange(size) - (size - 1) / 2
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    radius = np.sqrt(x**2 + y**2 + z**2)
    hu = np.where(radius < RADIUS, blood_hu, np.where((radius > RADIUS + 2.0) & (x > 0), -100.0, 40.0))
    hu += np.random.default_rng(0).normal(0.0, 10.0, hu.shape)
    return Image(hu.astype(np.float32), np.ones(3), np.full(3, axis[0]), np.eye(3))


def test_a_pool_that_lies_elsewhere_is_refused_and_one_that_is_cut_off_told() -> None:
    pool = icosphere(RADIUS, 4)
    assert check_pool(ball(350.0), pool) == []
    # 20 mm to the side one half of the ball's surface is in the blood, and sees blood on both sides or brighter blood outside
    with pytest.raises(AnatomyError, match=r"the pool does not lie on this CT's atrium. Are they of the same patient"):
        check_pool(ball(350.0), replace(pool, points=pool.points + np.array([20.0, 0, 0])))
    with pytest.raises(AnatomyError, match=r"the CT does not cover the blood pool \(\d+ % of its surface\)"):
        check_pool(ball(350.0), replace(pool, points=pool.points + np.array([40.0, 0, 0])))
    # the image ends at x = 15.5 of 20 mm: a cap of 4.5 / 40 = 11 % of the sphere's area
    cropped = ball(350.0).crop(np.zeros(3, dtype=int), np.array([52, 72, 72]))
    (note,) = check_pool(cropped, pool)
    assert note.startswith(("11 %", "12 %")) and "lies outside the image" in note
    assert check_pool(ball(45.0), pool) == [], "without contrast nobody can tell"


def test_a_bundle_of_another_place_has_no_regions_here() -> None:
    bundle, points = fibrous_ball(1), icosphere(RADIUS, 4).points
    check_bundle(bundle, points)
    with pytest.raises(AnatomyError, match=r"the bundle's endocardium lies \d+ mm from the blood pool's surface"):
        check_bundle(replace(bundle, points=bundle.points + np.array([25.0, 0, 0])), points)


@pytest.mark.parametrize(("blood_hu", "told"), [(350.0, 0), (45.0, 1)])
def test_where_no_edge_of_the_blood_is_seen_it_is_told(tmp_path: Path, blood_hu: float, told: int) -> None:
    ct = ball(blood_hu)
    image.write(ct, tmp_path / "ct.nrrd")
    index = np.argwhere(np.ones(ct.array.shape, dtype=bool))[:, ::-1]
    inside = (np.linalg.norm(ct.to_world(index), axis=1) < RADIUS).reshape(ct.array.shape)
    image.write(ct.with_array(inside.astype(np.int16)), tmp_path / "labels.nrrd")
    made = fat(tmp_path / "ct.nrrd", tmp_path / "fat", labels=tmp_path / "labels.nrrd", la=1)
    assert sum("no edge of the blood is seen" in note for note in made.notes) == told
    assert all((one.edge is None) == bool(told) for one in made.windows.values())
    assert list(made.notes) == made.report["notes"]
