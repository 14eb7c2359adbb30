"""Label maps and CT volumes from NRRD, NIfTI, MetaImage and whatever else SimpleITK reads.

Physical coordinates are millimetres in ITK's convention, LPS: x to the patient's left, y to the back, z to the head. NIfTI's
RAS affine is turned by the reader. Arrays are indexed [k, j, i] (ITK's index reversed); ``to_world`` takes (i, j, k).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lacli.anatomy.inputs import nifti
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError, InputError

SUFFIXES = (".nrrd", ".nhdr", ".nii", ".nii.gz", ".mha", ".mhd", ".hdr", ".img")
_FORMATS = {
    (".nrrd", ".nhdr"): "NrrdImageIO", (".mha", ".mhd"): "MetaImageIO", (".nii", ".nii.gz", ".hdr", ".img"): "NiftiImageIO",
}  # fmt: skip
MOST_BYTES = 1 << 30  # of voxels: 512 x 512 x 2048 of 16 bits
LEAST_SPACING_MM, MOST_SPACING_MM = 0.02, 20.0
MOST_TILT_DEG = 0.1  # off a right angle: what rounding in a header may do
WHOLE = 1e-3  # a label may be off a whole number by so much: scaling in a header, and single precision
_LENGTHS = (("metres", 1e3), ("centimetres", 10.0), ("micrometres", 1e-3))


@dataclass(frozen=True)
class Image:
    """A 3-D image: array (nk, nj, ni); spacing (3,) mm along i, j, k; origin (3,) mm; direction (3, 3), its columns i, j, k.

    rival (3, 4): another index -> mm that the header holds beside the one that is used, where the two differ; else None.
    notes: what else is doubtful in the header, in words.
    """

    array: NDArray[Any]
    spacing: FloatArray
    origin: FloatArray
    direction: FloatArray
    rival: FloatArray | None = None
    notes: tuple[str, ...] = ()

    def to_world(self, index: NDArray[Any]) -> FloatArray:
        """(n, 3) continuous indices (i, j, k) -> (n, 3) mm, LPS."""
        return self.origin + (np.asarray(index, dtype=float) * self.spacing) @ self.direction.T

    def to_index(self, world: NDArray[Any]) -> FloatArray:
        """(n, 3) mm, LPS -> continuous indices (i, j, k)."""
        return ((np.asarray(world, dtype=float) - self.origin) @ np.linalg.inv(self.direction).T) / self.spacing

    @property
    def voxel_ml(self) -> float:
        """Volume of a voxel, mL."""
        return float(np.prod(self.spacing) * abs(np.linalg.det(self.direction)) / 1000.0)

    def with_array(self, array: NDArray[Any]) -> Image:
        """The same grid with other values."""
        return replace(self, array=array)

    def doubts(self, world: FloatArray) -> list[str]:
        """What is doubtful in the header, in words; where two transforms contradict each other, how far at ``world`` (3,) mm."""
        if self.rival is None:
            return list(self.notes)
        index = self.to_index(world[None])[0]
        away = float(np.linalg.norm(self.rival[:, :3] @ index + self.rival[:, 3] - world))
        turn = self.direction.T @ (self.rival[:, :3] / np.linalg.norm(self.rival[:, :3], axis=0))
        degrees = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))))
        mirrored = ", and one is the mirror image of the other" if np.linalg.det(turn) < 0 else ""
        return [
            f"the NIfTI header holds two transforms that differ by {away:.3g} mm and {degrees:.3g} degrees at the atrium"
            f"{mirrored}: the sform is used, as the standard has it, not the qform; correct the header if the image lies "
            "in the wrong place",
            *self.notes,
        ]

    def crop(self, low: IntArray, high: IntArray) -> Image:
        """Indices (i, j, k) from ``low`` to below ``high``; beyond the image it is filled with zeros."""
        size = np.array(self.array.shape[::-1])
        inner_low, inner_high = np.clip(low, 0, size), np.clip(high, 0, size)
        piece = self.array[tuple(slice(a, b) for a, b in zip(inner_low[::-1], inner_high[::-1], strict=True))]
        pad = [(int(a), int(b)) for a, b in zip((inner_low - low)[::-1], (high - inner_high)[::-1], strict=True)]
        rival = self.rival
        if rival is not None:
            rival = np.column_stack([rival[:, :3], rival[:, :3] @ np.asarray(low, dtype=float) + rival[:, 3]])
        return replace(self, array=np.pad(piece, pad), origin=self.to_world(np.asarray(low)[None])[0], rival=rival)


def is_image(path: Path) -> bool:
    """Whether the name ends as an image file's does."""
    return path.name.lower().endswith(SUFFIXES)


def opened(path: Path) -> Any:
    """ITK's reader of the file, by the format of its ending: what the content looks like is not tried, for the readers of other
    formats (libpng, HDF5) have words of their own for what they find."""
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    name = next((format_ for endings, format_ in _FORMATS.items() if path.name.lower().endswith(endings)), None)
    if name is not None:
        reader.SetImageIO(name)
    return reader


def read(path: Path, frame: int | None = None) -> Image:
    """Read a 3-D scalar image, or one ``frame`` of a file that holds several.

    Raises InputError where the file is missing, damaged, not 3-D, too large, has coordinates that are not finite, axes that are
    not perpendicular, or voxels of no plausible size. The header is judged before memory is taken for the voxels.
    """
    import SimpleITK as sitk

    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty; export it again.")
    # of several frames the first is read first, and tells whether all are there
    header = nifti.read_header(path, not frame) if path.name.lower().endswith(nifti.SUFFIXES) else None
    if header is not None:
        check_size(path, _of_frame(header.shape, frame), header.voxel_bytes)
    grid = None if header is None else _nifti_grid(path, header)  # before the library, which has words of its own for it
    guesses = (*_of_nrrd(path), *_of_meta(path))
    sitk.ProcessObject_SetGlobalWarningDisplay(False)
    reader = opened(path)
    try:
        reader.ReadImageInformation()
        _check_components(path, reader.GetNumberOfComponents())
        check_size(path, _of_frame(reader.GetSize(), frame), voxel_bytes(reader.GetPixelID()))
        grid = grid or _grid(path, header, reader)
        if frame is not None:
            reader.SetExtractSize([*reader.GetSize()[:3], 0])
            reader.SetExtractIndex([0, 0, 0, frame])
        image = reader.Execute()
    except (RuntimeError, MemoryError) as error:
        reason = [line.strip() for line in str(error).splitlines() if line.strip()][-1:] or ["out of memory"]
        raise InputError(
            f"{path}: the image cannot be read, the file may be truncated or of another format ({reason[0][:200]})."
        ) from None
    if image.GetDimension() == 4:
        image = image[:, :, :, 0]
    return replace(grid, array=_values(path, image), notes=(*grid.notes, *guesses))


def checked(where: object, image: Any) -> Image:
    """ITK's image of 3 dimensions, held to what is asked of a file; ``where`` it is from, for messages. Raises InputError."""
    _check_components(where, image.GetNumberOfComponentsPerPixel())
    return replace(_grid(where, None, image), array=_values(where, image))


def _of_frame(shape: Sequence[int], frame: int | None) -> tuple[int, ...]:
    return tuple(shape if frame is None else shape[:3])


def _values(where: object, image: Any) -> NDArray[Any]:
    import SimpleITK as sitk

    array = sitk.GetArrayFromImage(image)
    if array.dtype.kind == "f" and (bad := sum(int((~np.isfinite(slab)).sum()) for slab in array)):
        raise InputError(f"{where}: {bad} voxels are not finite (NaN or infinite); replace them.")
    if array.dtype.kind == "c":
        raise InputError(f"{where}: the voxels are complex numbers; export one scalar label (or HU) per voxel.")
    return np.asarray(array)


def read_labels(path: Path) -> Image:
    """Read a label map: whole numbers, whatever type and scaling they are stored in.

    Raises InputError as ``read`` does, and AnatomyError where the values are no labels.
    """
    image = read(path)
    try:
        return image.with_array(_whole(image.array))
    except AnatomyError as error:
        raise AnatomyError(f"{path}: {error}") from None


def length_unit(factors: float, low: float, high: float, power: int = 1) -> str:
    """The unit in which a size would be within ``low`` to ``high``, as a question; empty where there is none."""
    fitting = (unit for unit, factor in _LENGTHS if low <= factors * factor**power <= high)
    return next((f"; are the lengths {unit}? They must be mm" for unit in fitting), "")


def _check_components(path: object, count: int) -> None:
    if count != 1:
        raise InputError(f"{path}: every voxel has {count} values; export one scalar label (or HU) per voxel.")


def voxel_bytes(pixel: int) -> int:
    """Bytes of a voxel, by ITK's number of its type."""
    import SimpleITK as sitk

    name = sitk.GetPixelIDValueAsString(pixel)
    return next((int(bits) // 8 for bits in ("64", "32", "16", "8") if bits in name.split("-")[0]), 8)


def check_size(where: object, shape: Sequence[int], voxel_bytes: int) -> None:
    """InputError where an image is no volume, or more than MOST_BYTES."""
    if not (len(shape) == 3 or (len(shape) > 3 and all(n == 1 for n in shape[3:]))):
        raise InputError(f"{where}: the image has {len(shape)} dimensions ({_times(shape)}); export one 3-D frame.")
    size = voxel_bytes
    for n in shape:
        size *= int(n)
    if size > MOST_BYTES:
        raise InputError(
            f"{where}: {_times(shape)} voxels of {voxel_bytes} bytes are {size / 1e9:.3g} GB, more than the "
            f"{MOST_BYTES / 1e9:.2g} GB that are taken; crop the image to the heart, or resample it."
        )
    if min(shape[:3]) < 2:
        raise InputError(f"{where}: the image has {_times(shape)} voxels, which is a slice; export the volume.")


def _times(values: Any) -> str:
    return " x ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in values)


def _nifti_grid(path: Path, header: nifti.Header) -> Image | None:
    """An image without voxels at the place our own reading of the header gives, checked; None where it says nothing of it."""
    affine = header.affine
    if affine is None:
        return None
    spacing = np.linalg.norm(affine[:, :3], axis=0)
    rival = None
    if header.sform is not None and header.qform is not None:
        corners = np.array(np.meshgrid(*[(0.0, s - 1.0) for s in header.shape[:3]])).reshape(3, -1)
        apart = (header.sform - header.qform) @ np.vstack([corners, np.ones(8)])
        rival = header.qform if np.linalg.norm(apart, axis=0).max() > 0.1 else None
    return _checked(path, spacing, affine[:, 3], affine[:, :3] / np.maximum(spacing, 1e-300), header.unit, rival)


def _grid(where: object, header: nifti.Header | None, reader: Any) -> Image:
    """An image without voxels at the place the library gives, checked."""
    n = len(reader.GetSize())
    spacing, origin = np.array(reader.GetSpacing())[:3], np.array(reader.GetOrigin())[:3]
    direction = np.array(reader.GetDirection()).reshape(n, n)[:3, :3]
    notes = ["the NIfTI header has neither qform nor sform: where left and right, front and back are is a guess"]
    return _checked(where, spacing, origin, direction, "" if header is None else header.unit, None, notes if header else ())


def _checked(
    where: object,
    spacing: FloatArray,
    origin: FloatArray,
    direction: FloatArray,
    unit: str,
    rival: FloatArray | None,
    notes: Any = (),
) -> Image:
    if not (np.isfinite(spacing).all() and np.isfinite(origin).all() and np.isfinite(direction).all()):
        raise InputError(f"{where}: the affine (spacing, origin, direction) has a value that is not finite; correct the header.")
    if np.any(spacing <= 0) or np.any(np.abs(np.linalg.norm(direction, axis=0) - 1.0) > 1e-3):
        raise InputError(f"{where}: the affine is singular or has no voxel size (spacing {_times(spacing)}); correct the header.")
    _check_perpendicular(where, direction)
    _check_spacing(where, spacing, unit)
    return Image(np.zeros((0, 0, 0)), spacing, origin, direction, rival, tuple(notes))


def _check_perpendicular(where: object, direction: FloatArray) -> None:
    pairs = ((0, 1), (0, 2), (1, 2))
    off = [math.degrees(math.asin(min(1.0, abs(float(direction[:, a] @ direction[:, b]))))) for a, b in pairs]
    worst = int(np.argmax(off))
    if off[worst] > 89.0:
        raise InputError(f"{where}: the affine is singular, two of the image's axes are the same; correct the header.")
    if off[worst] > MOST_TILT_DEG:
        first, second = ("ijk"[axis] for axis in pairs[worst])
        raise InputError(
            f"{where}: the image's axes are not perpendicular, {first} and {second} are {off[worst]:.1f} degrees off a right "
            "angle (a tilted gantry, or a sheared affine); resample the image to a straight grid."
        )


def _check_spacing(where: object, spacing: FloatArray, unit: str) -> None:
    if np.all((spacing >= LEAST_SPACING_MM) & (spacing <= MOST_SPACING_MM)):
        return
    words = f"{where}: the voxels are {_times(spacing.tolist())} mm, which no heart's image has"
    if unit and unit != "millimetres":
        raise InputError(f"{words}; the header says the lengths are {unit}: correct xyzt_units.")
    meant = length_unit(float(np.median(spacing)), 0.1, 5.0)
    raise InputError(f"{words}{meant.replace('lengths', 'spacings')}.")


def _guesses(kind: str, sized: bool, turned: bool) -> tuple[str, ...]:
    """What the library takes where a header says nothing, in words; sized, turned: whether it says voxel size and axes."""
    size = () if sized else (f"the {kind} header has no voxel size: voxels of 1 mm are a guess",)
    return size if turned else (*size, f"the {kind} header does not say which way its axes run: LPS is a guess")


def _of_meta(path: Path) -> tuple[str, ...]:
    """What a MetaImage's header leaves to guess. It is lines ``key = value``, the number of dimensions among the first; what is
    none, its reader reports in words of its own."""
    if not path.name.lower().endswith((".mha", ".mhd")):
        return ()
    with path.open("rb") as stream:
        head = stream.read(65536).split(b"ElementDataFile", 1)[0]
    if not re.search(rb"^\s*NDims\s*=\s*\d", head, re.MULTILINE):
        raise InputError(f"{path}: the image cannot be read, its header names no number of dimensions (NDims): not a MetaImage.")
    sized, turned = (
        re.search(rb"^\s*(?:%s)\s*=" % keys, head, re.MULTILINE) is not None
        for keys in (b"ElementSpacing|ElementSize", b"TransformMatrix|Orientation|Rotation")
    )
    return _guesses("MetaImage", sized, turned)


def _of_nrrd(path: Path) -> tuple[str, ...]:
    """What a NRRD's header leaves to guess.

    The reader speaks of inconsistent coefficients where axes are not finite, and knows no unit but mm: said first.
    """
    if not path.name.lower().endswith((".nrrd", ".nhdr")):
        return ()
    said = set()
    with path.open("rb") as stream:
        head = stream.read(65536).replace(b"\r\n", b"\n").split(b"\n\n", 1)[0].decode("latin-1").lower()
    for line in head.splitlines():
        key, _, value = line.partition(":")
        said.add(key)
        if key in ("space directions", "space origin", "spacings") and any(word in value for word in ("nan", "inf")):
            raise InputError(f"{path}: '{key}' in the NRRD header has a value that is not finite (NaN); correct the header.")
        units = {word.strip() for word in value.split('"')[1::2]} - {"", "mm", "millimeter", "millimeters", "millimetre"}
        if key in ("space units", "units") and units:
            raise InputError(f"{path}: the NRRD header says its lengths are in {', '.join(sorted(units))}; write it in mm.")
    return _guesses("NRRD", bool(said & {"space directions", "spacings"}), {"space", "space directions"} <= said)


def write(image: Image, path: Path, dtype: Any = None) -> None:
    """Write an image; the format follows the name (.nrrd, .nii.gz, .mha). Compressed, under a temporary name first."""
    import os

    import SimpleITK as sitk

    array = image.array if dtype is None else image.array.astype(dtype)
    if array.dtype == bool:
        array = array.astype(np.uint8)
    out = sitk.GetImageFromArray(np.ascontiguousarray(array))
    out.SetSpacing(image.spacing.tolist())
    out.SetOrigin(image.origin.tolist())
    out.SetDirection(image.direction.ravel().tolist())
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".part-{os.getpid()}-{path.name}")
    sitk.WriteImage(out, str(temporary), True)
    temporary.replace(path)


def label_volumes(image: Image) -> dict[int, float]:
    """{label: mL} of every label but 0.

    Raises AnatomyError where the values are no labels (fractions, or hundreds of them: a CT volume).
    """
    total: dict[int, int] = {}
    for slab in _whole(image.array):
        for value, count in zip(*np.unique(slab, return_counts=True), strict=True):
            total[int(value)] = total.get(int(value), 0) + int(count)
        if len(total) > 256:
            raise AnatomyError(
                f"the image has {len(total)} different values and more; a label map has a few (is it a CT volume?)."
            )
    return {label: count * image.voxel_ml for label, count in sorted(total.items()) if label != 0}


def _whole(array: NDArray[Any]) -> NDArray[Any]:
    """Labels as whole numbers; AnatomyError where they are none within WHOLE."""
    if array.dtype.kind != "f":
        return array
    for slab in array:
        if np.any(np.abs(slab) > 1e6) or np.any(np.abs(slab - np.round(slab)) > WHOLE):
            raise AnatomyError(
                "the image has fractional values; a label map has whole numbers (is it a CT volume, or a probability map?)."
            )
    return np.round(array).astype(np.int32)
