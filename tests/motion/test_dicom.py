"""DICOM series as frames: phases from their headers, and a missing slice."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy.inputs import image as images
from lacli.base.errors import InputError
from lacli.motion import frames as framing


def dicom_series(
    folder: Path, volume: np.ndarray, number: int, phase: float, left_out: tuple[int, ...] = (), mm: float = 0.5
) -> None:
    """A folder with one DICOM file a slice."""
    import SimpleITK as sitk

    folder.mkdir()
    for k, plane in enumerate(volume):
        if k in left_out:
            continue
        image = sitk.GetImageFromArray(plane[None])
        image.SetSpacing([mm, mm, 1.5])
        tags = {
            "0020|000e": f"1.2.3.{number}", "0020|000d": "1.2.3", "0008|0060": "CT", "0020|0013": str(k),
            "0020|0032": f"10\\20\\{1.5 * k}", "0020|0037": "1\\0\\0\\0\\1\\0", "0018|0050": "1.5",
            "0018|1060": str(10.0 * phase), "0018|1062": "1000",
        }  # fmt: skip
        for tag, value in tags.items():
            image.SetMetaData(tag, value)
        writer = sitk.ImageFileWriter()
        writer.KeepOriginalImageUIDOn()
        writer.SetFileName(str(folder / f"{k}.dcm"))
        writer.Execute(image[:, :, 0] if image.GetDimension() == 2 else image)


def test_dicom_series_are_frames_with_the_phases_of_their_headers(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    volumes = rng.integers(-200, 500, (3, 4, 8, 8)).astype(np.int16)
    for number, (volume, phase) in enumerate(zip(volumes, (0.0, 40.0, 70.0), strict=True)):
        dicom_series(tmp_path / f"phase{number}", volume, number, phase)
    sources = framing.find([tmp_path])
    times, origin = framing.cycle_times(sources, None)
    assert times == pytest.approx([0.0, 0.4, 0.7]) and "DICOM" in origin
    image = framing.read(sources[1])
    assert np.array_equal(image.array, volumes[1])
    assert image.spacing == pytest.approx([0.5, 0.5, 1.5]) and image.origin == pytest.approx([10, 20, 0])


def test_a_dicom_series_without_one_of_its_slices_is_refused(tmp_path: Path) -> None:
    volume = np.random.default_rng(0).integers(-200, 500, (6, 8, 8)).astype(np.int16)
    dicom_series(tmp_path / "ed", volume, 1, 0.0, left_out=(3,))
    with pytest.raises(InputError, match=r"slices 3 and 4 of 5 are 3 mm apart, the others 1\.5 mm; is a slice missing"):
        framing.read(framing.Source(tmp_path / "ed"))
    dicom_series(tmp_path / "whole", volume, 2, 0.0, left_out=(0,))
    assert framing.read(framing.Source(tmp_path / "whole")).array.shape == (5, 8, 8)


def test_series_of_one_phase_are_told_from_each_other_by_their_folders(tmp_path: Path) -> None:
    """In one folder nothing says which comes first."""
    volume = np.random.default_rng(0).integers(-200, 500, (4, 8, 8)).astype(np.int16)
    for number, phase in enumerate((0.0, 40.0, 40.0)):
        dicom_series(tmp_path / f"phase{number}", volume, number, phase)
        (tmp_path / "all").mkdir(exist_ok=True)
        for file in (tmp_path / f"phase{number}").iterdir():
            shutil.copy(file, tmp_path / "all" / f"{number}_{file.name}")
    with pytest.raises(InputError, match=r"all: two DICOM series have the same cardiac phase \(0\.4 of RR\): .* of its own"):
        framing.find([tmp_path / "all"])
    assert len(framing.find([tmp_path / f"phase{number}" for number in range(3)])) == 3


def test_a_dicom_series_is_held_to_what_a_file_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    volume = np.random.default_rng(0).integers(-200, 500, (4, 8, 8)).astype(np.int16)
    dicom_series(tmp_path / "fine", volume, 1, 0.0, mm=0.005)
    with pytest.raises(InputError, match=r"fine: the voxels are 0\.005 x 0\.005 x 1\.5 mm, which no heart's image has"):
        framing.read(framing.Source(tmp_path / "fine"))
    dicom_series(tmp_path / "usual", volume, 2, 0.0)
    monkeypatch.setattr(images, "MOST_BYTES", 500)  # 4 x 8 x 8 voxels of 2 bytes are 512
    with pytest.raises(InputError, match=r"usual: 8 x 8 x 4 voxels of 2 bytes"):
        framing.read(framing.Source(tmp_path / "usual"))
