"""The mitral annulus of a label map: where atrium and ventricle meet, and the atrium led on through it before it is smoothed.

A surface smoothed where the labels change is rounded off there: the annulus would come out narrower than it is, and a plane that
still cuts it in one curve lies below it. Led on as a tube by some voxels, the atrium has no edge there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings.landmarks import Opening
from lacli.anatomy.openings.ostium import across
from lacli.base.arrays import FloatArray

DEPTH = 4.0  # voxels that the tube is long: more than smoothing reaches
_SECTION = 1.0  # voxels below the annulus, where the tube's section is taken
_BESIDE = 0.75  # of the opening's diameter: what meets farther from its middle is not the valve
_MOST_SHIFT = 3.0  # voxels (and mm, whichever is more) from the plane that was found: farther it is another thing
_LEAST_SHARE = 0.5  # of the opening's area, on which the labels must touch: maps may leave room for leaflets
_SECTORS, _LEAST_SECTORS = 24, 18
_USUAL_MM = 30.0  # across a mitral annulus
_RIM = 2.0  # voxels: width of the border of where they meet


@dataclass(frozen=True)
class ValveTube:
    """The atrium led on beyond the plane of ``opening``, which lies in the border of where both labels meet; voxel_mm: the
    coarsest step of the map."""

    opening: Opening
    voxel_mm: float

    def led_on(self, mask: Image) -> Image:
        """The mask with the tube: what lies above the plane and has the mask's section right below it, DEPTH voxels deep."""
        depth = DEPTH * self.voxel_mm
        margin = np.ceil((depth + 2.0 * self.voxel_mm) / mask.spacing).astype(int)
        size = np.array(mask.array.shape[::-1])
        wide = mask.crop(-margin, size + margin)
        # only what is near: an array of places of a fine image's size fills memory
        reach = (np.hypot(_BESIDE * self.opening.diameter_mm, depth) + 2.0 * self.voxel_mm) / wide.spacing
        middle = wide.to_index(self.opening.centre[None])[0]
        first = np.clip(np.floor(middle - reach), 0, None).astype(int)
        last = np.minimum(np.ceil(middle + reach).astype(int) + 1, wide.array.shape[::-1])
        index = np.argwhere(np.ones(np.maximum(last - first, 0)[::-1], dtype=bool))[:, ::-1] + first
        step = wide.to_world(index.astype(float)) - self.opening.centre
        height = step @ self.opening.normal
        beside = np.linalg.norm(step - height[:, None] * self.opening.normal, axis=1)
        near = (height > -self.voxel_mm) & (height <= depth) & (beside < _BESIDE * self.opening.diameter_mm)
        below = step[near] - (height[near] + _SECTION * self.voxel_mm)[:, None] * self.opening.normal + self.opening.centre
        at = wide.to_index(below)[:, ::-1].T
        filled = ndimage.map_coordinates(wide.array.astype(np.float32), at, order=1) >= 0.5
        array = wide.array.astype(bool)
        array[tuple(index[near][filled][:, ::-1].T)] = True
        return wide.with_array(array)


def valve_tube(labels: Image, la: int, lv: int, opening: Opening, *, given: bool) -> ValveTube | None:
    """Of the mitral opening as it was found from the ventricle's contact, or as it was ``given`` (its plane stays there).

    None where the two labels do not touch over most of the opening and all around, or not near its plane.
    """
    voxel = float(labels.spacing.max())
    opening = replace(opening, diameter_mm=opening.diameter_mm or _USUAL_MM)  # one that is given may not say
    centre, area = _faces(labels, la, lv)
    step = centre - opening.centre
    height = step @ opening.normal
    beside = step - height[:, None] * opening.normal
    radius = np.linalg.norm(beside, axis=1)
    most = max(_MOST_SHIFT * voxel, _MOST_SHIFT)
    valve = (radius < _BESIDE * opening.diameter_mm) & (np.abs(height) < 2.0 * most)
    weight = np.abs(area[valve] @ opening.normal)
    if weight.sum() < _LEAST_SHARE * np.pi * opening.diameter_mm**2 / 4.0:
        return None
    shift = _border_height(height[valve], beside[valve], weight, opening.normal, voxel)
    if shift is None or abs(shift) > most:
        return None
    moved = opening.centre if given else opening.centre + shift * opening.normal
    beyond = moved + 0.7 * DEPTH * voxel * opening.normal
    return ValveTube(replace(opening, centre=moved, beyond=beyond), voxel)


def _faces(labels: Image, la: int, lv: int) -> tuple[FloatArray, FloatArray]:
    """Centres (k, 3) mm and area vectors (k, 3) mm2 of the voxel faces between the two labels."""
    atrium, ventricle = labels.array == la, labels.array == lv
    centres, areas = [np.empty((0, 3))], [np.empty((0, 3))]
    for axis in range(3):
        one = [slice(None)] * 3
        two = [slice(None)] * 3
        one[2 - axis], two[2 - axis] = slice(None, -1), slice(1, None)
        lower, upper = tuple(one), tuple(two)
        meet = (atrium[lower] & ventricle[upper]) | (ventricle[lower] & atrium[upper])
        index = np.argwhere(meet)[:, ::-1].astype(float)
        index[:, axis] += 0.5
        size = float(np.prod(np.delete(labels.spacing, axis)))
        centres.append(labels.to_world(index))
        areas.append(np.broadcast_to(size * labels.direction[:, axis], index.shape))
    return np.concatenate(centres), np.concatenate(areas)


def _border_height(height: FloatArray, beside: FloatArray, weight: FloatArray, normal: FloatArray, voxel: float) -> float | None:
    """Mean height (mm) of the outermost faces in each direction about the normal; None where many directions have none."""
    one = across(normal)
    angle = np.arctan2(beside @ np.cross(normal, one), beside @ one)
    sector = np.minimum((angle + np.pi) / (2.0 * np.pi) * _SECTORS, _SECTORS - 1).astype(int)
    radius = np.linalg.norm(beside, axis=1)
    least = 0.5 * np.sqrt(float(weight.sum()) / np.pi)  # nearer to the middle no border is
    found = []
    for k in range(_SECTORS):
        mine = (sector == k) & (radius > least)
        if not mine.any():
            continue
        rim = mine & (radius > radius[mine].max() - _RIM * voxel)
        if weight[rim].sum() > 0.0:
            found.append(float(np.average(height[rim], weights=weight[rim])))
    return float(np.mean(found)) if len(found) >= _LEAST_SECTORS else None
