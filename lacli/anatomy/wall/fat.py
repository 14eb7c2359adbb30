"""Epicardial fat in a CT volume: voxels of fat's density near the blood pool, their volume per region, and their mesh."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, special
from scipy.spatial import cKDTree

from lacli.anatomy.inputs.image import Image
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import REGIONS
from lacli.geometry.surface import Surface

WINDOWS: dict[str, tuple[float, float]] = {"standard": (-190.0, -30.0), "alternative": (-195.0, -45.0)}
REACH_MM = 5.0
LEAST_ISLAND_ML = 0.02
BLOOD_HU = 200.0  # above it is contrast-filled blood or bone
LEAST_TISSUE_HU, AIR_HU = -30.0, -300.0
BAND_MM = 2.5  # of the blood's edge, either side, in which its blur is measured
USUAL_BLUR_MM = 0.6
SPREAD = 4  # voxels around fat that are looked at, at most


@dataclass(frozen=True)
class Fat:
    """mask: fat voxels on a cropped grid of the CT; region (same shape): 1 - 5 where fat and regions are known, else 0.

    window_ml: volume of the voxels in the window. volume_ml: with the voxels at the border counted by their share of fat, whole
    and per region. edge: of the blood, whose share in the border's voxels was taken off; None: it was not found, and was not.
    """

    mask: Image
    region: NDArray[np.int64]
    window_ml: float
    volume_ml: float
    per_region_ml: dict[str, float] = field(default_factory=dict)
    edge: Edge | None = None


def segment(ct: Image, pool: Surface, bundle: Bundle | None = None, window: str = "standard", reach_mm: float = REACH_MM) -> Fat:
    """Fat within ``reach_mm`` of the blood pool's surface (outside it), with densities in the window of WINDOWS.

    Noise is taken off by a median over 3 x 3 x 3 voxels; islands below LEAST_ISLAND_ML are dropped. Each voxel belongs to the
    region of the nearest epicardial face of ``bundle``. Raises AnatomyError where image and pool do not overlap, or the values
    are no Hounsfield units.
    """
    low_hu, high_hu = WINDOWS[window]
    _check_hounsfield(ct)
    margin = reach_mm + 2.0
    corners = (
        np.array(np.meshgrid(*np.column_stack([pool.points.min(axis=0) - margin, pool.points.max(axis=0) + margin])))
        .reshape(3, -1)
        .T
    )
    index = ct.to_index(corners)
    low, high = np.floor(index.min(axis=0)).astype(int), np.ceil(index.max(axis=0)).astype(int) + 1
    size = np.array(ct.array.shape[::-1])
    low, high = np.clip(low, 0, size), np.clip(high, 0, size)
    if np.any(high - low < 3):
        raise AnatomyError("the CT does not cover the blood pool: are they of the same patient, and in the same frame (LPS mm)?")
    part = ct.crop(low, high)
    smooth = ndimage.median_filter(part.array.astype(np.float32), 3)
    dense = (smooth >= low_hu) & (smooth <= high_hu)
    islands, count = ndimage.label(dense)
    if count:
        volumes = np.bincount(islands.ravel()) * ct.voxel_ml
        dense &= volumes[islands] >= LEAST_ISLAND_ML
    height = _heights(part, pool, ndimage.binary_dilation(dense, iterations=SPREAD), reach_mm)
    edge = blood_edge(part.array.astype(np.float64), height, dense)
    share = fat_share(part, smooth, dense, height, edge)
    counted = (height > 0) & (height <= reach_mm) & (dense | (share != 0))
    mask, share = dense & counted, np.where(counted, share, 0.0)
    region = np.zeros(mask.shape, dtype=np.int64)
    per_region: dict[str, float] = {}
    if bundle is not None:
        where = np.argwhere(counted)
        if len(where):
            region[tuple(where.T)] = _regions(bundle, part.to_world(where[:, ::-1].astype(float)))
        per_region = {name: float(share[region == value].sum()) * ct.voxel_ml for name, value in REGIONS.items()}
    return Fat(part.with_array(mask), region, float(mask.sum()) * ct.voxel_ml, float(share.sum()) * ct.voxel_ml, per_region, edge)


@dataclass(frozen=True)
class Edge:
    """The blood's edge in the image: HU of the blood, width (standard deviation) and place of its blur over the pool's, mm."""

    blood_hu: float
    blur_mm: float
    shift_mm: float

    def blood_share(self, height: FloatArray) -> FloatArray:
        """Share of blood in a voxel ``height`` mm outside the pool's surface (negative inside)."""
        return np.asarray(special.ndtr((self.shift_mm - height) / self.blur_mm), dtype=np.float64)


def blood_edge(density: FloatArray, height: FloatArray, dense: NDArray[np.bool_]) -> Edge | None:
    """Fit of an error function to the mean density over the height, away from fat; None where there is no such step.

    There is none where the blood has no contrast, or the pool is of another image.
    """
    clear = (height > -BAND_MM) & (height < 0.5 * BAND_MM) & ~ndimage.binary_dilation(dense, iterations=SPREAD)
    bins = np.round(height[clear] / 0.1).astype(int)
    _, inverse, count = np.unique(bins, return_inverse=True, return_counts=True)
    mean = [np.bincount(inverse, weights=values) / count for values in (height[clear], density[clear])]
    x, y = mean[0][count >= 30], mean[1][count >= 30]
    if len(x) < 12 or x[0] > -1.5 or x[-1] < 0.8:
        return None

    def step(at: FloatArray, blood: float, tissue: float, blur: float, shift: float) -> FloatArray:
        return np.asarray(tissue + (blood - tissue) * special.ndtr((shift - at) / blur), dtype=np.float64)

    try:
        bounds = ([0.0, -100.0, 0.15, -1.5], [1500.0, 300.0, 2.0, 1.5])
        (blood, tissue, blur, shift), _ = optimize.curve_fit(step, x, y, (300.0, 50.0, USUAL_BLUR_MM, 0.0), bounds=bounds)
    except RuntimeError:
        return None
    return Edge(float(blood), float(blur), float(shift)) if blood > BLOOD_HU and blood > tissue + 100.0 else None


def fat_share(
    ct: Image, smooth: NDArray[np.float32], dense: NDArray[np.bool_], height: FloatArray, edge: Edge | None
) -> FloatArray:
    """Share of fat per voxel: 1 inside, at the border by where the density lies between the fat's and the tissue's nearby.

    Blur and voxel size make the border's voxels mixtures. A fixed window loses or wins some of them, depending on the
    neighbour; a mixture's density is linear in its shares, so their sum is right on average. The wall is thin: blood shines
    through it, in the voxels themselves and in the tissue they are compared with. Its share is known from the pool's surface
    (``height``, mm, infinite far away) and the blur of its edge, and is taken off:
    density = b blood + f fat + (1 - b - f) tissue, solved for f.
    ``smooth`` is the density without noise and tells the classes apart. Shares are not clipped: noise cancels.
    """
    density = ct.array.astype(np.float64)
    voxel = float(ct.spacing.max())
    blur = USUAL_BLUR_MM if edge is None else edge.blur_mm
    reach = int(np.clip(round((3.0 * blur + 0.5 * voxel) / voxel), 1, SPREAD))
    ball = ndimage.generate_binary_structure(3, 1)
    core = ndimage.binary_erosion(dense, ball)
    around = ndimage.binary_dilation(dense, ball, iterations=reach)
    apart = ~ndimage.binary_dilation(dense, ball, iterations=max(1, reach - 1))
    blood = np.zeros(dense.shape) if edge is None else edge.blood_share(height)
    blood_hu = 0.0 if edge is None else edge.blood_hu
    tissue = apart & (smooth > LEAST_TISSUE_HU) & (smooth < BLOOD_HU) & (blood < 0.5)
    sigma = 1.2 / ct.spacing[::-1]
    fat_hu, fat_known = _local_mean(density, core.astype(np.float64), sigma)
    weight = np.where(tissue, (1.0 - blood) ** 2, 0.0)  # the noise of what is left is 1 / (1 - blood) times the image's
    tissue_hu, tissue_known = _local_mean((density - blood * blood_hu) / np.maximum(1.0 - blood, 0.5), weight, sigma)
    border = around & ~core & fat_known & tissue_known & (tissue_hu - fat_hu > 40.0)
    share = np.where(dense, 1.0, 0.0)
    mixed = (tissue_hu - density + blood * (blood_hu - tissue_hu)) / np.maximum(tissue_hu - fat_hu, 1.0)
    share[border] = mixed[border]
    # bone, other chambers' blood and air at the border are no such mixture
    share[border & ((smooth > BLOOD_HU) | (smooth < AIR_HU) | (blood > 0.5))] = 0.0
    return share


def _local_mean(values: FloatArray, weight: FloatArray, sigma: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    near = ndimage.gaussian_filter(weight, sigma)
    total = ndimage.gaussian_filter(values * weight, sigma)
    return total / np.maximum(near, 1e-3), near > 1e-3


def _check_hounsfield(ct: Image) -> None:
    lowest, highest = float(ct.array.min()), float(ct.array.max())
    if lowest > -30.0 or highest < 30.0:
        raise AnatomyError(
            f"the image's values run from {lowest:g} to {highest:g}: not Hounsfield units (fat is at -190 .. -30). "
            "Give the CT volume, with its rescale intercept applied."
        )


def _heights(ct: Image, pool: Surface, where: NDArray[np.bool_], reach: float) -> FloatArray:
    """Signed distance to the closed pool (mm, positive outside) of the voxels near its surface and of those ``where``.

    It is infinite elsewhere, and where it is more than ``reach``.
    """
    size = np.array(ct.array.shape)
    mark = np.ones(tuple(size), dtype=bool)
    index = np.round(ct.to_index(pool.points)).astype(int)[:, ::-1]
    mark[tuple(index[((index >= 0) & (index < size)).all(axis=1)].T)] = False
    gap = pool.mean_edge_mm()
    near = np.zeros(tuple(size), dtype=bool) if mark.all() else _closer(mark, ct, BAND_MM + gap)
    voxel = np.argwhere(near | where)
    height = np.full(tuple(size), np.inf)
    if len(voxel):
        height[tuple(voxel.T)] = _signed_distance(ct.to_world(voxel[:, ::-1].astype(float)), pool, reach)
    return height


def _closer(mark: NDArray[np.bool_], ct: Image, reach: float) -> NDArray[np.bool_]:
    return np.asarray(ndimage.distance_transform_edt(mark, sampling=ct.spacing[::-1]) <= reach)


def _signed_distance(points: FloatArray, pool: Surface, reach: float) -> FloatArray:
    """(n,) mm, positive outside the closed pool; infinite beyond ``reach``."""
    middle = pool.points[pool.triangles].mean(axis=1)
    samples = np.vstack([pool.points, middle])
    normal = np.vstack([_point_normals(pool), pool.normals()])
    gap = pool.mean_edge_mm()
    query = cKDTree(samples).query(points, distance_upper_bound=reach + 2.0 * gap)
    distance, nearest = (np.asarray(values) for values in query)
    known = np.isfinite(distance)
    out = np.full(len(points), np.inf)
    offset = points[known] - samples[nearest[known]]
    along = np.einsum("ij,ij->i", offset, normal[nearest[known]])
    # to the plane of the nearest sample: samples are as far apart as the surface's edges
    exact = np.where(distance[known] < 3.0 * gap, np.abs(along), distance[known])
    exact = np.maximum(exact, np.sqrt(np.maximum(distance[known] ** 2 - gap**2, 0.0)))
    out[known] = np.where(exact <= reach, np.where(along > 0, exact, -exact), np.inf)
    return out


def _point_normals(pool: Surface) -> FloatArray:
    total = np.zeros((len(pool.points), 3))
    for k in range(3):
        np.add.at(total, pool.triangles[:, k], pool.area_vectors())
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def _regions(bundle: Bundle, points: FloatArray) -> NDArray[np.int64]:
    from lacli.anatomy.coordinates.describe import cell_label
    from lacli.contracts.labels import EPI

    epi = bundle.triangles[bundle.tags == EPI, :3]
    label = cell_label(bundle, epi)
    body = (label >= 1) & (label <= 5)
    _, nearest = cKDTree(bundle.points[epi[body]].mean(axis=1)).query(points)
    return label[body][nearest]


def surface_of(fat: Fat, smoothing_mm: float = 0.6, grid_mm: float = 0.5) -> Surface:
    """Smooth closed surface around all of the fat (several parts), of the voxels' volume within a few per cent."""
    from lacli.anatomy.inputs import extraction

    if not fat.mask.array.any():
        raise AnatomyError("no fat was found, so there is no mesh of it.")
    padded = fat.mask.crop(np.full(3, -4), np.array(fat.mask.array.shape[::-1]) + 4)
    field_ = extraction.smooth_field(padded, smoothing_mm, grid_mm)
    return extraction.isosurface(field_, 0.5, largest=False)


def cells(fat: Fat) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64]]:
    """The fat's voxels as hexahedra: points (n, 3) mm, cells (m, 8) in VTK's order, region (m,)."""
    voxel = np.argwhere(fat.mask.array)[:, ::-1]
    corner = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    if np.linalg.det(fat.mask.direction) < 0:
        corner = corner[[4, 5, 6, 7, 0, 1, 2, 3]]
    nodes = (voxel[:, None] + corner[None]).reshape(-1, 3)
    size = np.array(fat.mask.array.shape[::-1]) + 1
    key = (nodes[:, 2] * size[1] + nodes[:, 1]) * size[0] + nodes[:, 0]
    names, inverse = np.unique(key, return_inverse=True)
    index = np.column_stack([names % size[0], names // size[0] % size[1], names // (size[0] * size[1])])
    points = fat.mask.to_world(index - 0.5)
    return points, inverse.reshape(-1, 8), fat.region[tuple(voxel[:, ::-1].T)]
