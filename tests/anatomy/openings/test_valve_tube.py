"""The annulus of a label map is where atrium and ventricle meet, as wide as it is there, whatever the voxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from lacli.anatomy import build
from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings.landmarks import Opening
from lacli.anatomy.openings.valve_tube import valve_tube
from lacli.base.arrays import FloatArray
from lacli.contracts.labels import PLANES
from lacli.synthetic.atrium import sized
from lacli.synthetic.image import images

LA, LV = 2, 3
TILT = np.array([0.3, -0.2, 0.93])
NORMAL = TILT / np.linalg.norm(TILT)


def tube_map(voxel_mm: float, height_mm: float, gap_mm: float = 0.0, wide_mm: float = 15.0) -> Image:
    """A tube of 10 mm radius along NORMAL, atrium below ``height_mm``, ventricle above it from ``gap_mm`` on, wider."""
    axis = np.arange(-26.0, 26.0, voxel_mm)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    points = np.stack([x, y, z], axis=-1)
    height = points @ NORMAL
    beside = np.linalg.norm(points - height[..., None] * NORMAL, axis=-1)
    label = np.zeros(height.shape, dtype=np.uint8)
    label[(height <= height_mm) & (height > -15.0) & (beside < 10.0)] = LA
    label[(height > height_mm + gap_mm) & (height < height_mm + 12.0) & (beside < wide_mm)] = LV
    return Image(label, np.full(3, voxel_mm), np.full(3, axis[0]), np.eye(3))


def opening(height_mm: float) -> Opening:
    return Opening("mv", height_mm * NORMAL, NORMAL, (height_mm + 3.0) * NORMAL, 20.0, 0.9, "ventricle contact")


@pytest.mark.parametrize("voxel_mm", [0.8, 1.5])
@pytest.mark.parametrize("found_mm", [-1.2, 0.0, 0.7])
def test_the_plane_is_where_the_labels_meet(voxel_mm: float, found_mm: float) -> None:
    tube = valve_tube(tube_map(voxel_mm, 0.4), LA, LV, opening(found_mm), given=False)
    assert tube is not None
    assert tube.opening.centre @ NORMAL == pytest.approx(0.4, abs=0.2 * voxel_mm)
    given = valve_tube(tube_map(voxel_mm, 0.4), LA, LV, opening(found_mm), given=True)
    assert given is not None and (given.opening.centre == opening(found_mm).centre).all()


def test_the_mask_is_led_on_as_wide_as_it_is() -> None:
    labels = tube_map(0.8, 0.4)
    tube = valve_tube(labels, LA, LV, opening(0.0), given=False)
    assert tube is not None
    mask = tube.led_on(labels.with_array(labels.array == LA))
    where = mask.to_world(np.argwhere(mask.array)[:, ::-1].astype(float))
    height = where @ NORMAL
    beside = np.linalg.norm(where - height[:, None] * NORMAL, axis=1)
    beyond = (height > 1.0) & (height < 2.6)
    # area of the section: volume of a slice over its height; pi 10^2 = 314 mm2
    assert beyond.sum() * 0.8**3 / 1.6 == pytest.approx(np.pi * 100.0, rel=0.05)
    assert beside[height > 0.4].max() < 11.0
    assert height.max() < 0.4 + 4.0 * 0.8 + 0.8


def test_where_they_do_not_meet_there_is_none() -> None:
    assert valve_tube(tube_map(0.8, 0.4, gap_mm=2.0), LA, LV, opening(0.0), given=False) is None
    assert valve_tube(tube_map(0.8, 0.4), LA, LV, opening(-12.0), given=False) is None
    half = tube_map(0.8, 0.4)
    left = np.arange(half.array.shape[2]) < half.array.shape[2] // 2
    part = half.with_array(np.where((half.array == LV) & left, 0, half.array))
    assert valve_tube(part, LA, LV, opening(0.0), given=False) is None


def annulus(points: FloatArray, triangles: FloatArray) -> tuple[FloatArray, float]:
    a, b, c = (points[triangles[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    return np.asarray((((a + b + c) / 3.0) * area[:, None]).sum(axis=0) / area.sum()), float(area.sum())


def test_the_annulus_of_an_atrium_is_cut_where_it_is_and_the_wall_as_thick() -> None:
    from lacli.anatomy.wall.thickness import of_bundle

    shape = sized(1, None)
    made = images(1, None, (1.5, 1.5, 1.5))
    options = build.Options(cell_size_mm=5.0)
    built = build.from_labels(made.labels, LA, LV, options, say=lambda words: None, wall=4)
    bundle = built.bundle
    cut = next(c for c in shape.cuts() if c.label == PLANES["mv"])
    centre, area = annulus(bundle.points, bundle.triangles[bundle.tags == PLANES["mv"]][:, :3])
    # where the valve's contact is seen on the smoothed surface the plane would be .7 of a voxel too low, its area 7 % too small
    assert (centre - cut.centre) @ cut.direction == pytest.approx(0.0, abs=0.3)
    assert area == pytest.approx(_section_mm2(shape, cut.centre, cut.direction), rel=0.04)
    for eikonal, laplace in of_bundle(bundle).per_region.values():
        assert eikonal == pytest.approx(2.0, rel=0.04)
        assert laplace == pytest.approx(2.0, rel=0.04)
    again = build.from_labels(made.labels, LA, LV, options, replace(built.landmarks, notes=()), lambda words: None, wall=4)
    assert annulus(again.bundle.points, again.bundle.triangles[again.bundle.tags == PLANES["mv"]][:, :3])[1] == pytest.approx(
        area, rel=0.01
    )


def test_where_the_annulus_does_not_show_it_is_told() -> None:
    """A map that leaves room for leaflets: the ventricle begins a voxel beyond the atrium."""
    made = images(1, None, (1.5, 1.5, 1.5))
    room = ndimage.binary_dilation(made.labels.array == LA)
    apart = made.labels.with_array(np.where(room & (made.labels.array == LV), 0, made.labels.array))
    built = build.from_labels(apart, LA, LV, build.Options(cell_size_mm=8.0, order=1), say=lambda words: None)
    assert build.BELOW_CONTACT in built.notes


def _section_mm2(shape: object, centre: FloatArray, direction: FloatArray) -> float:
    """Area of the exact shape's section."""
    from lacli.anatomy.openings.ostium import area_and_middle
    from lacli.synthetic.shape import Shape, first_crossing

    assert isinstance(shape, Shape)
    implicit = shape.implicit
    return area_and_middle(direction, centre, lambda c, d: first_crossing(implicit, c, d))[0]
