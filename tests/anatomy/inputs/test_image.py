"""Images: physical coordinates whatever the axes, damaged files, labels to surfaces of their volume."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.anatomy.inputs import extraction, image
from lacli.anatomy.inputs.image import Image
from lacli.base.errors import AnatomyError, InputError

CENTRE, RADIUS = np.array([12.0, -30.0, 55.0]), 15.0


def ball(
    order: tuple[int, int, int] = (0, 1, 2),
    signs: tuple[int, int, int] = (1, 1, 1),
    spacing: tuple[float, float, float] = (0.8, 1.0, 1.3),
) -> Image:
    """A ball of label 1 at CENTRE on a grid whose axes i, j, k run along the world's axes ``order`` with ``signs``."""
    direction = np.zeros((3, 3))
    for column, (axis, sign) in enumerate(zip(order, signs, strict=True)):
        direction[axis, column] = sign
    step = np.array(spacing)
    size = np.ceil(48.0 / step).astype(int)
    origin = CENTRE - direction @ ((size - 1) / 2 * step) + 0.13
    empty = Image(np.zeros(size[::-1], dtype=np.int16), step, origin, direction)
    index = np.argwhere(empty.array == 0)[:, ::-1].astype(float)
    inside = np.linalg.norm(empty.to_world(index) - CENTRE, axis=1) < RADIUS
    return empty.with_array(inside.reshape(empty.array.shape).astype(np.int16))


@pytest.mark.parametrize("ending", ["nrrd", "nii.gz", "mha"])
@pytest.mark.parametrize(("order", "signs"), [((0, 1, 2), (1, 1, 1)), ((2, 0, 1), (1, -1, 1)), ((1, 2, 0), (-1, 1, -1))])
def test_a_ball_stays_where_it_is_in_every_format_and_orientation(
    tmp_path: Path, ending: str, order: tuple[int, int, int], signs: tuple[int, int, int]
) -> None:
    image.write(ball(order, signs), tmp_path / f"ball.{ending}")
    back = image.read(tmp_path / f"ball.{ending}")
    surface = extraction.surface_of(extraction.blood_pool(back, 1).mask)
    assert surface.points.mean(axis=0) == pytest.approx(CENTRE, abs=0.15)
    assert surface.is_closed()
    assert surface.volume_ml() == pytest.approx(back.array.sum() * back.voxel_ml, rel=2e-3)
    # 4/3 pi 15^3 = 14.137 mL; voxels of 1 mm3 know it to half a per cent
    assert surface.volume_ml() == pytest.approx(14.137, rel=0.01)
    assert np.linalg.norm(surface.points - CENTRE, axis=1) == pytest.approx(RADIUS, abs=0.45)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 5), st.tuples(*[st.sampled_from([-1, 1])] * 3), st.lists(st.floats(-50, 50), min_size=3, max_size=3))
def test_index_and_world_are_inverse(turn: int, signs: tuple[int, int, int], index: list[float]) -> None:
    from itertools import permutations

    grid = ball(list(permutations(range(3)))[turn], signs, (4.0, 5.0, 6.0))
    assert grid.to_index(grid.to_world(np.array([index]))) == pytest.approx(np.array([index]), abs=1e-9)


def test_a_thin_tube_does_not_shrink() -> None:
    # radius 4 mm along z; a plain Gaussian of the same width would lose 0.16 mm of it
    step = 0.6
    x, y = np.meshgrid(*[np.arange(-15, 15, step)] * 2)
    tube = np.repeat((np.hypot(x, y) < 4.0)[None], 60, axis=0)
    head = np.pad(tube, ((5, 5), (0, 0), (0, 0)))
    field = extraction.smooth_field(Image(head, np.full(3, step), np.zeros(3), np.eye(3)), 0.8, step)
    area = (np.clip(field.array[35], 0, 1) > 0.5).sum() * step**2
    assert area == pytest.approx(np.pi * 16, rel=0.03)


def test_damaged_images_are_named(tmp_path: Path) -> None:
    whole = tmp_path / "ball.nii.gz"
    image.write(ball(), whole)
    content = whole.read_bytes()
    (tmp_path / "short.nii.gz").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="truncated"):
        image.read(tmp_path / "short.nii.gz")
    plain = bytearray(gzip.decompress(content))
    (tmp_path / "short.nii").write_bytes(bytes(plain[:-5000]))
    with pytest.raises(InputError, match="truncated"):
        image.read(tmp_path / "short.nii")
    plain[280:284] = struct.pack("<f", float("nan"))  # srow_x[0]
    (tmp_path / "nan.nii").write_bytes(bytes(plain))
    with pytest.raises(InputError, match="not finite"):
        image.read(tmp_path / "nan.nii")
    (tmp_path / "empty.nrrd").write_bytes(b"")
    with pytest.raises(InputError, match="empty"):
        image.read(tmp_path / "empty.nrrd")
    (tmp_path / "text.nrrd").write_text("this is not an image")
    with pytest.raises(InputError, match="cannot be read"):
        image.read(tmp_path / "text.nrrd")
    with pytest.raises(InputError, match="no such file"):
        image.read(tmp_path / "absent.mha")


def test_split_and_absent_labels_are_refused_and_islands_dropped() -> None:
    one = ball()
    cut = one.array.copy()
    middle = cut.shape[0] // 2
    cut[middle - 2 : middle + 2] = 0
    with pytest.raises(AnatomyError, match="2 unconnected parts"):
        extraction.blood_pool(one.with_array(cut), 1)
    with pytest.raises(AnatomyError, match="no voxel"):
        extraction.blood_pool(one, 7)
    speck = one.array.copy()
    speck[0, 0, 0] = 1
    speck[middle, 20:22, 25:27] = 0  # a closed hole near the middle
    pool = extraction.blood_pool(one.with_array(speck), 1)
    assert len(pool.notes) == 2
    assert pool.mask.array.sum() == one.array.sum()


def test_a_ct_volume_is_no_label_map() -> None:
    noisy = ball().with_array(np.random.default_rng(1).normal(0, 100, ball().array.shape))
    with pytest.raises(AnatomyError, match="fractional"):
        image.label_volumes(noisy)


@pytest.mark.parametrize("ending", ["nrrd", "nii", "nii.gz", "mha"])
@pytest.mark.parametrize(
    "content", [b"\x89PNG\r\n\x1a\n" + bytes(512), b"\x89HDF\r\n\x1a\n" + bytes(512), b"II*\0" + bytes(512), b"BM" + bytes(512)]
)
def test_a_file_of_another_format_is_one_message_of_ours(
    ending: str, content: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / f"x.{ending}").write_bytes(content)
    with pytest.raises(InputError, match=rf"x\.{ending}: "):
        image.read(tmp_path / f"x.{ending}")
    said = capfd.readouterr()
    assert said.out == said.err == ""
