"""Whether a CT, a blood pool and a bundle are of one patient and in one frame: what is measured of others looks like a result."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from lacli.anatomy.inputs.image import Image
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO
from lacli.geometry.surface import Surface

INSIDE_MM, OUTSIDE_MM = 2.5, 3.5  # of the pool's surface: blood, and what is darker
DARKER_HU = 30.0
CONTRAST_HU = 200.0  # above it is contrast-filled blood or bone
LEAST_CONTRAST = 0.1  # share of the pool's places that are as bright, from which on the CT has contrast
LEAST_STEP = 0.5  # share of the surface where blood is brighter than what is outside: by chance it is less
LEAST_COVERED, COVERED = 0.5, 0.98  # share of the surface within the image: less is refused; told
FARTHEST_MM = 5.0  # of a bundle's endocardium from the pool's surface, as a median


def check_pool(ct: Image, pool: Surface) -> list[str]:
    """What is to be told of how a blood pool lies in a CT (HU).

    Raises AnatomyError where half of it is outside, or the CT has contrast and the pool is not where the blood is. Without
    contrast blood is as bright as muscle, and nobody can tell.
    """
    middle, normal = pool.points[pool.triangles].mean(axis=1), pool.normals()
    index = ct.to_index(middle)
    inside = ((index >= 0) & (index <= np.array(ct.array.shape[::-1]) - 1)).all(axis=1)
    covered = float(inside.mean())
    if covered < LEAST_COVERED:
        raise AnatomyError(
            f"the CT does not cover the blood pool ({100 * covered:.0f} % of its surface): are they of the same patient, and in "
            "the same frame (LPS mm)?"
        )
    within, beyond = (_sample(ct, middle[inside] + away * normal[inside]) for away in (-INSIDE_MM, OUTSIDE_MM))
    bright = float((np.maximum(within, beyond) > CONTRAST_HU).mean())
    step = float((within > beyond + DARKER_HU).mean())
    if bright > LEAST_CONTRAST and step < LEAST_STEP:
        raise AnatomyError(
            f"only {100 * step:.0f} % of the blood pool's surface has blood inside and darker tissue outside: the pool does not "
            "lie on this CT's atrium. Are they of the same patient, and in the same frame (LPS mm)?"
        )
    if covered < COVERED:
        return [f"{100 * (1 - covered):.0f} % of the blood pool's surface lies outside the image: what is there is not measured"]
    return []


def check_bundle(bundle: Bundle, points: FloatArray) -> None:
    """AnatomyError where a bundle's endocardium does not lie at the blood pool's surface, of points (n, 3) mm."""
    endo = bundle.points[np.unique(bundle.triangles[bundle.tags == ENDO, :3])]
    away = float(np.median(cKDTree(points).query(endo)[0]))
    if away > FARTHEST_MM:
        raise AnatomyError(
            f"the bundle's endocardium lies {away:.0f} mm from the blood pool's surface (median): its regions are not of this "
            "atrium. Is it of the same patient, and in the same frame (LPS mm)?"
        )


def _sample(image: Image, points: FloatArray) -> FloatArray:
    """Values (n,) at points (n, 3) mm, linear between voxels; outside the image those of its border."""
    index = image.to_index(points)[:, ::-1].T
    return np.asarray(ndimage.map_coordinates(image.array, index, output=np.float64, order=1, mode="nearest"))
