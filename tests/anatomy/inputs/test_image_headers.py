"""What an image's header says is held against itself, the same in every format, before voxels are read."""

from __future__ import annotations

import gzip
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from lacli.anatomy.inputs import extraction, image, nifti
from lacli.anatomy.inputs.image import Image
from lacli.base.errors import AnatomyError, InputError

FORMATS = ("nrrd", "nhdr", "mha", "mhd", "nii", "nii.gz")
STEP = 1.2


def block(spacing: float = STEP) -> Image:
    """40 voxels along each axis; label 2 is a box of 20 x 22 x 24 of them: at 1.2 mm 18.25 mL."""
    array = np.zeros((40, 40, 40), dtype=np.int16)
    array[8:32, 9:31, 10:30] = 2
    return Image(array, np.full(3, spacing), np.array([-20.0, -30.0, 5.0]), np.eye(3))


def written(folder: Path, ending: str, made: Image) -> Path:
    file = folder / f"x.{ending}"
    if ending.endswith(("nii", "nii.gz")):
        image.write(made, file)
    else:  # the writer here takes a temporary name, which a header beside its data would keep
        out = sitk.GetImageFromArray(made.array)
        out.SetSpacing(made.spacing.tolist())
        out.SetOrigin(made.origin.tolist())
        out.SetDirection(made.direction.ravel().tolist())
        sitk.WriteImage(out, str(file))
    return file


def patched(file: Path, **fields: tuple[str, int, tuple[float, ...]]) -> Path:
    """A NIfTI-1 file with some fields of its header changed: struct format, offset, values."""
    packed = file.name.endswith(".gz")
    content = bytearray(gzip.decompress(file.read_bytes()) if packed else file.read_bytes())
    for kind, at, values in fields.values():
        struct.pack_into("<" + kind, content, at, *values)
    file.write_bytes(gzip.compress(bytes(content)) if packed else bytes(content))
    return file


def rows(turn_deg: float = 0.0, scale: float = 1.0, shift: float = 0.0, tilt_deg: float = 0.0) -> tuple[float, ...]:
    """srow_x, srow_y, srow_z (RAS) of ``block``, turned about z, scaled, moved along x, its k axis tilted towards j."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    axes = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ np.diag([-1.0, -1.0, 1.0]) * STEP * scale
    k = np.cos(np.radians(tilt_deg)) * axes[:, 2] + np.sin(np.radians(tilt_deg)) * axes[:, 1]
    axes = np.column_stack([axes[:, :2], k])
    return tuple(np.column_stack([axes, [20.0 + shift, 30.0, 5.0]]).ravel())


@pytest.mark.parametrize("ending", FORMATS)
def test_a_straight_image_is_read_without_doubt(tmp_path: Path, ending: str) -> None:
    made = block()
    back = image.read(written(tmp_path, ending, made))
    assert back.spacing == pytest.approx(made.spacing, rel=1e-6)
    assert back.origin == pytest.approx(made.origin, abs=1e-5)
    assert back.direction == pytest.approx(np.eye(3), abs=1e-6)
    assert back.doubts(np.zeros(3)) == []
    assert np.array_equal(back.array, made.array)
    # 20 * 22 * 24 * 1.2^3 = 18247.7 mm3
    assert image.label_volumes(back)[2] == pytest.approx(18.2477, abs=1e-4)
    assert extraction.blood_pool(back, 2).notes == ()


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("tilt", [1.0, 5.0, 15.0, 27.0, 60.0])
def test_a_tilted_gantry_is_refused_with_its_angle(tmp_path: Path, ending: str, tilt: float) -> None:
    axis = np.array([0.0, np.sin(np.radians(tilt)), np.cos(np.radians(tilt))])
    if ending.startswith("nii"):
        file = patched(written(tmp_path, ending, block()), s=("12f", 280, rows(tilt_deg=tilt)), code=("2h", 252, (0, 1)))
    else:
        file = written(
            tmp_path, ending, Image(block().array, np.full(3, STEP), np.zeros(3), np.column_stack([np.eye(3)[:, :2], axis]))
        )
    with pytest.raises(InputError, match=rf"not perpendicular, j and k are {tilt:.1f} degrees off .*tilted gantry"):
        image.read(file)


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize(
    ("spacing", "words"), [(0.0012, "metres"), (1200.0, "micrometres"), (1e-7, "no heart"), (1e6, "no heart")]
)
def test_spacing_in_another_unit_is_named(tmp_path: Path, ending: str, spacing: float, words: str) -> None:
    with pytest.raises(InputError, match=f"mm, which no heart's image has.*{'' if words == 'no heart' else words}"):
        image.read(written(tmp_path, ending, block(spacing)))


def test_lengths_in_centimetres_are_told_by_the_volume() -> None:
    with pytest.raises(AnatomyError, match=r"too little for a left atrium.*centimetres"):  # 0.0365 mL; 36.5 mL in cm
        extraction.blood_pool(block(0.12 * 2 ** (1 / 3)), 2)
    with pytest.raises(AnatomyError, match="too much"):
        extraction.blood_pool(block(8.0), 2)


@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
@pytest.mark.parametrize(("unit", "code", "factor"), [("metres", 1, 1e3), ("micrometres", 3, 1e-3)])
def test_units_of_nifti(tmp_path: Path, ending: str, unit: str, code: int, factor: float) -> None:
    file = patched(written(tmp_path, ending, block(STEP)), unit=("B", 123, (code,)))
    with pytest.raises(InputError, match=f"the header says the lengths are {unit}: correct xyzt_units"):
        image.read(file)
    if code == 1:  # and where they are meant so, they are read so
        right = patched(file, pix=("3f", 80, (STEP / factor,) * 3), codes=("2h", 252, (0, 1)),
                        rows=("12f", 280, tuple(v / factor for v in rows())))  # fmt: skip
        assert image.read(right).spacing == pytest.approx(np.full(3, STEP), rel=1e-6)
    unknown = patched(written(tmp_path, ending, block(STEP)), unit=("B", 123, (0,)))
    assert image.read(unknown).spacing == pytest.approx(np.full(3, STEP), rel=1e-6)


@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
def test_two_transforms_that_differ_are_said_and_the_sform_used(tmp_path: Path, ending: str) -> None:
    file = patched(written(tmp_path, ending, block()), s=("12f", 280, rows(30.0, shift=40.0)), codes=("2h", 252, (1, 1)))
    made = image.read(file)
    assert made.direction[:, 0] == pytest.approx([np.cos(np.pi / 6), np.sin(np.pi / 6), 0], abs=1e-6)  # LPS, as about -z twice
    assert made.origin == pytest.approx([-60.0, -30.0, 5.0], abs=1e-4)
    (note,) = extraction.blood_pool(made, 2).notes
    assert "30 degrees at the atrium" in note
    assert "the sform is used" in note
    # of the label's centre, index (19.5, 19.5, 19.5): LPS by sform minus by qform
    x = 19.5 * STEP
    turned = np.array([[np.cos(np.pi / 6), -0.5], [0.5, np.cos(np.pi / 6)]]) @ [x, x] + [-60.0, -30.0]
    assert f"differ by {np.linalg.norm(turned - [x - 20.0, x - 30.0]):.3g} mm" in note
    same = patched(file, s=("12f", 280, rows()))
    assert image.read(same).rival is None


@pytest.mark.parametrize("scale", [2.0, 0.5, 1.05])
def test_sform_against_pixdim(tmp_path: Path, scale: float) -> None:
    file = patched(written(tmp_path, "nii.gz", block()), s=("12f", 280, rows(scale=scale)), codes=("2h", 252, (0, 2)))
    with pytest.raises(InputError, match=rf"columns of the sform are {1.2 * scale:.4g} x .* pixdim says 1.2 x 1.2 x 1.2 mm"):
        image.read(file)


def test_neither_transform_is_said(tmp_path: Path) -> None:
    made = image.read(patched(written(tmp_path, "nii", block()), codes=("2h", 252, (0, 0))))
    assert "neither qform nor sform" in made.doubts(np.zeros(3))[0]


@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
@pytest.mark.parametrize(("slope", "fine"), [(1 + 1e-7, True), (1.0002, True), (1.01, False), (0.5, True), (0.3, False)])
def test_labels_that_are_almost_whole_are_rounded(tmp_path: Path, ending: str, slope: float, fine: bool) -> None:
    file = patched(written(tmp_path, ending, block()), scl=("2f", 112, (slope, 0.0)))
    if not fine:
        with pytest.raises(AnatomyError, match="fractional"):
            image.read_labels(file)
        return
    labels = image.read_labels(file)
    assert labels.array.dtype.kind == "i"
    assert image.label_volumes(labels) == {round(2 * slope): pytest.approx(18.2477, abs=1e-4)}


@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
def test_dimensions_beyond_memory_are_refused_by_the_header(tmp_path: Path, ending: str) -> None:
    file = patched(written(tmp_path, ending, block()), dim=("8h", 40, (3, 20000, 20000, 20000, 1, 1, 1, 1)))
    with pytest.raises(InputError, match=r"20000 x 20000 x 20000 voxels .* crop the image"):
        image.read(file)


def test_a_compressed_file_is_not_unpacked_beyond_its_voxels(tmp_path: Path) -> None:
    import tracemalloc

    file = written(tmp_path, "nii", block())
    bomb = tmp_path / "bomb.nii.gz"
    with gzip.open(bomb, "wb", compresslevel=1) as stream:
        stream.write(file.read_bytes())
        for _ in range(64):
            stream.write(bytes(4 << 20))
    tracemalloc.start()
    nifti.read_header(bomb)
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.9, 0.999])
def test_truncated_images_are_refused(tmp_path: Path, ending: str, share: float) -> None:
    noisy = block().with_array(np.random.default_rng(0).integers(0, 4, (40, 40, 40)).astype(np.int16))
    file = written(tmp_path, ending, noisy)
    data = next((p for p in tmp_path.iterdir() if p.suffix in (".raw", ".zraw") or p.name.endswith("raw.gz")), file)
    content = data.read_bytes()
    data.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError):
        image.read(file)


SIDES = {(0, 0): "right", (0, 1): "left", (1, 0): "anterior", (1, 1): "posterior", (2, 0): "lower", (2, 1): "upper"}


@pytest.mark.parametrize(("axis", "high"), SIDES)
@pytest.mark.parametrize(("width", "body"), [(10, False), (30, True)])
def test_a_label_that_the_border_cuts_is_said(axis: int, high: int, width: int, body: bool) -> None:
    array = np.zeros((50, 50, 50), dtype=np.int16)
    array[8:42, 8:42, 8:42] = 2
    low = 25 - width // 2
    place = [slice(low, low + width)] * 3
    place[2 - axis] = slice(25, None) if high else slice(0, 25)
    array[tuple(place)] = 2
    (note,) = extraction.blood_pool(Image(array, np.full(3, 1.0), np.zeros(3), np.eye(3)), 2).notes
    assert f"{SIDES[axis, high]} border" in note
    # 10 x 10 voxels of 1 mm2 are 1 cm2, 30 x 30 are 9 cm2
    assert f"{width**2} voxels, {width**2 / 100:.3g} cm2" in note
    assert ("may be cut" in note) == body


@pytest.mark.parametrize(
    ("ending", "left_out", "words"),
    [
        ("nrrd", (b"space directions", b"space origin", b"space"), ("no voxel size: voxels of 1 mm", "LPS is a guess")),
        ("nhdr", (b"space directions",), ("no voxel size", "LPS is a guess")),
        ("mha", (b"ElementSpacing",), ("no voxel size",)),
        ("mhd", (b"TransformMatrix", b"Offset"), ("LPS is a guess",)),
        *((ending, (), ()) for ending in FORMATS),
    ],
)
def test_what_a_header_does_not_say_is_a_guess_and_told(
    tmp_path: Path, ending: str, left_out: tuple[bytes, ...], words: tuple[str, ...]
) -> None:
    file = written(tmp_path, ending, block())
    if left_out:
        head, mark, rest = file.read_bytes().partition(b"\n\n" if ending == "nrrd" else b"ElementDataFile")
        lines = [line for line in head.splitlines() if re.split(rb"\s*[:=]", line)[0] not in left_out]
        file.write_bytes(b"\n".join(lines) + (b"" if ending == "nrrd" else b"\n") + mark + rest)
    notes = image.read(file).notes
    assert len(notes) == len(words) and all(word in note for word, note in zip(words, notes, strict=True))
    assert extraction.blood_pool(image.read_labels(file), 2).notes[: len(words)] == notes


def test_spacings_without_axes_are_a_size_and_no_direction(tmp_path: Path) -> None:
    file = written(tmp_path, "nrrd", block())
    head, body = file.read_bytes().split(b"\n\n", 1)
    lines = [line for line in head.splitlines() if not line.startswith(b"space")]
    file.write_bytes(b"\n".join([*lines, b"spacings: 1.2 1.2 1.2"]) + b"\n\n" + body)
    made = image.read(file)
    assert made.spacing == pytest.approx([STEP] * 3) and len(made.notes) == 1 and "LPS is a guess" in made.notes[0]
