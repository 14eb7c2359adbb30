"""The road from a contrast-enhanced CT and a rough label map to blood pool, wall and fat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.extraction import surface_of
from lacli.anatomy.inputs.image import Image
from lacli.anatomy.segmentation import intensities, labelmap, wall
from lacli.anatomy.segmentation.intensities import Tissue
from lacli.anatomy.segmentation.labelmap import Numbers
from lacli.anatomy.segmentation.pool import Crop, cleaned
from lacli.anatomy.segmentation.regional import RegionalThickness, regional
from lacli.anatomy.segmentation.wall import Wall
from lacli.anatomy.wall.fitting import check_bundle
from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle

AROUND_MM = 14.0  # of the image around the rough label that is looked at
SURFACE_MM = 1.3  # between points at which the wall is measured
VOXEL_MM = 0.4
LEAST_OVERLAP = 0.7  # share of the rough label's inside that must be as bright as blood


@dataclass(frozen=True)
class Options:
    """Choices of a segmentation.

    la, muscle, lv: labels of the rough map (blood of the atrium, myocardium to sample, blood of the ventricle); blood_box,
    muscle_box (3, 2) mm: sampled in place of labels; crop: where the valve is; voxel_mm: of the map that is made; wall, fat:
    their labels there, None: the first that are free."""

    la: int
    muscle: int | None = None
    lv: int | None = None
    blood_box: FloatArray | None = None
    muscle_box: FloatArray | None = None
    crop: Crop | None = None
    voxel_mm: float = VOXEL_MM
    wall: int | None = None
    fat: int | None = None


@dataclass(frozen=True)
class Segmented:
    """A segmented CT.

    labels: the map; numbers: what its labels are; thickness: whole wall, then regions; wall: measured point by point; blood,
    muscle: HU as sampled; notes in words."""

    labels: Image
    numbers: Numbers
    thickness: tuple[RegionalThickness, ...]
    wall: Wall
    blood: Tissue
    muscle: Tissue
    notes: tuple[str, ...]

    def volume_ml(self, label: int) -> float:
        """Volume of a label in the map, mL."""
        return float((self.labels.array == label).sum()) * self.labels.voxel_ml


def segment(ct: Image, rough: Image, options: Options, bundle: Bundle | None = None,
            say: Callable[[str], None] = lambda _: None) -> Segmented:  # fmt: skip
    """Blood pool, wall and fat of a CT in HU, from a rough label map on the same grid.

    Blood's and myocardium's HU are sampled; the pool is what is more blood than wall about the rough label; the wall's thickness
    is that of a blurred slab along the pool's normals, in the CT as it is. Raises AnatomyError.
    """
    check_hounsfield(ct)
    check_grid(ct, rough)
    for label, what in (
        (options.la, "left atrium's blood"),
        (options.lv, "left ventricle's blood"),
        (options.muscle, "myocardium"),
    ):
        if label is not None and not (rough.array == label).any():
            raise AnatomyError(f"label {label} ({what}) has no voxel in the label map.")
    say("sampling blood and myocardium")
    blood, muscle = sampled(ct, rough, options)
    notes = [*intensities.check(blood, muscle), *rough.doubts(ct.to_world(0.5 * (np.array([ct.array.shape[::-1]]) - 1.0))[0])]
    ct, rough = cropped(ct, rough, options.la)
    say("cleaning the blood pool")
    smooth = ndimage.median_filter(ct.array.astype(np.float32), 3)
    la = rough.array == options.la
    check_overlap(smooth, la, blood, muscle)
    lv = None if options.lv is None else rough.array == options.lv
    other = np.zeros(la.shape, dtype=bool) if lv is None else lv
    pool = cleaned(ct, smooth, la, other, intensities.edge(blood, muscle), options.crop)
    say("measuring the wall")
    surface = surface_of(_padded(ct.with_array(pool)), None, SURFACE_MM)
    if bundle is not None:
        check_bundle(bundle, surface.points)
    measured = wall.measure(ct, surface, blood, muscle)
    thickness = regional(measured, bundle)
    notes += _notes(thickness)
    say("painting the label map")
    numbers = _numbers(rough, options)
    labels = labelmap.paint(ct, smooth, pool, lv, measured, numbers, options.voxel_mm)
    return Segmented(labels, numbers, thickness, measured, blood, muscle, tuple(notes))


def check_hounsfield(ct: Image) -> None:
    """AnatomyError where the image holds labels or no Hounsfield units."""
    few = np.unique(ct.array[:: max(1, ct.array.shape[0] // 16)])
    if len(few) <= 64 and np.all(few == np.round(few)) and few.min() >= 0:
        raise AnatomyError(
            f"the CT has only {len(few)} different values ({few.min():g} to {few.max():g}): a label map? Give the CT volume in "
            "Hounsfield units first, the label map with --labels."
        )
    low, high = float(ct.array.min()), float(ct.array.max())
    if low > -30.0 or high < 100.0:
        raise AnatomyError(
            f"the CT's values run from {low:g} to {high:g}: not Hounsfield units (fat is at about -100, contrast-filled blood "
            "above 200). Give the CT volume with its rescale intercept applied."
        )


def check_grid(ct: Image, rough: Image) -> None:
    """AnatomyError where the two have not the same voxels."""
    if ct.array.shape != rough.array.shape:
        a, b = (" x ".join(map(str, i.array.shape[::-1])) for i in (ct, rough))
        raise AnatomyError(f"CT and label map are of different size ({a} and {b} voxels); resample the labels to the CT's grid.")
    corner = np.array(ct.array.shape[::-1])[None] - 1.0
    apart = max(float(np.linalg.norm(ct.to_world(c) - rough.to_world(c))) for c in (np.zeros((1, 3)), corner))
    turned = float(np.abs(ct.direction - rough.direction).max())
    if apart > 0.5 * float(ct.spacing.min()) or turned > 1e-3:
        raise AnatomyError(
            f"CT and label map lie in different places: their corners are up to {apart:.3g} mm apart (origin, spacing or "
            "direction differ); resample the labels to the CT's grid, or correct the header."
        )


def check_overlap(smooth: FloatArray, la: BoolArray, blood: Tissue, muscle: Tissue) -> None:
    """AnatomyError where the rough label does not lie on blood."""
    share = float((smooth[la] > intensities.edge(blood, muscle)).mean())
    if share < LEAST_OVERLAP:
        raise AnatomyError(
            f"only {100 * share:.0f} % of the atrium's rough label is as bright as blood ({blood.mean:.0f} HU): the label map "
            "does not lie on this CT's atrium. Are they of the same patient, frame and axes?"
        )


def sampled(ct: Image, rough: Image, options: Options) -> tuple[Tissue, Tissue]:
    """Blood and myocardium, from the boxes where given, else from the labels."""
    if options.blood_box is not None:
        blood = intensities.in_box(ct, options.blood_box, "the blood's box")
    else:
        blood = _of_label(ct, rough, options.la, "the atrium's blood")
    if options.muscle_box is not None:
        return blood, intensities.in_box(ct, options.muscle_box, "the myocardium's box")
    if options.muscle is None:
        raise AnatomyError("no myocardium to sample: give its label (--myocardium, the left ventricle's will do) or a box of it.")
    return blood, _of_label(ct, rough, options.muscle, f"the myocardium (label {options.muscle})")


def _of_label(ct: Image, rough: Image, label: int, name: str) -> Tissue:
    ct, rough = cropped(ct, rough, label, 2.0)
    return intensities.in_label(ct, rough.array == label, name)


def cropped(ct: Image, rough: Image, label: int, margin_mm: float = AROUND_MM) -> tuple[Image, Image]:
    """Both images around a label's voxels."""
    where = np.argwhere(rough.array == label)[:, ::-1]
    margin = np.ceil(margin_mm / ct.spacing).astype(int)
    size = np.array(ct.array.shape[::-1])
    low, high = np.maximum(where.min(axis=0) - margin, 0), np.minimum(where.max(axis=0) + margin + 1, size)
    return ct.crop(low, high), rough.crop(low, high)


def _padded(mask: Image) -> Image:
    size = np.array(mask.array.shape[::-1])
    return mask.crop(np.full(3, -6), size + 6)


def _numbers(rough: Image, options: Options) -> Numbers:
    taken = {int(v) for v in np.unique(rough.array)} | {0, options.la, *(n for n in (options.wall, options.fat) if n is not None)}
    free = (n for n in range(1, 255) if n not in taken)
    wall_label = options.wall if options.wall is not None else next(free)
    fat_label = options.fat if options.fat is not None else next(free)
    if len({options.la, wall_label, fat_label, options.lv}) < 4:
        raise AnatomyError(
            f"labels of blood {options.la}, wall {wall_label}, fat {fat_label} and ventricle {options.lv} must differ."
        )
    return Numbers(options.la, wall_label, fat_label, options.lv)


def _notes(thickness: tuple[RegionalThickness, ...]) -> list[str]:
    notes = []
    for region in thickness:
        if region.touching > 0.02:
            notes.append(
                f"{region.name}: a neighbour touches on {100 * region.touching:.0f} % of the wall; there the thickness is that "
                f"of the surroundings, at most the bound (mean of the region at most {region.most_mm:.2f} mm)"
            )
        if region.unclear > 0.05:
            notes.append(f"{region.name}: no wall is seen on {100 * region.unclear:.0f} % of it; it was given its surroundings'")
        if region.doubtful:
            notes.append(f"{region.name}: so little is measured that the mean is a guess")
    return notes
