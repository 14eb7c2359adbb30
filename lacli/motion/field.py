"""Displacement fields on a grid of voxels, in LPS millimetres (ITK's convention) whatever the grid's axes."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lacli.anatomy.inputs.image import Image, opened
from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError

Frame = Literal["lps", "ras"]
_RAS = np.array([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Field:
    """u (nk, nj, ni, 3) of float32, mm, LPS: the point x of the fixed image (end-diastole) is at x + u(x) in the moving one."""

    u: NDArray[np.float32]
    spacing: FloatArray
    origin: FloatArray
    direction: FloatArray

    @property
    def grid(self) -> Image:
        """The grid without values; its transforms between index and millimetres."""
        return Image(self.u[..., 0], self.spacing, self.origin, self.direction)

    def at(self, points: FloatArray) -> FloatArray:
        """u (n, 3) mm at points (n, 3) mm, linear between voxels; beyond the grid the nearest voxel's."""
        index = self.grid.to_index(points)[:, ::-1].T
        return np.stack(
            [ndimage.map_coordinates(self.u[..., i], index, output=np.float64, order=1, mode="nearest") for i in range(3)], axis=1
        )

    def covers(self, points: FloatArray) -> float:
        """Share of points (n, 3) mm inside the grid."""
        index = self.grid.to_index(points)
        size = np.array(self.u.shape[2::-1])
        return float(((index >= -0.5) & (index <= size - 0.5)).all(axis=1).mean())

    def inverse(self, every: int = 2, sweeps: int = 20) -> Field:
        """v with v(x) about -u(x + v(x)), by fixed point on every ``every``-th voxel; smooth fields only."""
        u = self.u[::every, ::every, ::every].astype(np.float32)
        base = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in u.shape[:3]), indexing="ij"))
        to_index = np.linalg.inv(self.direction).T / (self.spacing * every)
        v = -u
        for _ in range(sweeps):
            index = base + np.moveaxis(v @ to_index.astype(np.float32), -1, 0)[::-1]
            new = -np.stack([ndimage.map_coordinates(u[..., i], index, order=1, mode="nearest") for i in range(3)], axis=-1)
            change = float(np.abs(new - v).max())
            v = new
            if change < 1e-2:
                break
        return Field(v, self.spacing * every, self.origin, self.direction)

    def solve_inverse_at(self, points: FloatArray, start: FloatArray, sweeps: int = 60) -> FloatArray:
        """w (n, 3) mm with w + u(x + w) = 0 at points x (n, 3): the exact inverse of this field at them, from ``start``."""
        w = start.copy()
        for _ in range(sweeps):
            residual = w + self.at(points + w)
            if float(np.abs(residual).max(initial=0.0)) < 1e-5:
                break
            w = w - residual
        return w


def to_sitk(image: Image) -> Any:
    """As SimpleITK's float image."""
    import SimpleITK as sitk

    out = sitk.GetImageFromArray(np.ascontiguousarray(image.array.astype(np.float32)))
    out.SetSpacing(image.spacing.tolist())
    out.SetOrigin(image.origin.tolist())
    out.SetDirection(image.direction.ravel().tolist())
    return out


def field_to_sitk(field: Field) -> Any:
    """As SimpleITK's image of 3 vectors."""
    import SimpleITK as sitk

    out = sitk.GetImageFromArray(np.ascontiguousarray(field.u), isVector=True)
    out.SetSpacing(field.spacing.tolist())
    out.SetOrigin(field.origin.tolist())
    out.SetDirection(field.direction.ravel().tolist())
    return out


def from_sitk(image: Any) -> Field:
    """From SimpleITK's image of 3 vectors."""
    import SimpleITK as sitk

    return Field(
        sitk.GetArrayFromImage(image).astype(np.float32),
        np.array(image.GetSpacing()),
        np.array(image.GetOrigin()),
        np.array(image.GetDirection()).reshape(3, 3),
    )


def pull(image: Image, field: Field) -> Image:
    """The image at x + u(x) on its own grid, cubic spline; beyond its edge the nearest voxel's value."""
    import SimpleITK as sitk

    source = to_sitk(image)
    vectors = sitk.Cast(field_to_sitk(field), sitk.sitkVectorFloat64)
    transform = sitk.DisplacementFieldTransform(vectors)
    warp = sitk.ResampleImageFilter()
    warp.SetReferenceImage(source)
    warp.SetTransform(transform)
    warp.SetInterpolator(sitk.sitkBSpline)
    warp.SetUseNearestNeighborExtrapolator(True)
    warp.SetNumberOfThreads(1)
    return image.with_array(sitk.GetArrayFromImage(warp.Execute(source)))


def read_field(path: Path, frame: Frame = "lps") -> Field:
    """A displacement field file (.nrrd .nii .nii.gz .mha): three values a voxel in mm; ``frame``: the axes the values are in.

    Raises InputError where it is missing, damaged, no vector image, or not finite.
    """
    import SimpleITK as sitk

    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    sitk.ProcessObject_SetGlobalWarningDisplay(False)
    try:
        image = opened(path).Execute()
    except RuntimeError as error:
        reason = [line.strip() for line in str(error).splitlines() if line.strip()][-1]
        raise InputError(f"{path}: the displacement field cannot be read ({reason[:200]}).") from None
    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 3:
        raise InputError(
            f"{path}: not a displacement field: {image.GetDimension()} dimensions, {image.GetNumberOfComponentsPerPixel()} "
            "values a voxel, expected 3 and 3 (mm)."
        )
    field = from_sitk(image)
    if not np.isfinite(field.u).all():
        raise InputError(f"{path}: the displacement field has values that are not finite (NaN or infinite).")
    return field if frame == "lps" else Field((field.u * _RAS).astype(np.float32), field.spacing, field.origin, field.direction)


def write_field(field: Field, path: Path) -> None:
    """Write a field as read_field reads it; compressed, under a temporary name first."""
    import SimpleITK as sitk

    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".part-{os.getpid()}-{path.name}")
    try:
        sitk.WriteImage(field_to_sitk(field), str(temporary), True)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
