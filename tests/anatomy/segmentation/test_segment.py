"""A ball of blood with a wall of known thickness, a muscle that touches it: thickness, flags, label map, and bad input."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from shapes import fibrous_ball
from typer.testing import CliRunner

from lacli.anatomy.inputs import extraction
from lacli.anatomy.inputs.image import Image, read_labels, write
from lacli.anatomy.segmentation import intensities, regional, road
from lacli.anatomy.segmentation.pool import Crop
from lacli.anatomy.segmentation.wall import NEIGHBOUR, SEEN
from lacli.base.errors import AnatomyError
from lacli.cli import main

RADIUS, WALL, VOXEL = 16.0, 1.5, 0.8
MIDDLE = np.array([25.6, 25.6, 25.6])
LUMP = MIDDLE - [0.0, RADIUS + WALL + 5.2, 0.0]  # of 6 mm: .8 mm into the wall


def ball(wall: float = WALL, direction: np.ndarray | None = None, noise: float = 25.0) -> tuple[Image, Image]:
    """CT and rough labels (2 blood, 5 muscle); voxels by their share, blurred by .5 mm."""
    turn = np.eye(3) if direction is None else direction
    grid = Image(np.zeros((64, 64, 84)), np.full(3, VOXEL), np.zeros(3), turn)
    k, j, i = np.meshgrid(*(np.arange(n) for n in grid.array.shape), indexing="ij")
    x = VOXEL * np.stack([i, j, k], axis=-1)

    def share(distance: np.ndarray) -> np.ndarray:
        return np.clip(0.5 - distance / VOXEL, 0.0, 1.0)

    d = np.linalg.norm(x - MIDDLE, axis=-1) - RADIUS
    blood = share(d)
    own = share(d - wall) - blood
    block = share(48.0 - x[..., 0]) * (1.0 - blood - own)
    lump = share(np.linalg.norm(x - LUMP, axis=-1) - 6.0) * (1.0 - blood - own)
    muscle = own + block + lump
    hu = 350.0 * blood + 100.0 * muscle - 80.0 * (1.0 - blood - muscle)
    hu = gaussian_filter(hu, 0.5 / VOXEL) + np.random.default_rng(1).normal(0.0, noise, hu.shape)
    rough = np.zeros(hu.shape, dtype=np.uint8)
    rough[block > 0.5] = 5
    rough[d < 0.6 * np.sin(x[..., 0])] = 2
    return grid.with_array(hu.astype(np.float32)), grid.with_array(rough)


@pytest.fixture(scope="module")
def found() -> road.Segmented:
    ct, rough = ball()
    return road.segment(ct, rough, road.Options(2, muscle=5))


def test_thickness_is_right_where_it_is_measured(found: road.Segmented) -> None:
    whole = found.thickness[0]
    seen = found.wall.measured
    assert seen.mean() > 0.8
    assert np.average(found.wall.thickness[seen], weights=found.wall.area[seen]) == pytest.approx(WALL, abs=0.06)
    assert abs(whole.mean_mm - WALL) < max(3.0 * whole.sd_mm, 0.05)
    assert 0.0 < whole.sd_mm < 0.25
    radius = np.linalg.norm(found.wall.surface.points[seen] - MIDDLE, axis=1)
    assert radius.mean() == pytest.approx(RADIUS, abs=0.06)


def test_a_neighbour_that_touches_is_flagged_and_bounded(found: road.Segmented) -> None:
    way = (found.wall.surface.points - MIDDLE) / np.linalg.norm(found.wall.surface.points - MIDDLE, axis=1)[:, None]
    cosine = way @ np.array([0.0, -1.0, 0.0])
    # the lump's ball meets the wall's outside on a cap of 9 degrees about it
    inside, apart = cosine > np.cos(np.radians(8.0)), cosine < np.cos(np.radians(30.0))
    assert (found.wall.flag[inside] == NEIGHBOUR).all() and inside.sum() > 5
    assert (found.wall.flag[apart] == SEEN).mean() > 0.97
    touched = found.wall.flag == NEIGHBOUR
    assert (found.wall.bound[touched] >= WALL).all()
    assert (found.wall.thickness[touched] <= found.wall.bound[touched]).all()
    assert np.abs(found.wall.thickness[touched] - WALL).max() < 0.25
    assert any("touches" in note for note in found.notes)


def test_the_label_map_is_what_mesh_reads(found: road.Segmented, tmp_path: Path) -> None:
    write(found.labels, tmp_path / "map.nrrd")
    labels = read_labels(tmp_path / "map.nrrd")
    ball_ml = 4.0 / 3.0 * np.pi * RADIUS**3 / 1000.0
    shell_ml = 4.0 / 3.0 * np.pi * ((RADIUS + WALL) ** 3 - RADIUS**3) / 1000.0
    assert found.volume_ml(2) == pytest.approx(ball_ml, rel=0.015)
    assert found.volume_ml(found.numbers.wall) == pytest.approx(shell_ml, rel=0.06)
    assert found.volume_ml(found.numbers.fat) > 1.0
    notes: list[str] = []
    outer = extraction.surface_of(extraction.within_wall(labels, 2, found.numbers.wall, notes))
    distance = np.linalg.norm(outer.points - MIDDLE, axis=1)
    assert np.median(distance) == pytest.approx(RADIUS + WALL, abs=0.1)
    assert not notes  # no hole in the wall had to be filled


def test_axes_of_the_image_do_not_matter(found: road.Segmented) -> None:
    turn = np.array([[0.0, -1.0, 0.0], [0.8, 0.0, -0.6], [0.6, 0.0, 0.8]])
    turned = road.segment(*ball(direction=turn), road.Options(2, muscle=5))
    assert turned.thickness[0].mean_mm == pytest.approx(found.thickness[0].mean_mm, abs=1e-3)


def test_a_bundle_of_another_atrium_is_refused() -> None:
    """A ball about the origin, and one about the image's middle."""
    with pytest.raises(AnatomyError, match="its regions are not of this atrium"):
        road.segment(*ball(), road.Options(2, muscle=5), fibrous_ball(1))


def test_sides_are_where_normals_point() -> None:
    normal = np.array([[0.9, 0.1, 0.2], [-0.9, 0.1, 0.2], [0.0, 1.0, 0.2], [0.0, -1.0, 0.2], [0.0, 0.1, 1.0], [0.0, 0.1, -1.0]])
    assert [regional.SIDES[n - 1] for n in regional.sides(normal)] == [
        "left", "right", "posterior", "anterior", "superior", "inferior",
    ]  # fmt: skip


def _other_grid(ct: Image, rough: Image) -> tuple[Image, Image]:
    return ct, rough.with_array(rough.array[:-4])


def _other_place(ct: Image, rough: Image) -> tuple[Image, Image]:
    return ct, replace(rough, origin=rough.origin + np.array([4.0, 0.0, 0.0]))


def _labels_for_ct(ct: Image, rough: Image) -> tuple[Image, Image]:
    return rough, rough


def _no_offset(ct: Image, rough: Image) -> tuple[Image, Image]:
    return ct.with_array(ct.array + 1024.0), rough


def _dark_blood(ct: Image, rough: Image) -> tuple[Image, Image]:
    return ct.with_array(np.where(rough.array == 2, 20.0, ct.array).astype(np.float32)), rough


def _no_muscle(ct: Image, rough: Image) -> tuple[Image, Image]:
    return ct, rough.with_array(np.where(rough.array == 5, 0, rough.array))


def _thin_muscle(ct: Image, rough: Image) -> tuple[Image, Image]:
    other = np.arange(rough.array.shape[2]) != 70
    return ct, rough.with_array(np.where((rough.array == 5) & other, 0, rough.array))


def _elsewhere(ct: Image, rough: Image) -> tuple[Image, Image]:
    """The blood's label 16 mm off along k: in part on fat."""
    moved = np.roll(rough.array == 2, 20, axis=0) & (rough.array != 5)
    return ct, rough.with_array(np.where(moved, 2, np.where(rough.array == 5, 5, 0)).astype(np.uint8))


BAD: list[tuple[Callable[[Image, Image], tuple[Image, Image]], list[str], str]] = [
    (_other_grid, [], "different size (84 x 64 x 64 and 84 x 64 x 60 voxels)"),
    (_other_place, [], "up to 4 mm apart"),
    (_labels_for_ct, [], "a label map?"),
    (_no_offset, [], "not Hounsfield units"),
    (_dark_blood, [], "blood is darker than the wall"),
    (_no_muscle, [], "label 5 (myocardium) has no voxel"),
    (_thin_muscle, [], "nowhere thick enough to sample"),
    (_elsewhere, ["--blood-box", "20,30,20,30,20,30"], "does not lie on this CT's atrium"),
    (lambda ct, rough: (ct, rough), ["--la", "9"], "label 9 (left atrium's blood) has no voxel"),
    (lambda ct, rough: (ct, rough), ["--myocardium-box", "900,910,0,9,0,9"], "reaches out of the image"),
    (lambda ct, rough: (ct, rough), ["--valve-sphere", "25.6,25.6,25.6,30"], "leaves nothing"),
    (lambda ct, rough: (ct, rough), ["--voxel-mm", "0.1"], "too large to hold"),
    (lambda ct, rough: (ct, rough), ["--wall-label", "2"], "must differ"),
]


@pytest.mark.parametrize(("harm", "options", "words"), BAD, ids=[words for *_, words in BAD])
def test_bad_input_gets_one_message_and_leaves_nothing(
    harm: Callable[[Image, Image], tuple[Image, Image]], options: list[str], words: str, tmp_path: Path
) -> None:
    ct, rough = harm(*ball())
    write(ct, tmp_path / "ct.nrrd")
    write(rough, tmp_path / "rough.nrrd")
    out = tmp_path / "out" / "map.nrrd"
    given = ["segment", str(tmp_path / "ct.nrrd"), "--labels", str(tmp_path / "rough.nrrd"), "--out", str(out)]
    given += ["--myocardium", "5", *([] if "--la" in options else ["--la", "2"])]
    answer = CliRunner().invoke(main.build({"segment"}), given + options)
    assert answer.exit_code != 0
    assert words in str(answer.exception)
    assert not out.parent.exists() or not list(out.parent.iterdir())


@pytest.mark.parametrize(
    "options",
    [
        ["--valve-plane", "1,2,3"], ["--valve-plane", "1,2,3,0,0,0"], ["--valve-sphere", "1,2,3,-4"],
        ["--valve-sphere", "1,2,3,nan"],
        ["--blood-box", "1,0,0,1,0,1"], ["--voxel-mm", "5"], ["--out", "map.txt"], ["--wall-label", "300"], ["--la", "0"],
        ["--valve-plane", "1,2,3,0,0,1", "--valve-sphere", "1,2,3,4"],
    ],
)  # fmt: skip
def test_bad_options_are_refused_before_anything_is_read(options: list[str]) -> None:
    given = ["segment", "absent.nrrd", "--labels", "absent.nrrd", *([] if "--la" in options else ["--la", "2"]), *options]
    answer = CliRunner().invoke(main.build({"segment"}), given)
    assert getattr(answer.exception, "exit_code", answer.exit_code) == 2, answer.exception
    assert "absent" not in str(answer.exception)


def test_the_command_writes_map_report_surface_and_picture(tmp_path: Path) -> None:
    ct, rough = ball()
    write(ct, tmp_path / "ct.nrrd")
    write(rough, tmp_path / "rough.nrrd")
    given = ["segment", str(tmp_path / "ct.nrrd"), "--labels", str(tmp_path / "rough.nrrd"), "--la", "2"]
    given += ["--myocardium-box", "52,62,10,40,10,40", "--out", str(tmp_path / "a.nii.gz"), "--json", "--voxel-mm", "0.6"]
    answer = CliRunner().invoke(main.build({"segment"}), given, catch_exceptions=False)
    assert answer.exit_code == 0
    document = json.loads(answer.stdout)
    assert document["thickness"][0]["name"] == "whole"
    assert document["thickness"][0]["mean_mm"] == pytest.approx(WALL, abs=0.1)
    assert json.loads((tmp_path / "a.json").read_text()) == {k: v for k, v in document.items() if k != "out"}
    assert {"a.nii.gz", "a.json", "a.vtp", "a.png"} <= {p.name for p in tmp_path.iterdir()}
    assert not list(tmp_path.glob(".part-*"))


def test_ranges_that_overlap_are_said_and_no_contrast_is_refused() -> None:
    blood = intensities.Tissue(300.0, 40.0, 500, "here")
    assert "overlap" in intensities.check(blood, intensities.Tissue(110.0, 30.0, 500, "there"))[0]
    assert intensities.check(blood, intensities.Tissue(60.0, 30.0, 500, "there")) == []  # 300 - 120 > 60 + 90
    with pytest.raises(Exception, match="hardly differs"):
        intensities.check(blood, intensities.Tissue(245.0, 5.0, 500, "there"))


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda n: np.linalg.norm(n) > 0.1), st.floats(-9.0, 9.0), st.floats(0.1, 9.0)
)
def test_what_is_past_the_valve(normal: tuple[float, ...], height: float, radius: float) -> None:
    way = np.array(normal) / np.linalg.norm(normal)
    centre = np.array([3.0, -2.0, 5.0])
    point = (centre + height * way)[None]
    if abs(height) > 1e-9:
        assert Crop(centre, 7.0 * way).beyond(point)[0] == (height > 0)
    if abs(abs(height) - radius) > 1e-9:
        assert Crop(centre, None, radius).beyond(point)[0] == (abs(height) < radius)
