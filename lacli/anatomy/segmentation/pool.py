"""The blood pool from a rough label and the CT: as bright as blood, one part, without holes, cropped at the valve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.extraction import check_volume
from lacli.anatomy.inputs.image import Image
from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import AnatomyError

REACH_MM = 2.5  # how far the pool may lie outside of the rough label, and the rough label outside of the pool's brightness


@dataclass(frozen=True)
class Crop:
    """Where the atrium ends at the mitral valve: a plane (centre, normal towards the ventricle) or a sphere (centre, radius).

    centre (3,), radius: mm; what is past the plane within PLANE_REACH_MM of its centre, or in the sphere, is no atrium.
    """

    centre: FloatArray
    normal: FloatArray | None = None
    radius: float = 0.0

    def beyond(self, points: FloatArray) -> BoolArray:
        """Whether points (n, 3) mm are past the valve."""
        relative = points - self.centre
        if self.normal is None:
            return np.asarray(np.linalg.norm(relative, axis=1) < self.radius)
        way = self.normal / np.linalg.norm(self.normal)
        return np.asarray((relative @ way > 0) & (np.linalg.norm(relative, axis=1) < PLANE_REACH_MM))


PLANE_REACH_MM = 45.0


def cleaned(ct: Image, smooth: FloatArray, rough: BoolArray, other: BoolArray, edge_hu: float, crop: Crop | None) -> BoolArray:
    """The pool's voxels (nk, nj, ni).

    smooth: HU after the median filter; rough: the rough label; other: labels that are another cavity's (the ventricle's);
    edge_hu: least HU of a voxel at the border. Deep inside the rough label, where papillary muscle or noise may be dark, a voxel
    is the pool's whatever its HU. Raises AnatomyError where too little or too much is left for an atrium.
    """
    sampling = ct.spacing[::-1]
    outward = ndimage.distance_transform_edt(~rough, sampling=sampling)
    inward = ndimage.distance_transform_edt(rough, sampling=sampling)
    pool = (smooth > edge_hu) & (outward <= REACH_MM) & (inward <= REACH_MM) | (inward > REACH_MM)
    if other.any():
        pool &= ~other & (ndimage.distance_transform_edt(~other, sampling=sampling) >= outward)
    if crop is not None:
        voxel = np.argwhere(pool)
        past = crop.beyond(ct.to_world(voxel[:, ::-1]))
        pool[tuple(voxel[past].T)] = False
        if not pool.any():
            raise AnatomyError(
                "the valve's plane or sphere leaves nothing of the atrium; does its normal point to the ventricle?"
            )
    # what hangs on by a voxel or two is a neighbour's blood that shines through, not the atrium
    pool = largest(ndimage.binary_opening(pool, ndimage.generate_binary_structure(3, 1)))
    pool = ndimage.binary_fill_holes(pool)
    check_volume(float(pool.sum()) * ct.voxel_ml, "the blood pool")
    return np.asarray(pool)


def largest(mask: BoolArray) -> BoolArray:
    """The largest connected part of a mask; the mask itself where it is empty."""
    parts, count = ndimage.label(mask)
    return mask if count < 2 else np.asarray(parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:])))
