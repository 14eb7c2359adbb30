"""The wall around the blood pool: place of the endocardium, thickness along its normal, and where a neighbour forbids to tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.segmentation import slab
from lacli.anatomy.segmentation.intensities import Tissue
from lacli.base.arrays import BoolArray, FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry.surface import Surface

PATCH_MM = 2.0  # profiles within it are averaged: noise goes, edges stay where the wall is smooth on that scale
SPREAD_MM = 1.5  # how far doubt is carried along the surface: a patch has part of its neighbour's profile
NEIGHBOUR_SPREAD_MM = 2.5  # of a neighbour: where it lifts off, the wedge of fat is thinner than the blur at first
FILL_MM = 6.0  # standard deviation of the weights by which flagged places take the thickness of those around
MUSCLE_DOUBT_HU = 4.0  # the least that the wall's HU may differ from the sampled myocardium's, standard deviation
DOUBTED = 2000  # places at which these two doubts are tried
BLUR_DOUBT = 0.04  # relative standard deviation of the blur found

PAST_MM = 1.5  # beyond the wall's outside, where something darker must follow
MOST_ERROR_MM = 0.5  # by noise, at one place: above it the wall is not seen there
SEEN, NEIGHBOUR, UNCLEAR, OPEN = 0, 1, 2, 3
FLAGS = {
    SEEN: "measured",
    NEIGHBOUR: "a neighbour of the same or higher HU touches: an upper bound",
    UNCLEAR: "no wall is seen",
    OPEN: "blood goes on: valve, or a vein that was cut",
}


@dataclass(frozen=True)
class Wall:
    """surface: the endocardium; normal (n, 3) out of the pool; thickness (n,) mm, where flagged taken from the surroundings and
    at most ``bound``; bound (n,) mm: what a neighbour leaves at most, infinite where none touches; flag (n,) of FLAGS;
    error (n,) mm: standard deviation by noise; by_muscle, by_blur (n,) mm: change by one sd of the wall's HU and the blur;
    area (n,) mm2 of surface at a point; blur_mm: of the image, standard deviation along the normal."""

    surface: Surface
    normal: FloatArray
    thickness: FloatArray
    bound: FloatArray
    flag: IntArray
    error: FloatArray
    by_muscle: FloatArray
    by_blur: FloatArray
    area: FloatArray
    blur_mm: float
    profile_hu: float

    @property
    def measured(self) -> BoolArray:
        """Where the thickness is seen in the image (n,)."""
        return self.flag == SEEN


def measure(ct: Image, pool: Surface, blood: Tissue, muscle: Tissue) -> Wall:
    """Thickness of the wall at the pool surface's points, in the unfiltered CT.

    Raises AnatomyError where no wall is seen on most of the surface.
    """
    s = slab.places()
    normal = point_normals(pool)
    area = point_areas(pool)
    spline = ndimage.spline_filter(ct.array.astype(np.float32), order=3, output=np.float32)
    near = _patches(pool.points, normal, area)
    surface = pool
    for _ in range(2):  # move the surface onto the blood's edge, where it is blood's edge
        profiles = _mean(near, _profiles(ct, spline, surface.points, normal, s))
        found = slab.first_guess(s, profiles, blood.mean, muscle.mean)
        edge = np.where(np.abs(found.edge) < 1.8, found.edge, 0.0)
        surface = Surface(surface.points + _mean(near, edge)[:, None] * normal, surface.triangles, surface.label)
    profiles = _mean(near, _profiles(ct, spline, surface.points, normal, s))
    guess = slab.first_guess(s, profiles, blood.mean, muscle.mean)
    clear = (guess.outside < muscle.mean - 60.0) & (np.abs(guess.edge) < 1.0) & (guess.thickness < 5.0)
    if clear.mean() < 0.1:
        raise AnatomyError(
            f"a wall darker than blood with something darker still around it is seen on {100 * clear.mean():.0f} % of the pool's "
            f"surface only (wall {muscle.mean:.0f} HU, blood {blood.mean:.0f} HU): are CT and labels of the same frame?"
        )
    blur = slab.blur_of(s, profiles, guess, muscle.mean, clear)
    fitted = slab.fit(s, profiles, guess, muscle.mean, blur)
    noise = _noise(ct, near, blood, muscle)
    error = noise * np.sqrt(_correlation(ct, blur)) / fitted.slope
    flag = _flags(s, profiles, fitted, blood, muscle, blur, noise, error)
    flag = _spread(surface.points, flag)
    seen = flag == SEEN
    if seen.mean() < 0.05:
        raise AnatomyError("the wall's outside is seen on less than 5 % of the surface: all around is as bright as the wall.")
    surface = Surface(surface.points + np.where(seen | (flag == NEIGHBOUR), fitted.edge, 0.0)[:, None].clip(-1, 1) * normal,
                      surface.triangles, surface.label)  # fmt: skip
    bound = np.where(flag == NEIGHBOUR, _bound(s, profiles, fitted, muscle, error), np.inf)
    thickness = np.where(seen, fitted.thickness, np.minimum(_filled(surface.points, fitted.thickness, seen), bound))
    doubted = np.flatnonzero(seen)[:: max(1, int(seen.sum()) // DOUBTED)]
    part = fitted.take(doubted)
    by_muscle = slab.fit(s, profiles[doubted], part, muscle.mean + MUSCLE_DOUBT_HU, blur).thickness - part.thickness
    by_blur = slab.fit(s, profiles[doubted], part, muscle.mean, blur * (1.0 + BLUR_DOUBT)).thickness - part.thickness
    _, near_doubted = cKDTree(surface.points[doubted]).query(surface.points)
    return Wall(surface, normal, thickness, bound, flag, np.where(seen, error, np.nan), by_muscle[near_doubted],
                by_blur[near_doubted], area, blur, muscle.mean)  # fmt: skip


def point_normals(surface: Surface) -> FloatArray:
    """Unit normals (n, 3) at the points, by area."""
    total = np.zeros((len(surface.points), 3))
    for k in range(3):
        np.add.at(total, surface.triangles[:, k], surface.area_vectors())
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def point_areas(surface: Surface) -> FloatArray:
    """A third of the area (n,) mm2 of the triangles at each point."""
    third = np.repeat(surface.areas() / 3.0, 3)
    return np.bincount(surface.triangles.ravel(), third, minlength=len(surface.points)).astype(np.float64)


def _profiles(ct: Image, spline: FloatArray, points: FloatArray, normal: FloatArray, s: FloatArray) -> FloatArray:
    """HU (n, m) at s along the normals, cubic between voxels."""
    out = np.empty((len(points), len(s)), dtype=np.float32)
    for j, away in enumerate(s):
        index = ct.to_index(points + away * normal)[:, ::-1].T
        ndimage.map_coordinates(spline, index, output=out[:, j], order=3, mode="nearest", prefilter=False)
    return out.astype(np.float64)


def _patches(points: FloatArray, normal: FloatArray, area: FloatArray) -> csr_matrix:
    """Averages over the points within PATCH_MM whose normals are alike: rows sum to 1, weights fall to the patch's edge."""
    pairs = cKDTree(points).query_pairs(PATCH_MM, output_type="ndarray")
    pairs = pairs[np.einsum("ij,ij->i", normal[pairs[:, 0]], normal[pairs[:, 1]]) > 0.7]
    n = len(points)
    row = np.concatenate([pairs[:, 0], pairs[:, 1], np.arange(n)])
    column = np.concatenate([pairs[:, 1], pairs[:, 0], np.arange(n)])
    away = np.linalg.norm(points[row] - points[column], axis=1)
    matrix = csr_matrix((area[column] * np.maximum(1.0 - (away / PATCH_MM) ** 2, 0.0) + 1e-9, (row, column)), shape=(n, n))
    total = np.asarray(matrix.sum(axis=1)).ravel()
    matrix.data /= np.repeat(total, np.diff(matrix.indptr))
    return matrix


def _mean(patches: csr_matrix, values: FloatArray) -> FloatArray:
    return np.asarray(patches @ values)


def _noise(ct: Image, patches: csr_matrix, blood: Tissue, muscle: Tissue) -> FloatArray:
    """Standard deviation (n,) HU of an averaged profile's samples: of single voxels, over the root of the voxels in the patch."""
    squares = patches.multiply(patches)
    share = np.asarray(squares.sum(axis=1)).ravel()  # 1 / number of points, were they independent
    points = 1.0 / share
    voxel = float(np.prod(ct.spacing)) ** (2.0 / 3.0)
    voxels = np.maximum(0.5 * np.pi * PATCH_MM**2 / voxel, 1.0)
    return np.asarray(max(blood.sd, muscle.sd) / np.sqrt(np.maximum(np.minimum(voxels, points), 1.0)))


def _correlation(ct: Image, blur: float) -> float:
    """How many samples of a profile share a voxel: their noise is one."""
    return max(1.0, float(np.cbrt(np.prod(ct.spacing))) / slab.STEP_MM)


def _flags(
    s: FloatArray, profiles: FloatArray, fitted: slab.Slabs, blood: Tissue, muscle: Tissue, blur: float, noise: FloatArray,
    error: FloatArray,
) -> IntArray:  # fmt: skip
    """What is at each point, of FLAGS (n,)."""
    # the muscle's own spread from place to place is a few HU; noise is that of the average
    tolerance = np.hypot(3.0 * noise, 8.0)
    end = fitted.edge + fitted.thickness
    past = (s >= (end + 0.5 * blur)[:, None]) & (s <= (end + PAST_MM)[:, None])
    outside = np.where(past, profiles, np.inf).min(axis=1)
    dip = np.where((s >= fitted.edge[:, None]) & (s <= (end + 0.5)[:, None]), profiles, np.inf).min(axis=1)
    first = np.where((s > -0.5) & (s < 2.5), profiles, np.inf).min(axis=1)
    flag = np.full(len(end), SEEN)
    no_step = outside > muscle.mean - np.maximum(tolerance, 25.0)  # what follows the wall is not darker than it
    flag[no_step | (fitted.outside > muscle.mean - tolerance) | (fitted.thickness >= slab.MOST_MM - 0.05)] = NEIGHBOUR
    poor = (error > MOST_ERROR_MM) | (fitted.misfit > np.maximum(4.0 * noise, 40.0)) | (np.abs(fitted.edge) > 1.5)
    none = (fitted.thickness <= slab.LEAST_MM + 0.02) | (dip > muscle.high)
    flag[(flag == SEEN) & (poor | none)] = UNCLEAR
    flag[first > 0.5 * (blood.mean + muscle.mean)] = OPEN
    return flag


def _spread(points: FloatArray, flag: IntArray) -> IntArray:
    """Doubt reaches along the surface; what is unclear beside a neighbour is the neighbour's doing."""
    out = flag.copy()
    reaches = (SPREAD_MM, NEIGHBOUR_SPREAD_MM, SPREAD_MM)
    for (kind, takes), far in zip(((UNCLEAR, (SEEN,)), (NEIGHBOUR, (SEEN, UNCLEAR)), (OPEN, (SEEN,))), reaches, strict=True):
        flagged, taken = np.flatnonzero(flag == kind), np.flatnonzero(np.isin(flag, takes))
        if len(flagged) and len(taken):
            reach, _ = cKDTree(points[flagged]).query(points[taken], distance_upper_bound=far)
            out[taken[np.isfinite(reach)]] = kind
    return out


def _bound(s: FloatArray, profiles: FloatArray, fitted: slab.Slabs, muscle: Tissue, error: FloatArray) -> FloatArray:
    """Most that the wall can be (n,) mm: to where the HU leaves the wall's for good, up or down, and three sd; or MOST_MM."""
    after = s >= (fitted.edge + 0.6)[:, None]
    dark = profiles < 0.5 * (muscle.mean + np.minimum(fitted.outside, muscle.mean - 60.0))[:, None]
    # the first dip's bottom, then up to half blood: the other cavity's edge
    lowest = np.where(after & (s <= (fitted.edge + 4.0)[:, None]), profiles, np.inf).argmin(axis=1)
    bright = (profiles > 0.5 * (muscle.mean + fitted.blood)[:, None]) & (s > s[lowest][:, None])
    ends = (dark & after) | bright
    at = np.where(ends.any(axis=1), s[ends.argmax(axis=1)] - fitted.edge, slab.MOST_MM)
    # noise may move a half-maximum inward as well as outward, and a bound must hold
    at = at + 3.0 * np.clip(error, 0.05, MOST_ERROR_MM)
    return np.asarray(np.clip(at, slab.LEAST_MM, slab.MOST_MM))


def _filled(points: FloatArray, thickness: FloatArray, seen: BoolArray) -> FloatArray:
    """At every point the mean of the measured around, weighted by a Gaussian of FILL_MM (n,) mm."""
    count = min(64, int(seen.sum()))
    every = np.flatnonzero(seen)[:: max(1, int(seen.sum()) // 4000)]
    away, index = cKDTree(points[every]).query(points, k=min(count, len(every)))
    away, index = away.reshape(len(points), -1), index.reshape(len(points), -1)
    weight = np.exp(-0.5 * ((away - away[:, :1]) / FILL_MM) ** 2) + 1e-12
    return np.asarray((weight * thickness[every][index]).sum(axis=1) / weight.sum(axis=1))
