"""HU of blood and of myocardium: mean and standard deviation, sampled where it is surely the one or the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import AnatomyError

SPREAD = 3.0  # standard deviations of a tissue's range about its mean
LEAST_VOXELS = 200
EROSIONS_MM = (3.0, 2.5, 2.0, 1.5, 1.0)  # the deepest that leaves enough voxels is taken
LEAST_CONTRAST_HU = 60.0


@dataclass(frozen=True)
class Tissue:
    """HU of a tissue: mean, sd of single voxels, how many were sampled, and where, in words."""

    mean: float
    sd: float
    voxels: int
    where: str

    @property
    def low(self) -> float:
        """Mean less SPREAD standard deviations, HU."""
        return self.mean - SPREAD * self.sd

    @property
    def high(self) -> float:
        """Mean plus SPREAD standard deviations, HU."""
        return self.mean + SPREAD * self.sd


def in_label(ct: Image, mask: BoolArray, name: str) -> Tissue:
    """The tissue in a label's voxels, as far from its border as leaves LEAST_VOXELS of them.

    Raises AnatomyError where the label is too thin: its voxels would be mixtures with what lies beside them.
    """
    depth = ndimage.distance_transform_edt(mask, sampling=ct.spacing[::-1])
    for erosion in EROSIONS_MM:
        core = depth > erosion
        if int(core.sum()) >= LEAST_VOXELS:
            return _sampled(ct.array[core], f"{name}, {erosion:g} mm from its border")
    raise AnatomyError(
        f"{name} is nowhere thick enough to sample: fewer than {LEAST_VOXELS} voxels lie {EROSIONS_MM[-1]:g} mm from its border. "
        "Give a box of the tissue, or a label of thicker muscle (the left ventricle's)."
    )


def in_box(ct: Image, box_mm: FloatArray, name: str) -> Tissue:
    """The tissue in a box with sides along x, y, z: ``box_mm`` (3, 2) lowest and highest, mm (LPS).

    Raises AnatomyError where the box is not inside of the image, or holds fewer than LEAST_VOXELS voxels.
    """
    corners = np.array(np.meshgrid(*box_mm)).reshape(3, -1).T
    index = ct.to_index(corners)
    low, high = np.floor(index.min(axis=0)).astype(int), np.ceil(index.max(axis=0)).astype(int) + 1
    size = np.array(ct.array.shape[::-1])
    if np.any(low < 0) or np.any(high > size):
        raise AnatomyError(f"{name} reaches out of the image; give x, y, z in mm (LPS), inside of it.")
    grid = np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij")
    voxel = np.stack([g.ravel() for g in grid], axis=1)
    world = ct.to_world(voxel)
    voxel = voxel[((world >= box_mm[:, 0]) & (world <= box_mm[:, 1])).all(axis=1)]
    if len(voxel) < LEAST_VOXELS:
        raise AnatomyError(f"{name} holds {len(voxel)} voxels; at least {LEAST_VOXELS} are needed. Make it larger.")
    return _sampled(ct.array[voxel[:, 2], voxel[:, 1], voxel[:, 0]], name)


def _sampled(values: FloatArray, where: str) -> Tissue:
    values = np.asarray(values, dtype=np.float64)
    return Tissue(float(values.mean()), float(values.std(ddof=1)), len(values), where)


def check(blood: Tissue, muscle: Tissue) -> list[str]:
    """What a user must know of the two, in words.

    Raises AnatomyError where blood is not LEAST_CONTRAST_HU brighter than the wall, or the values are no Hounsfield units.
    """
    both = f"blood {blood.mean:.0f} +- {blood.sd:.0f} HU ({blood.where}), myocardium {muscle.mean:.0f} +- {muscle.sd:.0f} HU"
    both += f" ({muscle.where})"
    if blood.sd == 0.0 and muscle.sd == 0.0:
        raise AnatomyError(f"the CT has no noise at all: {both}. Is it a label map? Give the CT volume in Hounsfield units.")
    if blood.mean < muscle.mean + LEAST_CONTRAST_HU:
        what = "blood is darker than the wall" if blood.mean < muscle.mean else "blood hardly differs from the wall"
        raise AnatomyError(
            f"{what}: {both}. The CT must be contrast-enhanced, at least {LEAST_CONTRAST_HU:.0f} HU between the two; are the "
            "labels the right ones?"
        )
    if not -30.0 <= muscle.mean <= 250.0:
        raise AnatomyError(
            f"what is sampled as myocardium is none: {both}. Muscle is at about 100 HU; give another label or box."
        )
    if blood.low < muscle.high:
        return [
            f"the ranges of blood and myocardium overlap at 3 sd ({both}): between their means a voxel is what it is nearer to, "
            "and the label map is rougher than with less noise"
        ]
    return []


def edge(blood: Tissue, muscle: Tissue) -> float:
    """HU half way between the means: a voxel at the border of the two that is brighter is more blood than wall."""
    return 0.5 * (blood.mean + muscle.mean)
