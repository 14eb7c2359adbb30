"""A gated CT whose motion is known: one volume a frame, end-diastole moved by a simulated cycle, each with its own noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.base.arrays import FloatArray
from lacli.base.errors import UsageError
from lacli.synthetic.atrium import sized
from lacli.synthetic.cycle import SpaceField, SpaceMotion
from lacli.synthetic.image import LA, LV, WALL, Grid, distance_fields, ventricle

MARGIN_MM = 26.0
BLOOD_HU, VENTRICLE_HU, MUSCLE_HU, AROUND_HU = 350.0, 330.0, 100.0, -60.0
TEXTURE_MM, TEXTURE_HU = 3.0, 30.0
_BLUR_SAMPLES = 5


@dataclass(frozen=True)
class Acquisition:
    """How the frames are taken. frames: per cycle, evenly from ED; voxel_mm (3,) along x, y, z; noise_hu: sd, white; blur: sd in
    voxels; motion_blur: share of the cycle that one frame's exposure lasts; contrast_drift_hu: how far the blood falls."""

    frames: int = 10
    voxel_mm: tuple[float, float, float] = (1.0, 1.0, 1.0)
    noise_hu: float = 25.0
    blur: float = 0.6
    motion_blur: float = 0.0
    contrast_drift_hu: float = 0.0

    def check(self) -> None:
        """UsageError where a number is out of range."""
        ranges = {
            "frames": (self.frames, 4, 60),
            "voxel_mm": (min(self.voxel_mm), 0.2, 3.0),
            "noise_hu": (self.noise_hu, 0.0, 500.0),
            "blur": (self.blur, 0.0, 5.0),
            "motion_blur": (self.motion_blur, 0.0, 0.3),
            "contrast_drift_hu": (self.contrast_drift_hu, -250.0, 250.0),
        }
        for name, (value, low, high) in ranges.items():
            if not low <= value <= high:
                raise UsageError(f"--{name.replace('_', '-')} is {value:g}; it must be {low:g} to {high:g}.")

    @property
    def times(self) -> FloatArray:
        """Middle of each frame's exposure (f,), a share of the cycle."""
        return np.arange(self.frames) / self.frames


@dataclass(frozen=True)
class Still:
    """The atrium at end-diastole without noise: HU (nk, nj, ni) and the label map of the same grid."""

    ct: Image
    labels: Image


def still(seed: int, volume_ml: float | None, thickness_mm: float, acquisition: Acquisition) -> Still:
    """Blood, muscle, and lung and fat with texture around; blurred. Veins and valve go on past their cuts."""
    shape = sized(seed, volume_ml)
    grid = Grid.around(shape, np.asarray(acquisition.voxel_mm, dtype=float), MARGIN_MM)
    inside, valve = distance_fields(shape, grid, shape.distance)
    label = np.zeros(grid.size[::-1], dtype=np.uint8)
    label[(inside > 0) & (inside <= thickness_mm) & (valve <= 0)] = WALL
    label[ventricle(shape, grid, valve)] = LV
    label[(inside <= 0) & (valve <= 0)] = LA
    del inside, valve
    rng = np.random.default_rng([20260412, seed])
    hu = (AROUND_HU + texture(label.shape, grid.spacing, rng)).astype(np.float32)
    hu[label == WALL] = MUSCLE_HU
    hu[label == LV] = VENTRICLE_HU
    hu[label == LA] = BLOOD_HU
    hu = ndimage.gaussian_filter(hu, acquisition.blur)
    eye = np.eye(3)
    return Still(Image(hu, grid.spacing, grid.low, eye), Image(label, grid.spacing, grid.low, eye))


def texture(shape: tuple[int, ...], spacing: FloatArray, rng: np.random.Generator) -> NDArray[np.float32]:
    """Noise of TEXTURE_HU with lumps of TEXTURE_MM, whatever the voxels: drawn on a grid of 1 mm and splined."""
    count = np.ceil(np.array(shape) * spacing[::-1]).astype(int) + 2
    coarse = ndimage.gaussian_filter(rng.normal(size=tuple(count)), TEXTURE_MM / 2.0)
    coarse = (coarse * TEXTURE_HU / coarse.std()).astype(np.float32)
    if np.allclose(spacing, 1.0):
        return coarse[: shape[0], : shape[1], : shape[2]]
    fine = ndimage.zoom(coarse, 1.0 / spacing[::-1], order=1, grid_mode=False)
    return fine[: shape[0], : shape[1], : shape[2]]


def frames(image: Image, motion: SpaceMotion, acquisition: Acquisition, seed: int) -> Iterator[Image]:
    """The volumes in order of time: HU of int16, each with its own noise."""
    smooth = ndimage.spline_filter(image.array, order=3, output=np.float32)
    for number, time in enumerate(acquisition.times):
        rng = np.random.default_rng([20260413, seed, number])
        half = acquisition.motion_blur / 2.0
        exposure = np.linspace(time - half, time + half, _BLUR_SAMPLES) if half > 0 else np.array([time])
        total = np.zeros(image.array.shape, dtype=np.float32)
        for moment in exposure:
            total += _pulled(image, smooth, motion.at(float(moment % 1.0)).inverse(), bool(moment % 1.0))
        hu = total / len(exposure)
        if acquisition.contrast_drift_hu:
            blood = np.clip((hu - MUSCLE_HU) / (BLOOD_HU - MUSCLE_HU), 0.0, 1.0)
            hu -= acquisition.contrast_drift_hu * float(time) * blood
        hu += rng.normal(0.0, acquisition.noise_hu, hu.shape).astype(np.float32)
        yield image.with_array(np.round(np.clip(hu, -1024, 3071)).astype(np.int16))


def _pulled(image: Image, smooth: NDArray[np.float32], inverse: SpaceField, moved: bool) -> NDArray[np.float32]:
    """The image at x + v(x), slice by slice."""
    if not moved:
        return image.array.astype(np.float32)
    nk, nj, ni = image.array.shape
    axes = [image.origin[i] + image.spacing[i] * np.arange(n) for i, n in enumerate((ni, nj, nk))]
    out = np.empty(image.array.shape, dtype=np.float32)
    step = 32
    for k in range(0, nk, step):
        v = inverse.on_axes([axes[0], axes[1], axes[2][k : k + step]])  # (ni, nj, s, 3)
        index = np.stack(
            [
                np.arange(k, min(k + step, nk), dtype=np.float32)[:, None, None] + v[..., 2].T / np.float32(image.spacing[2]),
                np.arange(nj, dtype=np.float32)[None, :, None] + v[..., 1].T / np.float32(image.spacing[1]),
                np.arange(ni, dtype=np.float32)[None, None, :] + v[..., 0].T / np.float32(image.spacing[0]),
            ]
        )
        ndimage.map_coordinates(smooth, index, output=out[k : k + step], order=3, mode="nearest", prefilter=False)
    return out
