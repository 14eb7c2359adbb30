"""Tubes that leave a blood pool: veins and appendage, found from the pool's shape alone.

The pool is cut in shells of equal walking distance from its middle. Where a shell falls in parts, each part that goes on
outward is a branch; its area along the way tells where it leaves the body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from lacli.anatomy.inputs.image import Image
from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import AnatomyError

STEP_MM = 1.0
NECK_WINDOW_MM = 5.0
NECK_FACTOR = 1.5
BODY_WINDOW_MM = 15.0
BODY_FACTOR = 2.5
TIP_MM = 8.0  # the last shells are the rounded tip


@dataclass(frozen=True)
class Branch:
    """A tube: centreline (k, 3) mm from the body to the tip, area (k,) mm2 across it, distance (k,) mm from the middle.

    ostium: index into the centreline; tip (3,) mm; length_mm from ostium to tip.
    """

    centreline: FloatArray
    area: FloatArray
    distance: FloatArray
    ostium: int
    tip: FloatArray
    length_mm: float

    @property
    def centre(self) -> FloatArray:
        """Centre of the ostium (3,) mm."""
        return self.centreline[self.ostium]

    @property
    def axis(self) -> FloatArray:
        """Unit direction out of the body at the ostium (3,)."""
        after = self.centreline[self.ostium : self.ostium + 6]
        line = (after[-1] - self.centreline[max(0, self.ostium - 1)]) if len(after) > 1 else self.tip - self.centre
        if np.linalg.norm(line) < 1e-6:  # it turns back on itself there
            line = self.tip - self.centre
        return line / max(float(np.linalg.norm(line)), 1e-12)

    @property
    def diameter_mm(self) -> float:
        """Of the circle with the ostium's area."""
        return float(2.0 * np.sqrt(self.area[self.ostium] / np.pi))


@dataclass(frozen=True)
class Skeleton:
    """The pool's middle (3,) mm, its inscribed radius there, and its branches, longest first."""

    middle: FloatArray
    radius_mm: float
    branches: tuple[Branch, ...]


def find(field: Image, least_length_mm: float = 5.0) -> Skeleton:
    """Branches of the pool ``field > 0.5`` on an isotropic grid of about 1 mm. Raises AnatomyError where there is none."""
    inside = field.array > 0.5
    if not inside.any():
        raise AnatomyError("the surface encloses no volume (it is flat, or thinner than a millimetre): no left atrium's.")
    parts, count = ndimage.label(inside)
    if count > 1:
        inside = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    depth = ndimage.distance_transform_edt(inside) * field.spacing[0]
    middle = np.array(np.unravel_index(int(np.argmax(ndimage.gaussian_filter(depth, 2.0))), inside.shape))
    walked = _walking_distance(inside, middle, float(field.spacing[0]))
    branches = _branches(field, walked, least_length_mm, float(depth[tuple(middle)]))
    return Skeleton(field.to_world(middle[None, ::-1])[0], float(depth.max()), tuple(branches))


def _walking_distance(inside: BoolArray, start: NDArray[np.int64], spacing: float) -> FloatArray:
    """Shortest way inside the mask from ``start``, over the 26 neighbours, mm; NaN outside."""
    number = np.full(inside.shape, -1, dtype=np.int64)
    number[inside] = np.arange(int(inside.sum()))
    rows, columns, length = [], [], []
    for offset in np.ndindex(3, 3, 3):
        d = np.array(offset) - 1
        if tuple(d) <= (0, 0, 0):
            continue
        here = tuple(slice(max(0, -o), inside.shape[a] - max(0, o)) for a, o in enumerate(d))
        there = tuple(slice(max(0, o), inside.shape[a] - max(0, -o)) for a, o in enumerate(d))
        pair = (number[here] >= 0) & (number[there] >= 0)
        rows.append(number[here][pair])
        columns.append(number[there][pair])
        length.append(np.full(int(pair.sum()), spacing * float(np.sqrt((d**2).sum()))))
    size = int(inside.sum())
    graph = coo_matrix((np.concatenate(length), (np.concatenate(rows), np.concatenate(columns))), shape=(size, size)).tocsr()
    distance = dijkstra(graph, directed=False, indices=number[tuple(start)][None])[0]
    walked = np.full(inside.shape, np.nan)
    walked[inside] = distance
    return walked


@dataclass
class _Track:
    """A branch on its way from the tip inwards."""

    levels: list[float]
    areas: list[float]
    centres: list[FloatArray]
    tip: FloatArray
    alive: bool = True


def _branches(field: Image, walked: FloatArray, least_length: float, body: float) -> list[Branch]:
    farthest = float(np.nanmax(walked))
    filled = np.nan_to_num(walked, nan=-1.0)
    flat = np.flatnonzero(filled.ravel() >= 0)
    distance = filled.ravel()[flat]
    order = np.argsort(-distance)
    flat, distance = flat[order], distance[order]  # farthest first, so that a level is a prefix
    place = np.column_stack(np.unravel_index(flat, walked.shape)).astype(float)
    cell = float(np.prod(field.spacing))
    tracks: list[_Track] = []
    heads: list[tuple[int, int]] = []  # a voxel of every component of the level before, and the component's track
    done = 0
    for level in np.arange(farthest - STEP_MM, 0.0, -STEP_MM):
        label, count = ndimage.label(filled > level, structure=np.ones((3, 3, 3)))
        here = label.ravel()
        end = int(np.searchsorted(-distance, -level))
        mine = here[flat[done:end]]
        voxels = np.bincount(mine, minlength=count + 1)[1:]
        sums = np.column_stack([np.bincount(mine, weights=place[done:end, a], minlength=count + 1)[1:] for a in range(3)])
        centres = sums / np.maximum(voxels, 1)[:, None]
        children: dict[int, list[int]] = {}
        for voxel, track in heads:
            children.setdefault(int(here[voxel]), []).append(track)
        first = np.full(count + 1, -1, dtype=np.int64)
        first[here[flat[:end]][::-1]] = flat[:end][::-1]
        heads = []
        for k in range(1, count + 1):
            chosen = _continue(tracks, children.get(k, []), least_length)
            if chosen is None:
                tip = field.to_world(np.array(np.unravel_index(int(first[k]), walked.shape))[None, ::-1])[0]
                tracks.append(_Track([], [], [], tip))
                chosen = len(tracks) - 1
            heads.append((int(first[k]), chosen))
            if tracks[chosen].alive:
                tracks[chosen].levels.append(float(level))
                tracks[chosen].areas.append(float(voxels[k - 1]) * cell / STEP_MM)
                tracks[chosen].centres.append(centres[k - 1])
        done = end
    found = [branch for track in tracks if (branch := _finish(field, track, body)) is not None]
    return sorted((b for b in found if b.length_mm >= least_length), key=lambda b: -b.length_mm)


def _continue(tracks: list[_Track], inside: list[int], least_length: float) -> int | None:
    """The track that a component goes on with: the longest of those in it; two true branches end where they meet."""
    if not inside:
        return None
    true = [t for t in inside if tracks[t].alive and len(tracks[t].levels) * STEP_MM >= least_length]
    if len(true) > 1:
        for t in true:
            tracks[t].alive = False
    return max(inside, key=lambda t: len(tracks[t].levels))


def _finish(field: Image, track: _Track, body: float) -> Branch | None:
    """The branch of a track; its ostium is not within the ball of radius ``body`` (mm) that the pool's middle is in."""
    if len(track.levels) < 4:
        return None
    distance = np.array(track.levels[::-1])
    area = ndimage.uniform_filter1d(np.array(track.areas[::-1]), 3, mode="nearest")
    centre = field.to_world(np.array(track.centres[::-1])[:, ::-1])
    centre = ndimage.uniform_filter1d(centre, 3, axis=0, mode="nearest")
    for k in range(int(np.searchsorted(distance, body)), len(area) - 2):
        near = area[k : max(k + 1, min(k + int(NECK_WINDOW_MM / STEP_MM), len(area) - 3))]
        far = area[k : max(k + 1, min(k + int(BODY_WINDOW_MM / STEP_MM), len(area) - int(TIP_MM / STEP_MM)))]
        if area[k] <= NECK_FACTOR * near.min() and area[k] <= BODY_FACTOR * far.min():
            return Branch(centre, area, distance, k, track.tip, float(distance[-1] - distance[k]))
    return None
