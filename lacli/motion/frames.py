"""The frames of a gated CT: which files in which order, their times, and each as a small volume around the atrium."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.inputs import image as images
from lacli.anatomy.inputs.image import Image, opened
from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError, UsageError
from lacli.motion.field import to_sitk

MARGIN_MM = 12.0  # more than the width that the engine smooths an update by, at voxels to 2.4 mm
WORK_MM = 0.9
_LABELS_AT_MOST = 64
_INSIDE_MM, _OUTSIDE_MM = 2.5, 3.5
_SAME_MM = 1e-3
FEWEST, MOST = 3, 200
_WHOLE = re.compile(r"(\d+)")
_DECIMAL = re.compile(r"((?<!\d)(?<!\d\.)\d+\.\d+(?!\.?\d)|\d+)")
_FEWEST_PERCENT = 10.0  # times that end between 1 and this are of another unit


@dataclass(frozen=True)
class Source:
    """Where a frame is: a file, one DICOM folder, frame ``index`` of a 4-D file; ``time`` where its header has one."""

    path: Path
    index: int | None = None
    time: float | None = None

    def __str__(self) -> str:
        return str(self.path) if self.index is None else f"{self.path} (frame {self.index})"


def find(paths: Sequence[Path]) -> list[Source]:
    """The frames that paths stand for, in order: files as given; a folder's images by name (numbers by value); a folder's DICOM
    series, one a frame; every frame of a 4-D file. Raises InputError where a path has none."""
    found: list[Source] = []
    for path in paths:
        if path.is_dir():
            found += _folder(path)
        elif not path.is_file():
            raise InputError(f"{path}: no such frame.")
        else:
            found += _file(path)
    if not FEWEST <= len(found) <= MOST:
        raise InputError(
            f"{', '.join(map(str, paths))}: {len(found)} frames; a cycle needs {FEWEST} to {MOST}, end-diastole first."
        )
    return found


def by_number(paths: Iterable[Path]) -> list[Path]:
    """The paths by the numbers in their names, by value: 10 after 9, 0.05 before 0.4.

    A dot between digits is a decimal point, unless there are several (1.2.840) or two names would then be one number: those
    count on from a whole number (1.1 to 1.10).
    """
    named = sorted(paths, key=lambda path: path.name)
    keys = [_numbers(path.name, _DECIMAL) for path in named]
    if any(one in keys[:place] for place, one in enumerate(keys)):
        keys = [_numbers(path.name, _WHOLE) for path in named]
    return [named[place] for place in sorted(range(len(named)), key=keys.__getitem__)]


def _numbers(name: str, number: re.Pattern[str]) -> list[Any]:
    """A name as its words and, at every second place, its numbers."""
    words = number.split(name)
    return [float(word) if place % 2 else word.lower() for place, word in enumerate(words)]


def _folder(folder: Path) -> list[Source]:
    files = by_number(p for p in folder.iterdir() if p.is_file() and images.is_image(p) and p.suffix.lower() != ".img")
    if files:
        return [source for file in files for source in _file(file)]
    series = _series(folder)
    if series:
        return series
    found = [s for inner in by_number(p for p in folder.iterdir() if p.is_dir()) for s in _series(inner)]
    if not found:
        raise InputError(f"{folder}: no image (.nrrd .nii .mha) and no DICOM series in it.")
    return found


def _series(folder: Path) -> list[Source]:
    import SimpleITK as sitk

    sitk.ProcessObject_SetGlobalWarningDisplay(False)
    ids = sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder)) if any(folder.iterdir()) else ()
    found = [Source(folder / f"series {i}" if len(ids) > 1 else folder, None, _dicom_time(folder, i)) for i in ids]
    if len(found) > 1:
        if any(source.time is None for source in found):
            raise InputError(f"{folder}: holds {len(ids)} DICOM series without a cardiac phase; put each in a folder of its own.")
        found.sort(key=lambda source: source.time or 0.0)
        tied = next(((a, b) for a, b in itertools.pairwise(found) if a.time == b.time), None)
        if tied is not None:
            raise InputError(
                f"{folder}: two DICOM series have the same cardiac phase ({tied[0].time:g} of RR): {tied[0].path.name} and "
                f"{tied[1].path.name}. Put each frame in a folder of its own, and leave out what is none."
            )
    return found


def _dicom_time(folder: Path, series: str) -> float | None:
    """Fraction of the RR interval from the header: its percentage, or trigger time over the nominal interval."""
    import SimpleITK as sitk

    names = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series)
    reader = sitk.ImageFileReader()
    reader.SetFileName(names[0])
    reader.LoadPrivateTagsOn()
    try:
        reader.ReadImageInformation()
    except RuntimeError:
        return None

    def number(tag: str) -> float | None:
        try:
            return float(reader.GetMetaData(tag)) if reader.HasMetaDataKey(tag) else None
        except ValueError:
            return None

    percentage, trigger, interval = number("0020|9241"), number("0018|1060"), number("0018|1062")
    if percentage is not None:
        return percentage / 100.0
    return trigger / interval if trigger is not None and interval else None


def _file(path: Path) -> list[Source]:
    """One frame, or those of a 4-D file."""
    import SimpleITK as sitk

    reader = opened(path)
    sitk.ProcessObject_SetGlobalWarningDisplay(False)
    try:
        reader.ReadImageInformation()
    except RuntimeError:
        return [Source(path)]  # the reader that reads it says what is wrong
    if reader.GetDimension() == 4 and reader.GetSize()[3] > 1:
        return [Source(path, index) for index in range(reader.GetSize()[3])]
    return [Source(path)]


def cycle_times(sources: Sequence[Source], given: Sequence[float] | None) -> tuple[FloatArray, str]:
    """Times (f,) as fractions of the RR interval from the first frame, and where they are from.

    given: fractions of the RR interval (0.35) or percentages (35), the first end-diastole's. Else the headers', else evenly
    spaced. Raises UsageError or InputError where they do not rise from end-diastole within one cycle; 1 is ED again.
    """
    if given is not None:
        times, origin = np.asarray(given, dtype=float), "--times"
        if len(times) != len(sources):
            raise UsageError(f"--times has {len(times)} values for {len(sources)} frames; give one for each.")
        if np.isfinite(times).all() and times.max() > 1.0:
            if times.max() <= _FEWEST_PERCENT:
                raise UsageError(
                    f"--times end at {times.max():g}: neither fractions of the RR interval (0.35) nor percentages of it (35)."
                )
            times = times / 100.0
    elif all(source.time is not None for source in sources):
        times, origin = np.array([source.time for source in sources], dtype=float), "the DICOM headers"
    else:
        return np.arange(len(sources)) / len(sources), "evenly spaced over the cycle (no --times, none in headers)"
    if not np.isfinite(times).all() or np.any(np.diff(times) <= 0):
        bad = int(np.argmax(~(np.diff(times) > 0))) + 1
        raise UsageError(
            f"the times ({origin}) do not increase: frame {bad} ({sources[bad]}) is at {times[bad]:g} after {times[bad - 1]:g}."
        )
    times = times - times[0]
    if times[-1] > 1.0 + 1e-9:
        raise UsageError(
            f"the times ({origin}) span {times[-1]:g} cycles; frames of one cycle, as fractions or percentages of RR."
        )
    return np.minimum(times, 1.0), origin


def read(source: Source) -> Image:
    """One frame's volume. Raises InputError where it is missing, damaged or no volume."""
    if source.index is not None or source.path.is_file():
        try:
            return images.read(source.path, source.index)
        except InputError as error:  # of which frame, where a file holds several
            raise InputError(str(error).replace(str(source.path), str(source), 1)) from None
    return _read_series(source)


def _read_series(source: Source) -> Image:
    import SimpleITK as sitk

    name = source.path.name.removeprefix("series ")
    folder, series = (source.path.parent, name) if name != source.path.name else (source.path, "")
    files = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series)
    reader, one = sitk.ImageSeriesReader(), sitk.ImageFileReader()
    reader.SetFileNames(files)
    reader.MetaDataDictionaryArrayUpdateOn()
    try:
        if files:
            one.SetFileName(files[0])
            one.ReadImageInformation()
            size = (*one.GetSize(), 1)[:3]  # a file is a slice, or holds all of them
            images.check_size(source, (*size[:2], max(len(files), size[2])), images.voxel_bytes(one.GetPixelID()))
        image = images.checked(source, reader.Execute())
    except RuntimeError as error:
        raise InputError(f"{source}: the DICOM series cannot be read ({str(error).strip().splitlines()[-1][:200]}).") from None
    _check_slices(reader, image, source)
    return image


def _check_slices(reader: Any, image: Image, source: Source) -> None:
    """InputError where a DICOM series' slices are not evenly apart: the reader would take them as if they were."""
    tag = "0020|0032"
    count = image.array.shape[0]
    if count < 3 or not all(reader.HasMetaDataKey(k, tag) for k in range(count)):
        return
    try:
        place = np.array([[float(word) for word in reader.GetMetaData(k, tag).split("\\")] for k in range(count)])
    except ValueError:
        return
    gap = np.diff(place @ image.direction[:, 2])
    usual = float(np.median(gap))
    off = np.flatnonzero(np.abs(gap - usual) > 0.05 * abs(usual))
    if len(off):
        k = int(off[0])
        raise InputError(
            f"{source}: slices {k + 1} and {k + 2} of {count} are {abs(gap[k]):.3g} mm apart, the others {abs(usual):.3g} mm; "
            "is a slice missing?"
        )


def check_same_grid(first: Image, image: Image, where: Source, ed: Source) -> None:
    """InputError where a frame's grid is not the first's."""
    if image.array.shape != first.array.shape:
        raise InputError(
            f"{where}: {image.array.shape[::-1]} voxels, but {ed} has {first.array.shape[::-1]}; frames share one grid."
        )
    if not np.allclose(image.spacing, first.spacing, rtol=1e-3):
        raise InputError(
            f"{where}: voxels of {_mm(image.spacing)}, but {ed} has {_mm(first.spacing)}; frames share one grid, resample them."
        )
    corner = np.array(first.array.shape[::-1]) - 1
    ends = np.array([[0, 0, 0], corner])
    gap = float(np.abs(image.to_world(ends) - first.to_world(ends)).max())
    if gap > max(_SAME_MM, 0.01 * float(first.spacing.min())):
        raise InputError(f"{where}: lies {gap:.2g} mm from {ed} (origin or axes differ); frames share one grid.")


def _mm(spacing: FloatArray) -> str:
    return " x ".join(f"{s:g}" for s in spacing) + " mm"


def check_hounsfield(image: Image, where: Source) -> None:
    """InputError where the values are labels or nothing at all, not HU."""
    sample = image.array[::3, ::3, ::3].ravel()
    values = np.unique(sample)
    if len(values) == 1:
        raise InputError(f"{where}: every voxel is {values[0]:g}; the frame is empty.")
    if len(values) <= _LABELS_AT_MOST and np.array_equal(values, np.round(values)):
        raise InputError(
            f"{where}: has only {len(values)} different values; is it a label map? Tracking needs HU (labels: --motion labels)."
        )


def check_is_bundles_image(ed: Image, surface: Endocardium, where: Source) -> float:
    """Share of the endocardium with blood inside and darker tissue outside in the ED frame.

    Raises InputError where the atrium is not inside the image, or the share is no better than that of another place.
    """
    points, normal = endocardial_normals(surface)
    index = ed.to_index(points)
    inside = ((index >= 0) & (index <= np.array(ed.array.shape[::-1]) - 1)).all(axis=1)
    if inside.mean() < 0.98:
        raise InputError(
            f"{where}: the bundle's atrium lies outside ({100 * inside.mean():.0f} % of it inside). Is this the image the bundle "
            "was made from (LPS mm)?"
        )
    within, beyond = (sample(ed, points + shift * normal) for shift in (-_INSIDE_MM, _OUTSIDE_MM))
    share = float((within > beyond + 30.0).mean())
    if share < 0.6:
        raise InputError(
            f"{where}: only {100 * share:.0f} % of the bundle's endocardium has blood inside and darker tissue outside; this is "
            "not the image the bundle was made from, or not its end-diastole. Give that frame first."
        )
    return share


def endocardial_normals(surface: Endocardium) -> tuple[FloatArray, FloatArray]:
    """Middles (t, 3) of the endocardial faces and their outward normals (t, 3)."""
    from lacli.geometry.quadrature import at_quadrature

    # the first quadrature point is the middle
    return at_quadrature(surface.faces, surface.ed)[:, 0], surface.normal[:, 0]


def sample(image: Image, points: FloatArray) -> FloatArray:
    """Values (n,) at points (n, 3) mm, linear between voxels."""
    from scipy.ndimage import map_coordinates

    index = image.to_index(points)[:, ::-1].T
    return map_coordinates(image.array, index, output=np.float64, order=1, mode="nearest")


def around(image: Image, points: FloatArray, work_mm: float = WORK_MM) -> Image:
    """The volume cropped to the points (n, 3) and 12 mm around, in voxels of ``work_mm``, float32.

    Finer voxels are averaged (less noise, and the engine's time is that of its voxels), coarser ones kept; a grid that is
    already of about that size is only cropped.
    """
    import SimpleITK as sitk

    index = image.to_index(points)
    size = np.array(image.array.shape[::-1])
    low = np.clip(np.floor(index.min(axis=0) - MARGIN_MM / image.spacing).astype(int), 0, size - 1)
    high = np.clip(np.ceil(index.max(axis=0) + MARGIN_MM / image.spacing).astype(int) + 1, 1, size)
    piece = image.crop(low, high)
    piece = piece.with_array(piece.array.astype(np.float32))
    work_mm = max(work_mm, float(piece.spacing.min()))
    if np.all(np.abs(piece.spacing / work_mm - 1.0) < 0.15):
        return piece
    source = to_sitk(piece)
    sigma = np.sqrt(np.maximum((0.5 * work_mm) ** 2 - (0.5 * piece.spacing) ** 2, 1e-4))
    source = sitk.SmoothingRecursiveGaussian(source, np.maximum(sigma, 0.05).tolist())
    count = np.maximum(np.floor((np.array(piece.array.shape[::-1]) - 1) * piece.spacing / work_mm).astype(int) + 1, 8)
    out = sitk.Resample(
        source, count.tolist(), sitk.Transform(), sitk.sitkLinear, piece.origin.tolist(), [work_mm] * 3,
        piece.direction.ravel().tolist(), float(piece.array.flat[0]),
    )  # fmt: skip
    return Image(sitk.GetArrayFromImage(out), np.full(3, work_mm), piece.origin, piece.direction)
