"""Wall thickness per region with its error: whole wall, and regions of a bundle or the patient's six sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy.segmentation.wall import NEIGHBOUR, OPEN, PATCH_MM, UNCLEAR, Wall
from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, REGIONS

WHOLE = "whole"
SIDES = ("left", "right", "posterior", "anterior", "superior", "inferior")  # where the wall's normal points, LPS
DOUBTFUL = 0.2  # share of a region without a measurement from which on its mean is doubtful
BODY_MM = 4.0  # farther from a bundle's body is a vein, the appendage or another patient


@dataclass(frozen=True)
class RegionalThickness:
    """mean_mm: by area, flagged places as filled; sd_mm: of the mean, by noise, HU, blur and what was filled; area_cm2; touching,
    unclear: shares of the area where a neighbour touches or no wall is seen; most_mm: mean, were the wall as thick as its bound
    where a neighbour touches; spread_mm: sd of the thickness over the region."""

    name: str
    mean_mm: float
    sd_mm: float
    spread_mm: float
    area_cm2: float
    touching: float
    unclear: float
    most_mm: float

    @property
    def doubtful(self) -> bool:
        """Whether so much of the region is not measured that its mean is a guess."""
        return self.touching + self.unclear > DOUBTFUL


def regional(wall: Wall, bundle: Bundle | None = None) -> tuple[RegionalThickness, ...]:
    """The whole wall first, then the regions that have any area."""
    name = sides(wall.normal) if bundle is None else of_bundle(bundle, wall.surface.points)
    names = SIDES if bundle is None else tuple(REGIONS)
    here = wall.flag != OPEN
    found = [_region(WHOLE, wall, here)]
    for number, word in enumerate(names, start=1):
        mine = here & (name == number)
        if wall.area[mine].sum() > 25.0:  # mm2
            found.append(_region(word, wall, mine))
    return tuple(found)


def sides(normal: FloatArray) -> IntArray:
    """Number (n,) from 1 on of the side of SIDES to which each normal (n, 3) points most."""
    axis = np.argmax(np.abs(normal), axis=1)
    positive = normal[np.arange(len(normal)), axis] > 0
    return np.array([[2, 1], [4, 3], [6, 5]])[axis, positive.astype(int)]


def of_bundle(bundle: Bundle, points: FloatArray) -> IntArray:
    """Region's number (n,) of the nearest face of a bundle's endocardium; 0 farther than BODY_MM from the body's faces."""
    from lacli.anatomy.coordinates.describe import cell_label

    endo = bundle.triangles[bundle.tags == ENDO, :3]
    label = cell_label(bundle, endo)
    away, nearest = cKDTree(bundle.points[endo].mean(axis=1)).query(points)
    found = label[nearest]
    return np.where((away <= BODY_MM + np.sqrt(_largest(bundle, endo))) & np.isin(found, list(REGIONS.values())), found, 0)


def _largest(bundle: Bundle, faces: IntArray) -> float:
    a, b, c = (bundle.points[faces[:, i]] for i in range(3))
    return float(np.median(np.linalg.norm(np.cross(b - a, c - a), axis=1)))


def _region(name: str, wall: Wall, mine: BoolArray) -> RegionalThickness:
    area = wall.area[mine] / wall.area[mine].sum()
    flag, thickness = wall.flag[mine], wall.thickness[mine]
    seen = wall.measured[mine]
    mean = float(area @ thickness)
    spread = float(np.sqrt(area @ (thickness - mean) ** 2))
    share = float(area[seen].sum())
    patches = max(float(wall.area[mine][seen].sum()) / (np.pi * PATCH_MM**2), 1.0)
    noise = float(np.sqrt(np.nanmean(wall.error[mine][seen] ** 2) / patches)) if seen.any() else 0.0
    muscle = abs(float(area @ wall.by_muscle[mine]))
    blur = abs(float(area @ wall.by_blur[mine]))
    filled = (1.0 - share) * max(spread, 0.5)
    most = float(area @ np.where(flag == NEIGHBOUR, wall.bound[mine], thickness))
    sd = float(np.sqrt(noise**2 + muscle**2 + blur**2 + filled**2))
    touching, unclear = (float(area[flag == kind].sum()) for kind in (NEIGHBOUR, UNCLEAR))
    return RegionalThickness(name, mean, sd, spread, float(wall.area[mine].sum()) / 100.0, touching, unclear, most)
