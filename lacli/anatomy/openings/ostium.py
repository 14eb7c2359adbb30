"""Where a vessel leaves the atrium: plane sections are followed along it to the place where its wall begins to flare.

The definition is one of shape alone, the same for a label map, an open surface and the parametric atrium: walking inward
along a vessel, the ostium is where the radius of its section (that of the circle of the same area) first grows by more than
tan(FLARE_DEG) per mm, that is, where its wall turns away from its axis by FLARE_DEG. Veins taper by less than 8 degrees.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lacli.anatomy.openings.branches import TIP_MM, Branch
from lacli.anatomy.openings.landmarks import Opening
from lacli.base.arrays import FloatArray

RadiusAt = Callable[[FloatArray, FloatArray], FloatArray]

FLARE_DEG = 15.0
WINDOW_MM = 2.0  # half the window over which the radius' slope is fitted
OUTSIDE_MM = 8.0  # the walk starts that far outside the shells' estimate
BODY_AREA = 2.5  # a section so many times the smallest is the body's
FARTHEST_MM = 30.0
STEP_MM = 0.5
MAX_TILT_DEG = 40.0
RAYS = 36
_ANGLES = np.linspace(0, 2 * np.pi, RAYS, endpoint=False)


@dataclass(frozen=True)
class Section:
    """A plane across a vessel: centre (3,) mm, unit normal (3,) out of the atrium, the area (mm2) seen from the centre."""

    centre: FloatArray
    normal: FloatArray
    area: float

    @property
    def radius_mm(self) -> float:
        """Of the circle with the section's area."""
        return float(np.sqrt(self.area / np.pi))


def flare_end(radius: FloatArray, step_mm: float) -> float | None:
    """Place of the ostium along radii (k,) mm taken every ``step_mm`` inward, as a fractional index; None: no flare.

    The slope is that of the line fitted over WINDOW_MM either side, less near the ends. The search starts where the vessel is
    most even, so that a rounded or ragged outer end is not taken for a flare, and goes inward.
    """
    slope = slopes(np.asarray(radius, dtype=np.float64), max(1, round(WINDOW_MM / step_mm)), step_mm)
    limit = np.tan(np.radians(FLARE_DEG))
    flaring = np.flatnonzero(slope > limit)
    if len(flaring) == 0:
        return None
    even = int(np.argmin(np.abs(slope[: int(flaring[-1]) + 1])))
    after = np.flatnonzero(slope[even:] > limit)
    k = even + int(after[0])
    if k == even:  # it flares from its outer end on
        return float(k)
    return float(k - 1 + (limit - slope[k - 1]) / (slope[k] - slope[k - 1]))


def slopes(values: FloatArray, half: int, step: float) -> FloatArray:
    """Slope (k,) of the lines fitted to up to ``half`` values either side; the outermost two are those next to them."""
    size = len(values)
    out = np.zeros(size)
    for i in range(1, size - 1):
        h = min(half, i, size - 1 - i)
        ramp = np.arange(-h, h + 1)
        out[i] = ramp @ values[i - h : i + h + 1] / (ramp @ ramp) / step
    if size > 2:
        out[0], out[-1] = out[1], out[-2]
    return out


def of_branch(name: str, branch: Branch, confidence: float, radius_at: RadiusAt, outside_mm: float = 0.0) -> Opening:
    """Cut across a branch ``outside_mm`` beyond its ostium (less where the branch is short), so that a ring fits on the vessel.

    ``radius_at(centre, directions)`` gives the wall's distance (k,) mm along unit directions (k, 3) from a point inside.
    """
    line = branch.centreline
    start = max(0, min(branch.ostium + round(OUTSIDE_MM), len(line) - 1 - round(TIP_MM) // 2))
    ahead = line[min(start + 3, len(line) - 1)] - line[max(0, start - 3)]
    length = float(np.linalg.norm(ahead))
    sections = inward(line[start], ahead / length if length > 1e-6 else branch.axis, radius_at)
    chosen = at_ostium(sections, outside_mm)
    return Opening(name, chosen.centre, chosen.normal, branch.tip, 2.0 * chosen.radius_mm, confidence, "shape")


def of_opening(opening: Opening, radius_at: RadiusAt, outside_mm: float = 0.0) -> Opening:
    """From an open vessel's rim inward to ``outside_mm`` beyond its ostium, the junction of vessel and atrium."""
    chosen = at_ostium(inward(opening.centre - 0.5 * opening.normal, opening.normal, radius_at), outside_mm)
    return replace(opening, centre=chosen.centre, normal=chosen.normal, diameter_mm=2.0 * chosen.radius_mm)


def inward(centre: FloatArray, axis: FloatArray, radius_at: RadiusAt) -> list[Section]:
    """Sections every STEP_MM from ``centre`` (3,) mm against ``axis`` (3,) until they are as wide as the body.

    Each is centred in the vessel and turned to its smallest area.
    """
    sections = [smallest(centre, axis, axis, radius_at)]
    for _ in range(round(FARTHEST_MM / STEP_MM)):
        last = sections[-1]
        section = smallest(last.centre - STEP_MM * last.normal, last.normal, axis, radius_at)
        sections.append(section)
        if section.area > BODY_AREA * min(s.area for s in sections):
            break
    return sections


def at_ostium(sections: list[Section], outside_mm: float) -> Section:
    """The section ``outside_mm`` beyond the ostium, or the outermost; without a flare the innermost counts as ostium."""
    end = flare_end(np.array([s.radius_mm for s in sections]), STEP_MM)
    where = max(0.0, (len(sections) - 1.0 if end is None else end) - outside_mm / STEP_MM)
    k = min(int(where), len(sections) - 2) if len(sections) > 1 else 0
    if len(sections) == 1:
        return sections[0]
    a, b, share = sections[k], sections[k + 1], where - k
    normal = (1 - share) * a.normal + share * b.normal
    return Section(
        (1 - share) * a.centre + share * b.centre, normal / np.linalg.norm(normal), (1 - share) * a.area + share * b.area
    )


def area_and_middle(normal: FloatArray, centre: FloatArray, radius_at: RadiusAt) -> tuple[float, FloatArray]:
    """Area (mm2) and centroid (3,) of the plane section that is seen from ``centre``."""
    e = across(normal)
    rays = np.cos(_ANGLES)[:, None] * e + np.sin(_ANGLES)[:, None] * np.cross(normal, e)
    r = radius_at(centre, rays)
    area = 0.5 * float(np.sum(r * np.roll(r, -1)) * np.sin(_ANGLES[1]))
    return area, centre + (rays * (r**3)[:, None]).sum(axis=0) / (1.5 * np.sum(r**2))


def across(normal: FloatArray) -> FloatArray:
    """A unit vector (3,) perpendicular to ``normal``."""
    e = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.8 else [0, 1.0, 0])
    size = float(np.linalg.norm(e))
    return np.asarray(e / size) if size > 1e-12 else np.array([1.0, 0.0, 0.0])  # of no direction: any will do


def smallest(centre: FloatArray, normal: FloatArray, axis: FloatArray, radius_at: RadiusAt) -> Section:
    """The plane near ``centre``, centred in the vessel and turned, in small steps within MAX_TILT_DEG of ``axis``, to its
    smallest section."""
    _, middle = area_and_middle(normal, centre, radius_at)
    centre = centre + (middle - centre) * min(1.0, 2.0 / max(float(np.linalg.norm(middle - centre)), 1e-9))
    area, _ = area_and_middle(normal, centre, radius_at)
    for step in np.radians([6.0, 3.0]):
        for _ in range(4):
            e = across(normal)
            f = np.cross(normal, e)
            trials = [normal + np.tan(step) * turn for turn in (e, -e, f, -f)]
            trials = [t / np.linalg.norm(t) for t in trials]
            trials = [t for t in trials if t @ axis > np.cos(np.radians(MAX_TILT_DEG))]
            areas = [area_and_middle(t, centre, radius_at)[0] for t in trials]
            if not areas or min(areas) > 0.995 * area:
                break
            area, normal = min(areas), trials[int(np.argmin(areas))]
    return Section(centre, normal, area)
