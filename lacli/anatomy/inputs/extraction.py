"""From the voxels of one label to a smooth closed surface of the same volume."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lacli.anatomy.inputs.image import Image, length_unit
from lacli.base.arrays import BoolArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry.surface import Surface

LEAST_ML, MOST_ML = 5.0, 1000.0  # of a left atrium with its veins
VEIN_MM = 25.0
LEAST_WALL_MM = 1.0  # from the blood, where a wall's label has holes


@dataclass(frozen=True)
class Pool:
    """The blood pool's voxels on a cropped grid: ``mask`` bool, and what was done to it in words."""

    mask: Image
    notes: tuple[str, ...]


def blood_pool(labels: Image, label: int, margin_mm: float = 8.0) -> Pool:
    """One connected, hole-free set of voxels of ``label``, cropped with a margin.

    Small islands are dropped and closed holes filled; that, where the image cuts the label off, and what is doubtful in the
    image's header is said in the notes. Raises AnatomyError where the label is absent, too small or large for an atrium
    (LEAST_ML, MOST_ML), or falls in two large parts (the second > 10 % of the first).
    """
    where = labels.array == label
    if not where.any():
        raise AnatomyError(f"label {label} has no voxel in the image.")
    check_volume(float(where.sum()) * labels.voxel_ml, f"label {label}")
    low, high = _bounds(where)
    box = labels.with_array(where).crop(low, high)
    notes = labels.doubts(labels.to_world(0.5 * (low + high - 1)[None])[0])
    array = box.array
    parts, count = ndimage.label(array)
    if count > 1:
        size = np.bincount(parts.ravel())[1:]
        order = np.argsort(size)[::-1]
        if size[order[1]] > 0.1 * size[order[0]]:
            volumes = ", ".join(f"{size[i] * labels.voxel_ml:.1f} mL" for i in order[:3])
            raise AnatomyError(
                f"label {label} falls in {count} unconnected parts ({volumes}); join them in the segmentation, "
                "or delete what is not the left atrium."
            )
        array = parts == order[0] + 1
        notes.append(f"{count - 1} islands of together {size[order[1:]].sum() * labels.voxel_ml:.3g} mL were dropped")
    notes += border_notes(box.with_array(array), low == 0, high == np.array(where.shape[::-1]), f"label {label}")
    filled = ndimage.binary_fill_holes(array)
    if filled.sum() > array.sum():
        notes.append(f"closed holes of {(filled.sum() - array.sum()) * labels.voxel_ml:.3g} mL were filled")
    check_volume(float(filled.sum()) * labels.voxel_ml, f"label {label}")
    margin = np.ceil(margin_mm / labels.spacing).astype(int)
    return Pool(box.with_array(filled).crop(-margin, high - low + margin), tuple(notes))


def within_wall(labels: Image, la: int, wall: int, notes: list[str]) -> Image:
    """All voxels within the wall's outer side, from its label; where the label has holes it keeps LEAST_WALL_MM from the blood.

    Raises AnatomyError where the label is absent or covers less than half of the blood pool.
    """
    if not (labels.array == wall).any():
        raise AnatomyError(f"label {wall} (atrial wall) has no voxel in the image.")
    both = labels.with_array(np.isin(labels.array, (la, wall)).astype(np.uint8))
    pool = blood_pool(both, 1)
    blood = labels.with_array(labels.array == la).crop(*box(pool.mask, labels))
    depth = ndimage.distance_transform_edt(~blood.array, sampling=labels.spacing[::-1])
    filled = (depth <= LEAST_WALL_MM) & ~pool.mask.array
    share = float(filled.sum()) / max(float((depth <= LEAST_WALL_MM).sum() - blood.array.sum()), 1.0)
    if share > 0.5:
        raise AnatomyError(
            f"label {wall} covers only {100 * (1 - share):.0f} % of the blood pool's surface; is it the atrial wall?"
        )
    if filled.any():
        notes.append(
            f"{100 * share:.1f} % of the wall next to the blood had no label; it was given {LEAST_WALL_MM:g} mm (openings too)"
        )
    return pool.mask.with_array(pool.mask.array | filled)


def box(mask: Image, labels: Image) -> tuple[IntArray, IntArray]:
    """Lowest and one past the highest index (i, j, k) of ``labels`` that a crop of them has."""
    low = np.round(labels.to_index(mask.origin[None])[0]).astype(int)
    return low, low + np.array(mask.array.shape[::-1])


def check_volume(volume_ml: float, what: str) -> None:
    """Raise AnatomyError where a volume is no left atrium's; the message names the unit it is one in."""
    if LEAST_ML <= volume_ml <= MOST_ML:
        return
    words = f"{what} has {volume_ml:.3g} mL, too {'little' if volume_ml < LEAST_ML else 'much'} for a left atrium"
    raise AnatomyError(f"{words}; is it the right label{length_unit(volume_ml, 20.0, 600.0, power=3) or '?'}.".replace("?.", "?"))


def border_notes(mask: Image, at_low: BoolArray, at_high: BoolArray, what: str) -> list[str]:
    """Where the image's border cuts the mask off: side, voxels, area; the body apart from veins, which may leave the image.

    ``at_low``, ``at_high`` (3,): whether the mask's grid ends where the image does, at the low and high end of i, j, k. A cut
    wider than a vein (VEIN_MM across at its widest) is the body's.
    """
    notes = []
    for axis, high in itertools.product(range(3), (False, True)):
        face = np.take(mask.array, -1 if high else 0, axis=2 - axis)
        if not (at_high if high else at_low)[axis] or not face.any():
            continue
        steps = np.delete(mask.spacing, axis)[::-1]
        parts, count = ndimage.label(face)
        width = 2.0 * np.asarray(ndimage.maximum(_depth(face, steps), parts, range(1, count + 1)))
        size = np.bincount(parts.ravel(), minlength=count + 1)[1:]
        side = f"{_side(mask.direction[:, axis] * (1 if high else -1))} border (the {'last' if high else 'first'} {'ijk'[axis]})"
        for wide, words in (
            (True, "the atrium may be cut: {what} touches the image's {side} with {area}, wider than a vein; the cut is taken "
                   "for wall, so that volume and shape are wrong there"),
            (False, "{what} leaves the image through its {side} with {area}, nowhere wider than a vein"),
        ):  # fmt: skip
            if voxels := int(size[(width > VEIN_MM) == wide].sum()):
                area = f"{voxels} voxels, {voxels * np.prod(steps) / 100.0:.3g} cm2"
                notes.append(words.format(what=what, side=side, area=area))
    return notes


def _depth(face: BoolArray, steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance to the edge of the cut, mm; the grid's edge is none."""
    if face.all():
        return np.full(face.shape, np.inf)
    inside = np.pad(face, 1, mode="edge")
    return np.asarray(ndimage.distance_transform_edt(inside, sampling=steps))[1:-1, 1:-1]


def _side(direction: NDArray[np.float64]) -> str:
    """The patient's side an axis points to (LPS)."""
    axis = int(np.argmax(np.abs(direction)))
    return (("right", "left"), ("anterior", "posterior"), ("lower", "upper"))[axis][int(direction[axis] > 0)]


def _bounds(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Lowest and one past the highest index (i, j, k) of the true voxels."""
    span = []
    for axis in (2, 1, 0):
        others = tuple(a for a in range(3) if a != axis)
        hit = np.flatnonzero(mask.any(axis=others))
        span.append((int(hit[0]), int(hit[-1]) + 1))
    return np.array([s[0] for s in span]), np.array([s[1] for s in span])


def smooth_field(mask: Image, sigma_mm: float, grid_mm: float) -> Image:
    """The mask as a smooth field on an isotropic grid, about 1 inside and 0 outside, 0.5 at the wall.

    The filter is 2G - G*G (twicing): it removes stair-casing as a Gaussian G of ``sigma_mm`` does, but its second moment is
    zero, so that convex parts (veins) do not shrink to first order in curvature.
    """
    sigma = (sigma_mm / mask.spacing)[::-1]
    once = ndimage.gaussian_filter(mask.array.astype(np.float32), sigma, truncate=3.5)
    field = 2.0 * once - ndimage.gaussian_filter(once, sigma, truncate=3.5)
    size = np.array(mask.array.shape)
    extent = (size - 1) * mask.spacing[::-1]
    target = np.floor(extent / grid_mm).astype(int) + 1
    coordinates = [np.arange(n) * grid_mm / s for n, s in zip(target, mask.spacing[::-1], strict=True)]
    for axis, where in enumerate(coordinates):
        field = _interpolate(field, where, axis)
    return Image(field, np.full(3, grid_mm), mask.origin, mask.direction)


def _interpolate(field: NDArray[np.float32], where: NDArray[np.float64], axis: int) -> NDArray[np.float32]:
    """Linear interpolation along one axis (the field is smooth on the scale of a voxel)."""
    lower = np.minimum(np.floor(where).astype(int), field.shape[axis] - 2)
    weight = (where - lower).astype(np.float32).reshape([-1 if a == axis else 1 for a in range(3)])
    return np.take(field, lower, axis=axis) * (1 - weight) + np.take(field, lower + 1, axis=axis) * weight


def isosurface(field: Image, level: float, largest: bool = True) -> Surface:
    """The closed surface field = level (flying edges), normals out; by default its largest part only."""
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    from lacli.geometry import curves as paths

    grid = _vtk_image(field)
    flying = vtk.vtkFlyingEdges3D()
    flying.SetInputData(grid)
    flying.SetValue(0, level)
    flying.ComputeNormalsOff()
    flying.ComputeGradientsOff()
    flying.ComputeScalarsOff()
    flying.Update()
    out = flying.GetOutput()
    if out.GetNumberOfCells() == 0:
        raise AnatomyError("the smoothed label has no surface; is the structure thinner than the voxels?")
    index = vtk_to_numpy(out.GetPoints().GetData()).astype(float)
    triangles = vtk_to_numpy(out.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    if largest:
        _, part = paths.triangle_components(triangles)
        triangles = triangles[part == np.argmax(np.bincount(part))]
    used, local = np.unique(triangles, return_inverse=True)
    triangles = local.reshape(-1, 3)
    surface = Surface(field.to_world(index[used]), triangles, np.zeros(len(triangles), dtype=np.int64))
    if surface.volume_ml() < 0:
        surface = Surface(surface.points, surface.triangles[:, ::-1].copy(), surface.label)
    return surface


def _vtk_image(field: Image) -> object:
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk

    grid = vtk.vtkImageData()
    grid.SetDimensions(*field.array.shape[::-1])
    grid.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(field.array, dtype=np.float32).ravel(), deep=True))
    return grid


def surface_of(mask: Image, sigma_mm: float | None = None, grid_mm: float | None = None) -> Surface:
    """Smooth closed surface with the volume of the mask's voxels (within 0.1 %).

    ``sigma_mm`` defaults to 1.25 times the coarsest spacing, ``grid_mm`` to the finest spacing (at least 0.4 mm).
    """
    sigma = 1.25 * float(mask.spacing.max()) if sigma_mm is None else sigma_mm
    grid = max(0.4, float(mask.spacing.min())) if grid_mm is None else grid_mm
    field = smooth_field(mask, sigma, grid)
    target = float(mask.array.sum()) * mask.voxel_ml
    level, step = 0.5, 0.02
    surface = isosurface(field, level)
    volume = surface.volume_ml()
    for _ in range(4):  # secant steps on the level; the volume is nearly linear in it
        if abs(volume / target - 1.0) < 1e-3:
            break
        other = isosurface(field, level + step).volume_ml()
        slope = (other - volume) / step
        if slope >= 0:
            break
        level = float(np.clip(level + (target - volume) / slope, 0.2, 0.8))
        surface = isosurface(field, level)
        volume = surface.volume_ml()
    return surface
