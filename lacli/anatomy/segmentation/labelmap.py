"""From surface and thickness to voxels: a label map on a finer grid that is smooth where the rough one has steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from lacli.anatomy.inputs.image import MOST_BYTES, Image
from lacli.anatomy.segmentation.pool import largest
from lacli.anatomy.segmentation.wall import OPEN, Wall
from lacli.anatomy.wall.fat import LEAST_ISLAND_ML, WINDOWS
from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import AnatomyError

FAT_WITHIN_MM = 5.0  # of the blood
MARGIN_MM = 12.0
_BAND_MM = 2.5


@dataclass(frozen=True)
class Numbers:
    """Labels in the map that is written: the atrium's blood, its wall, fat; the ventricle's blood, None where not given."""

    la: int
    wall: int
    fat: int
    lv: int | None = None


def paint(ct: Image, smooth: FloatArray, pool: BoolArray, lv: BoolArray | None, wall: Wall, numbers: Numbers,
          voxel_mm: float) -> Image:  # fmt: skip
    """The label map on an isotropic grid of ``voxel_mm`` along the CT's axes.

    Blood up to the endocardium; wall up to its thickness from there, closed; fat (standard window, median filter) outside of the
    wall within FAT_WITHIN_MM of the blood. Raises AnatomyError where the grid would be too large.
    """
    grid = _grid(ct, pool, voxel_mm)
    shape = grid.array.shape
    inside = _resampled(ct, pool.astype(np.float32), grid, order=1) > 0.5
    reach = float(wall.thickness.max()) + 1.0
    sampling = (voxel_mm,) * 3
    outward = ndimage.distance_transform_edt(~inside, sampling=sampling)
    inward = ndimage.distance_transform_edt(inside, sampling=sampling)
    band = np.argwhere((outward <= max(reach, FAT_WITHIN_MM) + 1.5) & (inward <= _BAND_MM))
    height, thickness, opened = _places(grid.to_world(band[:, ::-1]), wall)
    blood = inward > _BAND_MM
    at = tuple(band.T)
    blood[at] = height <= 0
    blood = np.asarray(ndimage.binary_fill_holes(largest(blood)))
    muscle = np.zeros(shape, dtype=bool)
    muscle[at] = (height > 0) & (height <= thickness) & ~opened
    shut = np.zeros(shape, dtype=bool)
    shut[at] = opened & (height > 0)
    both = ndimage.binary_closing(blood | muscle, ndimage.generate_binary_structure(3, 1), iterations=2)
    muscle = both & ~blood & ~shut
    out = np.zeros(shape, dtype=np.uint8)
    if lv is not None and numbers.lv is not None:
        out[_resampled(ct, lv.astype(np.float32), grid, order=1) > 0.5] = numbers.lv
    density = np.zeros(shape, dtype=bool)
    value = ndimage.map_coordinates(smooth, ct.to_index(grid.to_world(band[:, ::-1]))[:, ::-1].T, order=1, mode="nearest")
    low, high = WINDOWS["standard"]
    density[at] = (value >= low) & (value <= high) & (height > thickness) & (height <= FAT_WITHIN_MM) & ~opened
    out[_without_islands(density, voxel_mm) & (out == 0)] = numbers.fat
    out[muscle] = numbers.wall
    out[blood] = numbers.la
    return grid.with_array(out)


def _grid(ct: Image, pool: BoolArray, voxel_mm: float) -> Image:
    where = np.argwhere(pool)[:, ::-1]
    margin = np.ceil(MARGIN_MM / ct.spacing).astype(int)
    size = np.array(ct.array.shape[::-1])
    low = np.maximum(where.min(axis=0) - margin, 0)
    high = np.minimum(where.max(axis=0) + margin, size - 1)
    count = np.floor((high - low) * ct.spacing / voxel_mm).astype(int) + 1
    if int(np.prod(count)) * 24 > MOST_BYTES:  # a few arrays of the size are held at once
        raise AnatomyError(
            f"voxels of {voxel_mm:g} mm make a label map of {' x '.join(map(str, count))}, too large to hold: take larger ones."
        )
    empty = np.zeros(tuple(count[::-1]), dtype=np.uint8)
    return Image(empty, np.full(3, voxel_mm), ct.to_world(low[None])[0], ct.direction)


def _resampled(ct: Image, values: FloatArray, grid: Image, order: int) -> FloatArray:
    """Values of the CT's grid at another's points; the two have the same axes."""
    start = ct.to_index(grid.origin[None])[0]
    step = grid.spacing / ct.spacing
    return np.asarray(
        ndimage.affine_transform(
            values, step[::-1], offset=start[::-1], output_shape=grid.array.shape, order=order, mode="nearest"
        )
    )


def _places(points: FloatArray, wall: Wall) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Signed height over the endocardium, thickness there (n,) mm, and whether it is open; from the three nearest points."""
    away, nearest = cKDTree(wall.surface.points).query(points, k=3)
    weight = 1.0 / (away**2 + 0.01)
    weight /= weight.sum(axis=1, keepdims=True)
    offset = points[:, None] - wall.surface.points[nearest]
    height = (weight * np.einsum("nkd,nkd->nk", offset, wall.normal[nearest])).sum(axis=1)
    return height, (weight * wall.thickness[nearest]).sum(axis=1), wall.flag[nearest[:, 0]] == OPEN


def _without_islands(mask: BoolArray, voxel_mm: float) -> BoolArray:
    parts, count = ndimage.label(mask)
    if count == 0:
        return mask
    keep = np.bincount(parts.ravel()) * voxel_mm**3 / 1000.0 >= LEAST_ISLAND_ML
    keep[0] = False
    return np.asarray(keep[parts])
