"""Label maps and CT volumes from NRRD, NIfTI, MetaImage and whatever else SimpleITK reads.

Physical coordinates are millimetres in ITK's convention, LPS: x to the patient's left, y to the back, z to the head. NIfTI's
RAS affine is turned by the reader. Arrays are indexed [k, j, i] (ITK's index reversed); ``to_world`` takes (i, j, k).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError, InputError

SUFFIXES = (".nrrd", ".nhdr", ".nii", ".nii.gz", ".mha", ".mhd", ".hdr", ".img")


@dataclass(frozen=True)
class Image:
    """A 3-D image: array (nk, nj, ni); spacing (3,) mm along i, j, k; origin (3,) mm; direction (3, 3), its columns i, j, k."""

    array: NDArray[Any]
    spacing: FloatArray
    origin: FloatArray
    direction: FloatArray

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
        return Image(array, self.spacing, self.origin, self.direction)

    def crop(self, low: IntArray, high: IntArray) -> Image:
        """Indices (i, j, k) from ``low`` to below ``high``; beyond the image it is filled with zeros."""
        size = np.array(self.array.shape[::-1])
        inner_low, inner_high = np.clip(low, 0, size), np.clip(high, 0, size)
        piece = self.array[tuple(slice(a, b) for a, b in zip(inner_low[::-1], inner_high[::-1], strict=True))]
        pad = [(int(a), int(b)) for a, b in zip((inner_low - low)[::-1], (high - inner_high)[::-1], strict=True)]
        return Image(np.pad(piece, pad), self.spacing, self.to_world(np.asarray(low)[None])[0], self.direction)


def is_image(path: Path) -> bool:
    """Whether the name ends as an image file's does."""
    return path.name.lower().endswith(SUFFIXES)


def read(path: Path) -> Image:
    """Read a 3-D scalar image.

    Raises InputError where the file is missing, damaged, not 3-D, or has coordinates that are not finite.
    """
    import SimpleITK as sitk

    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty; export it again.")
    _check_nifti(path)
    _check_nrrd(path)
    sitk.ProcessObject_SetGlobalWarningDisplay(False)
    try:
        image = sitk.ReadImage(str(path))
    except RuntimeError as error:
        reason = [line.strip() for line in str(error).splitlines() if line.strip()][-1]
        raise InputError(
            f"{path}: the image cannot be read, the file may be truncated or of another format ({reason[:200]})."
        ) from None
    if image.GetNumberOfComponentsPerPixel() != 1:
        raise InputError(
            f"{path}: every voxel has {image.GetNumberOfComponentsPerPixel()} values; export one scalar label (or HU) per voxel."
        )
    if image.GetDimension() == 4 and image.GetSize()[3] == 1:
        image = image[:, :, :, 0]
    if image.GetDimension() != 3:
        raise InputError(f"{path}: the image has {image.GetDimension()} dimensions; export one 3-D frame.")
    spacing, origin = np.array(image.GetSpacing()), np.array(image.GetOrigin())
    direction = np.array(image.GetDirection()).reshape(3, 3)
    if not (np.isfinite(spacing).all() and np.isfinite(origin).all() and np.isfinite(direction).all()):
        raise InputError(f"{path}: the affine (spacing, origin or direction) has a value that is not finite; correct the header.")
    if np.any(spacing <= 0) or abs(abs(np.linalg.det(direction)) - 1.0) > 0.05:
        raise InputError(f"{path}: the affine is singular or has no voxel size (spacing {spacing.tolist()}); correct the header.")
    array = sitk.GetArrayFromImage(image)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(f"{path}: {int((~np.isfinite(array)).sum())} voxels are not finite (NaN or infinite); replace them.")
    return Image(array, spacing, origin, direction)


def _check_nrrd(path: Path) -> None:
    """The reader speaks of inconsistent coefficients where a NRRD's axes are not finite: said plainly first."""
    if not path.name.lower().endswith((".nrrd", ".nhdr")):
        return
    with path.open("rb") as stream:
        head = stream.read(65536).replace(b"\r\n", b"\n").split(b"\n\n", 1)[0].decode("latin-1").lower()
    for line in head.splitlines():
        key, _, value = line.partition(":")
        if key in ("space directions", "space origin", "spacings") and any(word in value for word in ("nan", "inf")):
            raise InputError(f"{path}: '{key}' in the NRRD header has a value that is not finite (NaN); correct the header.")


def _check_nifti(path: Path) -> None:
    """ITK replaces a broken NIfTI affine by a guess, and missing voxels by zeros, without a word: the file is looked at first."""
    import gzip
    import struct
    import zlib

    if not path.name.lower().endswith((".nii", ".nii.gz")):
        return
    try:
        content = path.read_bytes()
        if path.name.lower().endswith(".gz"):
            content = gzip.decompress(content)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: the file is truncated, or not compressed as its name says ({error}).") from None
    if len(content) < 348:
        raise InputError(f"{path}: the file is truncated, its header has {len(content)} bytes of 348.")
    order = "<" if struct.unpack("<i", content[:4])[0] == 348 else ">"
    if struct.unpack(order + "i", content[:4])[0] != 348:
        return  # NIfTI-2 or not NIfTI: the reader tells
    dimensions = struct.unpack(order + "8h", content[40:56])
    bits = struct.unpack(order + "h", content[72:74])[0]
    offset = struct.unpack(order + "f", content[108:112])[0]
    if 1 <= dimensions[0] <= 7 and np.isfinite(offset):
        needed = int(offset) + int(np.prod(np.maximum(dimensions[1 : 1 + dimensions[0]], 1), dtype=np.int64)) * bits // 8
        if content[344:347] == b"n+1" and len(content) < needed:
            raise InputError(f"{path}: the file is truncated, it has {len(content)} bytes of {needed}.")
    pixdim = np.array(struct.unpack(order + "4f", content[76:92]))[1:]
    qform, sform = struct.unpack(order + "2h", content[252:256])
    used = [pixdim]
    if qform > 0:
        used.append(np.array(struct.unpack(order + "6f", content[256:280])))
    if sform > 0:
        used.append(np.array(struct.unpack(order + "12f", content[280:328])))
    if not all(np.isfinite(values).all() for values in used):
        raise InputError(f"{path}: the affine of the NIfTI header has a value that is not finite (NaN); correct the header.")


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
    array = image.array
    if array.dtype.kind == "f":
        if not np.array_equal(array, np.round(array)):
            raise AnatomyError(
                "the image has fractional values; a label map has whole numbers (is it a CT volume, or a probability map?)."
            )
        array = array.astype(np.int64)
    values, counts = np.unique(array, return_counts=True)
    if len(values) > 256:
        raise AnatomyError(f"the image has {len(values)} different values; a label map has a few (is it a CT volume?).")
    return {int(v): float(c) * image.voxel_ml for v, c in zip(values, counts, strict=True) if v != 0}
