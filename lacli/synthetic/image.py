"""Images of a parametric atrium: a label map with the left ventricle, and a noisy CT with epicardial fat of known volume.

Axes are LPS, as the shape's own: x left, y back, z head.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from lacli.anatomy.inputs.extraction import isosurface
from lacli.anatomy.inputs.image import Image
from lacli.base.arrays import FloatArray
from lacli.contracts.labels import PLANES
from lacli.synthetic.atrium import sized
from lacli.synthetic.shape import Shape

LA, LV, WALL = 2, 3, 4
HOUNSFIELD = {"blood": 350.0, "wall": 100.0, "fat": -100.0, "tissue": 40.0}
FAT_REACH_MM = 5.0


@dataclass(frozen=True)
class SyntheticImages:
    """labels: LA blood 2 (veins go on past their cuts, the valve is flat), LV blood 3, wall 4; ct in HU; fat_ml: the volume of
    fat within 5 mm of the blood, integrated on a grid of a third of the voxels; pool_ml: of the blood as labelled."""

    labels: Image
    ct: Image
    fat_ml: float
    pool_ml: float


def images(
    seed: int,
    volume_ml: float | None = None,
    spacing_mm: tuple[float, float, float] = (0.6, 0.6, 0.6),
    thickness_mm: float = 2.0,
    noise_hu: float = 25.0,
    blur_mm: float = 0.5,
) -> SyntheticImages:
    """Label map and CT of a seed's atrium; ``spacing_mm`` along x, y, z; Gaussian noise and blur (standard deviations)."""
    shape = sized(seed, volume_ml)
    grid = Grid.around(shape, np.asarray(spacing_mm, dtype=float))
    inside, valve = distance_fields(shape, grid, shape.distance)
    label = np.zeros(grid.size[::-1], dtype=np.int16)
    wall = (inside > 0) & (inside <= thickness_mm) & (valve <= 0)
    label[wall] = WALL
    label[ventricle(shape, grid, valve)] = LV
    label[(inside <= 0) & (valve <= 0)] = LA
    fat_share, fat_ml = _fat(shape, grid, inside, thickness_mm)
    hu = np.full(label.shape, HOUNSFIELD["tissue"])
    hu[label == WALL] = HOUNSFIELD["wall"]
    hu[(label == LA) | (label == LV)] = HOUNSFIELD["blood"]
    hu = hu * (1 - fat_share) + HOUNSFIELD["fat"] * fat_share
    hu = ndimage.gaussian_filter(hu, blur_mm / grid.spacing[::-1])
    hu += np.random.default_rng([20260402, seed]).normal(0.0, noise_hu, hu.shape)
    eye = np.eye(3)
    labels = Image(label, grid.spacing, grid.low, eye)
    return SyntheticImages(
        labels, Image(hu.astype(np.float32), grid.spacing, grid.low, eye), fat_ml, float((label == LA).sum()) * labels.voxel_ml
    )


@dataclass(frozen=True)
class Grid:
    low: FloatArray
    spacing: FloatArray
    size: NDArray[np.int64]

    @classmethod
    def around(cls, shape: Shape, spacing: FloatArray, margin_mm: float = 8.0) -> Grid:
        low, high = shape.bounds()
        low, high = low - margin_mm, high + margin_mm
        return cls(low, spacing, np.ceil((high - low) / spacing).astype(np.int64))

    def points(self, k: int) -> FloatArray:
        """Voxel centres of slice k: (nj * ni, 3) mm."""
        y, x = np.meshgrid(np.arange(self.size[1]), np.arange(self.size[0]), indexing="ij")
        index = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, k)])
        return self.low + index * self.spacing


def distance_fields(shape: Shape, grid: Grid, field: Callable[[FloatArray], FloatArray]) -> tuple[FloatArray, FloatArray]:
    """A field of the shape (its distance from the uncut cavity, negative inside) and the height over the mitral plane, per voxel
    (nk, nj, ni) mm.

    The field is evaluated on every second voxel and splined between: it is smooth on that scale.
    """
    coarse = Grid(grid.low, 2.0 * grid.spacing, grid.size // 2 + 1)
    inside = np.stack([field(coarse.points(k)).reshape(coarse.size[1], coarse.size[0]) for k in range(int(coarse.size[2]))])
    for axis in range(3):
        spline = CubicSpline(2.0 * np.arange(inside.shape[axis]), inside, axis=axis)
        inside = spline(np.arange(grid.size[2 - axis]))
    cut = next(c for c in shape.cuts() if c.label == PLANES["mv"])
    valve = np.empty(grid.size[::-1])
    for k in range(int(grid.size[2])):
        relative = grid.points(k) - cut.centre
        height = relative @ cut.direction
        across = np.linalg.norm(relative - height[:, None] * cut.direction, axis=1)
        # the plane ends where the valve's tube does; beside it the atrium may reach lower
        valve[k] = np.where(across < cut.reach_mm, height, -1.0).reshape(grid.size[1], grid.size[0])
    return inside, valve


def ventricle(shape: Shape, grid: Grid, valve: FloatArray) -> NDArray[np.bool_]:
    """Half an ellipsoid that stands on the valve's opening."""
    cut = next(c for c in shape.cuts() if c.label == PLANES["mv"])
    radius = shape.tubes["mv"].radius_end * shape.scale
    out = np.zeros(valve.shape, dtype=bool)
    for k in range(valve.shape[0]):
        relative = grid.points(k) - cut.centre
        height = relative @ cut.direction
        across = np.linalg.norm(relative - height[:, None] * cut.direction, axis=1)
        out[k] = ((height > 0) & ((height / (2.0 * radius)) ** 2 + (across / radius) ** 2 < 1)).reshape(valve.shape[1:])
    return out


def _fat(shape: Shape, grid: Grid, inside: FloatArray, thickness: float) -> tuple[FloatArray, float]:
    """Share of fat per voxel (from 3 x 3 x 3 samples of the interpolated distance), and its volume within reach of the blood, mL.

    Fat lies on the wall's outside in pads of up to 6 mm with steep sides, and nowhere near the valve.
    """
    cut = next(c for c in shape.cuts() if c.label == PLANES["mv"])
    share = np.zeros(grid.size[::-1])
    bias = _bias(inside, grid)
    reached = 0
    for shift in np.ndindex(3, 3, 3):
        offset = (np.array(shift) - 1) / 3.0
        distance = ndimage.shift(inside, -offset, order=1, mode="nearest")
        for k in range(int(grid.size[2])):
            points = grid.points(k) + offset[::-1] * grid.spacing
            d = distance[k].ravel()
            x, y, z = points.T
            pad = np.sin(x / 11.0) * np.cos(y / 9.0 + z / 13.0)
            layer = 6.0 * np.clip(4.0 * pad, 0.0, 1.0)
            fat = (d > thickness) & (d < thickness + layer) & ((points - cut.centre) @ cut.direction < -6.0)
            share[k] += fat.reshape(grid.size[1], grid.size[0]) / 27.0
            reached += int((fat & (d + bias[k].ravel() <= FAT_REACH_MM)).sum())
    return share, reached / 27.0 * float(np.prod(grid.spacing)) / 1000.0


def _bias(inside: FloatArray, grid: Grid) -> FloatArray:
    """True distance to the blood's surface less the shape's own measure of it, near FAT_REACH_MM (elsewhere 0), mm.

    The shape's measure is a distance only near the surface: between vessels that blend it falls short by up to a millimetre.
    """
    surface = isosurface(Image(-inside, grid.spacing, np.zeros(3), np.eye(3)), 0.0)
    samples = np.vstack([surface.points, surface.points[surface.triangles].mean(axis=1)])
    # 1.5: the measure is up to that much short, and fat is counted a voxel around
    voxel = np.argwhere((inside > FAT_REACH_MM - 1.5) & (inside < FAT_REACH_MM + 1.0))
    distance, _ = cKDTree(samples).query(voxel[:, ::-1] * grid.spacing)
    bias = np.zeros(inside.shape)
    bias[tuple(voxel.T)] = distance - inside[tuple(voxel.T)]
    return bias


__all__ = ["HOUNSFIELD", "LA", "LV", "WALL", "SyntheticImages", "images"]
