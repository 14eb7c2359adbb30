"""A CT of an atrium whose wall is of known, varying thickness, with fat, an aorta and muscle that touch it, and rough labels.

Axes are LPS, as the shape's own. Voxels are mixtures by the share of each tissue in them, then blurred: what a scanner does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.contracts.labels import PLANES
from lacli.synthetic.atrium import isosurface, sized
from lacli.synthetic.gated import texture
from lacli.synthetic.image import Grid, distance_fields
from lacli.synthetic.shape import Shape

LA, LV, MUSCLE = 2, 3, 5
BLOOD_HU, MUSCLE_HU, FAT_HU, AROUND_HU = 350.0, 100.0, -100.0, -60.0
VENTRICLE_WALL_MM, AORTA_WALL_MM = 8.0, 1.5
AORTA_RADIUS_MM, LUMP_RADIUS_MM = 13.0, 14.0
OVERLAP_MM = 0.8  # how deep a neighbour would lie in the wall's outside: so it touches over a patch, not at a point
MARGIN_MM = 16.0
ROUGH_MM = 0.7  # standard deviation of the rough label's border, with lumps of about 6 mm
_REACH_MM, _STEP_MM = 9.0, 0.05


@dataclass(frozen=True)
class Walled:
    """ct: HU; rough: LA blood 2, LV blood 3, LV muscle 5, the atrium's border off by ROUGH_MM; truth of the wall:
    points (n, 3) mm on the endocardium; normal (n, 3); thickness (n,) mm along the normal; touching (n,): where what lies
    outside the wall is no fat or lung; body (n,): inside of the vessels' cuts and the valve."""

    ct: Image
    rough: Image
    points: FloatArray
    normal: FloatArray
    thickness: FloatArray
    touching: BoolArray
    body: BoolArray


@dataclass(frozen=True)
class _Scene:
    """Shape, least and greatest thickness (mm), aorta's axis point, lump's centre (3,) mm; None: no neighbours."""

    shape: Shape
    thin: float
    thick: float
    aorta: FloatArray | None
    lump: FloatArray | None

    def wall(self, points: FloatArray) -> FloatArray:
        """Thickness in the shape's own measure (k,) mm at any points."""
        x, y, z = points.T
        wave = np.sin(x / 14.0 + 0.4 * self.shape.seed) * np.cos(y / 12.0 + z / 16.0)
        return self.thin + (self.thick - self.thin) * 0.5 * (1.0 + wave)

    def neighbours(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances (k,) mm to the aorta's blood and to neighbouring muscle (the aorta's wall and the lump); negative inside."""
        if self.aorta is None or self.lump is None:
            return np.full(len(points), 99.0), np.full(len(points), 99.0)
        blood = np.linalg.norm(points[:, :2] - self.aorta[:2], axis=1) - (AORTA_RADIUS_MM - AORTA_WALL_MM)
        lump = np.linalg.norm(points - self.lump, axis=1) - LUMP_RADIUS_MM
        return blood, np.minimum(blood - AORTA_WALL_MM, lump)


def walled(
    seed: int,
    thickness_mm: tuple[float, float] = (1.5, 4.0),
    voxel_mm: tuple[float, float, float] = (0.45, 0.45, 0.45),
    noise_hu: float = 25.0,
    blur_mm: float = 0.5,
    neighbours: bool = True,
    volume_ml: float | None = None,
) -> Walled:
    """CT, rough labels and truth of a seed's atrium; ``blur_mm`` is the scanner's, beside the voxels' own."""
    shape = sized(seed, volume_ml)
    scene = _scene(shape, thickness_mm, neighbours)
    grid = Grid.around(shape, np.asarray(voxel_mm, dtype=float), MARGIN_MM)
    inside, valve = distance_fields(shape, grid, shape.implicit)  # its truth is measured along the same field's rays
    rng = np.random.default_rng([20260420, seed])
    hu, rough = _voxels(scene, grid, inside, valve, rng)
    hu = ndimage.gaussian_filter(hu, blur_mm / grid.spacing[::-1])
    hu += rng.normal(0.0, noise_hu, hu.shape).astype(np.float32)
    eye = np.eye(3)
    image = Image(np.round(np.clip(hu, -1024, 3071)).astype(np.int16), grid.spacing, grid.low, eye)
    return Walled(image, image.with_array(rough.astype(np.uint8)), *_truth(scene))


def _scene(shape: Shape, thickness_mm: tuple[float, float], neighbours: bool) -> _Scene:
    bare = _Scene(shape, *thickness_mm, None, None)
    if not neighbours:
        return bare
    front = _outside(bare, np.array([-0.45, -0.87, 0.2]))
    back = _outside(bare, np.array([0.1, 0.97, 0.0]))
    way_front, way_back = np.array([-0.46, -0.89, 0.0]), np.array([0.1, 0.99, 0.0])
    return _Scene(
        shape,
        *thickness_mm,
        front + (AORTA_RADIUS_MM - OVERLAP_MM) * way_front,
        back + (LUMP_RADIUS_MM - OVERLAP_MM) * way_back,
    )


def _outside(scene: _Scene, way: FloatArray) -> FloatArray:
    """Where the ray from the body's middle along ``way`` leaves the wall for the last time (3,) mm."""
    way = way / np.linalg.norm(way)
    points = np.arange(5.0, 60.0, 0.05)[:, None] * way
    return np.asarray(points[np.flatnonzero(scene.shape.implicit(points) < scene.wall(points))[-1]])


def _voxels(
    scene: _Scene, grid: Grid, inside: FloatArray, valve: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """HU without blur and noise, and the rough label map (nk, nj, ni)."""
    slope = np.maximum(np.sqrt(sum(g**2 for g in np.gradient(inside, *grid.spacing[::-1]))), 0.3)
    lumps = ndimage.gaussian_filter(rng.normal(size=inside.shape).astype(np.float32), 3.0 / grid.spacing[::-1])
    lumps *= ROUGH_MM / lumps.std()
    noise = texture(inside.shape, grid.spacing, rng)
    hu = np.empty(inside.shape, dtype=np.float32)
    rough = np.zeros(inside.shape, dtype=np.uint8)
    voxel = float(np.cbrt(np.prod(grid.spacing)))
    for k in range(inside.shape[0]):
        points = grid.points(k)
        d, v = inside[k].ravel(), valve[k].ravel()
        scale = 1.0 / (voxel * slope[k].ravel())

        def share(distance: FloatArray, per_mm: FloatArray | float = 1.0 / voxel) -> FloatArray:
            return np.clip(0.5 - distance * per_mm, 0.0, 1.0)

        ventricle = _ventricle(scene.shape, points)
        above = share(v)  # on the atrium's side of the valve
        pool = share(d, scale) * above
        wall = np.clip(share(d - scene.wall(points), scale) - share(d, scale), 0.0, 1.0) * above
        lv = share(ventricle) * (1.0 - above)
        muscle = np.clip(share(ventricle - VENTRICLE_WALL_MM) - share(ventricle), 0.0, 1.0) * (1.0 - above)
        aorta, near = scene.neighbours(points)
        pad = np.sin(points[:, 0] / 11.0) * np.cos(points[:, 1] / 9.0 + points[:, 2] / 13.0) > 0.0
        free = np.where(pad & (d < 12.0), FAT_HU, AROUND_HU) + noise[k].ravel()
        left = np.clip(1.0 - pool - wall - lv - muscle, 0.0, 1.0)
        beside = np.clip(share(near), 0.0, 1.0)
        other = beside * (MUSCLE_HU + (BLOOD_HU - MUSCLE_HU) * share(aorta)) + (1.0 - beside) * free
        value = (pool + lv) * BLOOD_HU + (wall + muscle) * MUSCLE_HU + left * other
        hu[k] = value.reshape(hu.shape[1:])
        row = np.zeros(len(d), dtype=np.uint8)
        row[muscle > 0.5] = MUSCLE
        row[lv > 0.5] = LV
        row[(d + lumps[k].ravel() < 0) & (v <= 0)] = LA
        rough[k] = row.reshape(hu.shape[1:])
    return hu.astype(np.float64), rough.astype(np.int64)


def _ventricle(shape: Shape, points: FloatArray) -> FloatArray:
    """About the distance (k,) mm to the half ellipsoid that stands on the valve; negative inside."""
    cut = next(c for c in shape.cuts() if c.label == PLANES["mv"])
    radius = shape.tubes["mv"].radius_end * shape.scale
    relative = points - cut.centre
    height = relative @ cut.direction
    across = np.linalg.norm(relative - height[:, None] * cut.direction, axis=1)
    return (np.hypot(height / 2.0, across) - radius) * np.where(height > radius, 1.6, 1.0)


def _truth(scene: _Scene) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, BoolArray]:
    """Points, normals, thickness along them, whether a neighbour touches, whether the point is of the body; see Walled."""
    shape = scene.shape
    points = isosurface(shape, 1.6 / shape.scale).points
    h = 1e-3
    gradient = np.column_stack([shape.implicit(points + h * e) - shape.implicit(points - h * e) for e in np.eye(3)])
    normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    along = np.arange(_STEP_MM, _REACH_MM, _STEP_MM)
    thickness = np.full(len(points), _REACH_MM)
    touching = np.zeros(len(points), dtype=bool)
    for i in range(0, len(points), 2000):
        ray = points[i : i + 2000, None] + along[:, None] * normal[i : i + 2000, None]
        flat = ray.reshape(-1, 3)
        d = shape.implicit(flat).reshape(ray.shape[:2])
        excess = d - scene.wall(flat).reshape(d.shape)
        out = excess > 0
        first = np.where(out.any(axis=1), out.argmax(axis=1), len(along) - 1)
        row = np.arange(len(first))
        low, high = excess[row, np.maximum(first - 1, 0)], excess[row, first]
        back = np.where((first > 0) & (high > low), high / np.maximum(high - low, 1e-9), 0.0)
        thickness[i : i + 2000] = along[first] - np.clip(back, 0.0, 1.0) * _STEP_MM
        # within a voxel or so of its outside: another wall's muscle or blood, or the same atrium's
        near = scene.neighbours(flat)[1].reshape(d.shape)
        beyond = (along > along[first][:, None]) & (along < along[first][:, None] + 0.8)
        touching[i : i + 2000] = ((near < 0) & beyond).any(axis=1) | (beyond & ~out).any(axis=1) | ~out.any(axis=1)
    body = np.ones(len(points), dtype=bool)
    for cut in shape.cuts():
        relative = points - cut.centre
        height = relative @ cut.direction
        across = np.linalg.norm(relative - height[:, None] * cut.direction, axis=1)
        body &= ~((across < cut.reach_mm) & (height > -3.0))
    return points, normal, thickness, touching, body
