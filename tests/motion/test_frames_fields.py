"""Frames, their times, and displacement fields as they are read."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lacli.anatomy.inputs import image as images
from lacli.anatomy.inputs.image import Image, write
from lacli.base.errors import InputError, UsageError
from lacli.motion import frames as framing
from lacli.motion import tracking
from lacli.motion.field import Field, pull, read_field, write_field
from lacli.motion.frames import Source


def constant_field(vector: tuple[float, float, float], size: int = 12, spacing: float = 2.0) -> Field:
    u = np.broadcast_to(np.array(vector, dtype=np.float32), (size, size, size, 3)).copy()
    return Field(u, np.full(3, spacing), np.zeros(3), np.eye(3))


# --- frames and times -------------------------------------------------------------------------------------------------------


def test_frames_come_by_the_numbers_in_their_names(tmp_path: Path) -> None:
    image = Image(np.zeros((4, 4, 4), np.int16), np.ones(3), np.zeros(3), np.eye(3))
    for number in (10, 9, 0, 1):
        write(image, tmp_path / f"phase_{number}.nrrd")
    assert [s.path.name for s in framing.find([tmp_path])] == ["phase_0.nrrd", "phase_1.nrrd", "phase_9.nrrd", "phase_10.nrrd"]


@pytest.mark.parametrize(
    "names",
    [
        ["ct_0.0.nrrd", "ct_0.05.nrrd", "ct_0.1.nrrd", "ct_0.4.nrrd"],
        ["frame2.nrrd", "frame10.nrrd"],
        ["ct_0.nrrd", "ct_5.nrrd", "ct_10.nrrd", "ct_100.nrrd"],
        ["p1_0.4_s2.mha", "p1_0.4_s10.mha", "p2_0.05_s1.mha", "p2_0.3_s1.mha"],
        ["1.2.840.9", "1.2.840.10", "1.2.840.10.1"],
        [f"ct_1.{number}.nii.gz" for number in range(1, 12)],  # as decimals 1.1 and 1.10 would be one
        ["frame.0.05.nrrd", "frame.0.4.nrrd"],
    ],
)
def test_numbers_in_names_count_by_value(names: list[str]) -> None:
    given = [Path(name) for name in np.random.default_rng(0).permutation(names)]
    assert [path.name for path in framing.by_number(given)] == names


def test_frames_of_one_file_with_four_dimensions(tmp_path: Path) -> None:
    import SimpleITK as sitk

    array = np.arange(5 * 4 * 3 * 2, dtype=np.int16).reshape(5, 4, 3, 2)
    sitk.WriteImage(sitk.JoinSeries([sitk.GetImageFromArray(a) for a in array]), str(tmp_path / "ct.nii.gz"))
    sources = framing.find([tmp_path / "ct.nii.gz"])
    assert len(sources) == 5
    assert np.array_equal(framing.read(sources[3]).array, array[3])


def four_d(file: Path, spacing: float = 1.0, **fields: tuple[str, int, tuple[float, ...]]) -> Path:
    """Three frames of 6 x 5 x 4 voxels in one NIfTI file, fields of its header changed: struct format, offset, values."""
    import SimpleITK as sitk

    made = [sitk.GetImageFromArray(np.full((4, 5, 6), 10.0 * number, np.float32)) for number in range(3)]
    for one in made:
        one.SetSpacing([spacing] * 3)
    sitk.WriteImage(sitk.JoinSeries(made), str(file))
    content = bytearray(file.read_bytes())
    for kind, at, values in fields.values():
        struct.pack_into("<" + kind, content, at, *values)
    file.write_bytes(bytes(content))
    return file


def test_a_frame_of_four_dimensions_is_held_to_what_a_file_of_three_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import SimpleITK as sitk

    values = np.full((3, 4, 5, 6), 10.0, np.float32)
    values[2, 1, 1, 1] = np.nan
    sitk.WriteImage(sitk.JoinSeries([sitk.GetImageFromArray(one) for one in values]), str(tmp_path / "nan.mha"))
    assert framing.read(Source(tmp_path / "nan.mha", 1)).array[0, 0, 0] == 10.0
    with pytest.raises(InputError, match=r"nan\.mha \(frame 2\): 1 voxels are not finite"):
        framing.read(Source(tmp_path / "nan.mha", 2))
    with pytest.raises(InputError, match=r"fine\.nii \(frame 0\): the voxels are 0\.001 x .* no heart's image has"):
        framing.read(Source(four_d(tmp_path / "fine.nii", 0.001), 0))
    usual = four_d(tmp_path / "usual.nii")
    (tmp_path / "cut.nii").write_bytes(usual.read_bytes()[:-8])
    with pytest.raises(InputError, match="the file is truncated"):
        framing.read(Source(tmp_path / "cut.nii", 0))
    monkeypatch.setattr(images, "MOST_BYTES", 400)  # a frame has 480
    with pytest.raises(InputError, match=r"6 x 5 x 4 voxels of 4 bytes .* crop the image"):
        framing.read(Source(usual, 0))


def test_of_two_transforms_in_a_header_the_sform_holds_and_it_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The sform's rows begin at byte 280: it is moved by 7 mm along x, to the right in NIfTI's axes."""
    file = four_d(tmp_path / "two.nii", sform=("f", 280 + 12, (7.0,)))
    for check in ("check_hounsfield", "check_is_bundles_image", "check_same_grid"):
        monkeypatch.setattr(framing, check, lambda *_: 1.0)
    surface = SimpleNamespace(ed=np.array([[-7.0, 0, 0], [-2.0, 4, 3]]))
    tracking.load_frames(framing.find([file]), surface, 0.9, lambda *_: None)  # type: ignore[arg-type]
    assert framing.read(Source(file, 1)).origin == pytest.approx([-7.0, 0.0, 0.0])
    (told,) = [record.getMessage() for record in caplog.records]
    assert "two.nii (frame 0): the NIfTI header holds two transforms that differ by 7 mm" in told


@pytest.mark.parametrize(
    ("given_times", "expected"), [([0, 25, 50], [0, 0.25, 0.5]), ([5, 30, 105], [0, 0.25, 1.0]), ([0.1, 0.2, 0.4], [0, 0.1, 0.3])]
)
def test_times_are_fractions_or_percentages_from_the_first_frame(given_times: list[float], expected: list[float]) -> None:
    times, _ = framing.cycle_times([Source(Path(str(i))) for i in range(3)], given_times)
    assert times == pytest.approx(expected)


@pytest.mark.parametrize("bad", [[0, 0.5, 0.5], [0, 0.5, 0.4], [0, 0.5], [0, float("nan"), 0.6], [0, 50, 101], [0, 0.5, 1.2]])
def test_times_that_do_not_rise_within_a_cycle_are_refused(bad: list[float]) -> None:
    with pytest.raises(UsageError):
        framing.cycle_times([Source(Path(str(i))) for i in range(3)], bad)


def test_averaging_keeps_places_and_reduces_noise() -> None:
    """A linear ramp in x stays at its place in coarser voxels; noise of sd 20 averaged over about 8 voxels falls below 10."""
    rng = np.random.default_rng(0)
    ramp = np.broadcast_to(np.arange(60) * 0.45, (60, 60, 60))
    fine = Image(ramp + rng.normal(0, 20, ramp.shape), np.full(3, 0.45), np.array([3.0, -4.0, 5.0]), np.eye(3))
    coarse = framing.around(fine, np.array([[3.0, -4.0, 5.0], [29.0, 22.0, 31.0]]), 0.9)
    assert coarse.spacing == pytest.approx([0.9] * 3)
    inner = coarse.array[5:-5, 5:-5, 5:-5]
    x = np.arange(coarse.array.shape[2])[5:-5] * 0.9
    assert np.abs(inner.mean(axis=(0, 1)) - x).max() < 3.0
    assert (inner - x).std() < 10.0


# --- fields -----------------------------------------------------------------------------------------------------------------


def test_a_field_is_read_in_lps_and_turned_from_ras(tmp_path: Path) -> None:
    write_field(constant_field((1.0, 2.0, 3.0)), tmp_path / "u.nrrd")
    at = np.array([[3.0, 5.0, 7.0]])
    assert read_field(tmp_path / "u.nrrd").at(at)[0] == pytest.approx([1, 2, 3])
    assert read_field(tmp_path / "u.nrrd", "ras").at(at)[0] == pytest.approx([-1, -2, 3])


def test_pulling_an_image_back_brings_what_is_at_x_plus_u() -> None:
    """A ramp of 1 HU a mm along x, shifted by 2 mm, is 2 HU higher; turned axes change nothing, u is in millimetres of LPS."""
    x = 2.0 * np.arange(12)
    image = Image(np.broadcast_to(x, (12, 12, 12)).astype(np.float32), np.full(3, 2.0), np.zeros(3), np.eye(3))
    moved = pull(image, constant_field((2.0, 0.0, 0.0)))
    assert np.allclose(moved.array[..., 3:-3], image.array[..., 3:-3] + 2.0, atol=1e-3)
    turned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    field = Field(constant_field((0.0, 2.0, 0.0)).u, np.full(3, 2.0), np.zeros(3), turned)
    moved = pull(Image(image.array, image.spacing, image.origin, turned), field)  # i runs along y here
    assert np.allclose(moved.array[..., 3:-3], image.array[..., 3:-3] + 2.0, atol=1e-3)


def test_the_inverse_of_a_smooth_field_undoes_it() -> None:
    k, j, i = np.meshgrid(*[np.arange(24.0)] * 3, indexing="ij")
    u = np.stack([np.sin(j / 6.0), np.cos(k / 7.0), 0.5 * np.sin(i / 8.0)], axis=-1).astype(np.float32)
    field = Field(u, np.ones(3), np.zeros(3), np.eye(3))
    points = np.random.default_rng(1).uniform(6, 17, (50, 3))
    v = field.inverse(every=1)
    assert np.abs(v.at(points) + field.at(points + v.at(points))).max() < 0.05
    w = field.solve_inverse_at(points, -field.at(points))
    assert np.abs(w + field.at(points + w)).max() < 1e-4
