"""Tubes that leave a pool, the valve where a ventricle touches, the blood's label and the pool of fat."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from shapes import hollow_cube, icosphere

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.meshing import la_label, naming
from lacli.anatomy.openings import branches, mitral
from lacli.anatomy.pictures import polydata
from lacli.anatomy.wall.fat_files import pool_of
from lacli.base.errors import AnatomyError, UsageError

SIZE = 72


def grid() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    k, j, i = np.meshgrid(*[np.arange(SIZE) - SIZE / 2] * 3, indexing="ij")
    return i, j, k


def image(array: np.ndarray) -> Image:
    return Image(array.astype(np.float32), np.ones(3), np.full(3, -SIZE / 2.0), np.eye(3))


def test_a_ball_with_two_tubes_has_two_branches_where_they_are() -> None:
    i, j, k = grid()
    pool = i**2 + j**2 + k**2 < 15.0**2
    pool |= (np.hypot(j, k) < 4.0) & (i > 0) & (i < 30)  # along +x
    pool |= (np.hypot(i, j) < 5.0) & (k < 0) & (k > -28)  # along -z
    found = branches.find(image(pool))
    assert np.linalg.norm(found.middle) < 3.0 and found.radius_mm == pytest.approx(15.0, abs=1.5)
    assert len(found.branches) == 2
    by_axis = sorted(found.branches, key=lambda b: b.axis[2])
    for branch, axis, radius in zip(by_axis, ([0.0, 0, -1], [1.0, 0, 0]), (5.0, 4.0), strict=True):
        assert branch.axis @ axis > 0.95
        assert branch.diameter_mm == pytest.approx(2 * radius, rel=0.35)
        assert branch.centre @ axis == pytest.approx(15.0, abs=4.0), "the ostium is where the tube leaves the ball"
        assert branch.tip @ axis > 24.0 and branch.length_mm > 6.0


def test_the_valve_is_where_the_ventricle_touches() -> None:
    i, j, k = grid()
    ball = icosphere(20.0, 4)
    labels = np.zeros((SIZE,) * 3, np.uint8)
    labels[(k < -14) & (np.hypot(i, j) < 16) & (i**2 + j**2 + k**2 > 20.0**2)] = 3
    contact = mitral.lv_contact(image(labels), 3, ball)
    assert contact is not None and (contact[:, 2] < -11).all()
    found = mitral.mitral_from_contact(ball, contact)
    assert found.normal @ [0, 0, -1] > 0.95, "into the ventricle"
    assert np.linalg.norm(found.centre[:2]) < 2.0 and -20.0 < found.centre[2] < -8.0
    assert mitral.of_contact(ball, contact).direction @ found.normal == pytest.approx(1.0)
    far = np.zeros_like(labels)
    far[:3, :3, :3] = 3
    assert mitral.lv_contact(image(far), 3, ball) is None
    with pytest.raises(AnatomyError, match=r"label 4 .* has no voxel"):
        mitral.lv_contact(image(labels), 4, ball)


def test_the_blood_s_label_is_the_given_or_the_only_one() -> None:
    assert la_label(Path("m"), {2: 80.0}, None) == 2
    assert la_label(Path("m"), {2: 80.0, 3: 90.0}, 3) == 3
    with pytest.raises(AnatomyError, match=r"label 5 has no voxel; the labels are 2 \(80 mL\), 3 \(90 mL\)"):
        la_label(Path("m"), {2: 80.0, 3: 90.0}, 5)
    with pytest.raises(UsageError, match="2"):
        la_label(Path("m"), {2: 80.0, 3: 90.0}, None)
    with pytest.raises(AnatomyError, match="every voxel is 0"):
        la_label(Path("m"), {}, None)
    with pytest.raises(AnatomyError, match=r"^file: the wall is open$"), naming(Path("file")):
        raise AnatomyError("the wall is open")
    with pytest.raises(AnatomyError, match=r"^file: said$"), naming(Path("file")):
        raise AnatomyError("file: said")


def test_a_bundle_s_pool_faces_outward_and_holds_its_cavity() -> None:
    bundle = hollow_cube()
    surface, notes = pool_of(None, None, bundle)
    assert notes == [] and surface.volume_ml() == pytest.approx(1.0)  # (30 / 3)^3 mm3
    mesh = polydata(surface)
    assert mesh.n_cells == len(surface.triangles) and mesh.volume == pytest.approx(1000.0)
