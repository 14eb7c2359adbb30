"""A parametric left atrium as an implicit function: body, four veins, appendage and mitral funnel, smoothly joined.

Axes: x to the patient's left, y posterior, z superior (LPS), mm. Everything follows from a seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lacli.anatomy.coordinates.frame import unit
from lacli.anatomy.cuts.cut import Cut
from lacli.anatomy.openings.ostium import area_and_middle, flare_end
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.labels import PLANES

COHORT_ML = (47.0, 135.0)
_FLAT = 0.3  # per mm: a field that rises by less is far from the surface, on an axis of the body or a vessel


@dataclass(frozen=True)
class Tube:
    """A tapered round tube from ``start`` to ``end`` (3,) mm, radii there mm; cut flat at ``cut_mm`` from the start."""

    start: FloatArray
    end: FloatArray
    radius_start: float
    radius_end: float
    cut_mm: float
    blend_mm: float

    @property
    def direction(self) -> FloatArray:
        """Unit vector from start to end."""
        return unit(self.end - self.start)

    def distance(self, points: FloatArray) -> FloatArray:
        """Distance (k,) mm to the tube, negative inside; exact up to the taper's slope."""
        axis = self.end - self.start
        t = np.clip((points - self.start) @ axis / (axis @ axis), 0.0, 1.0)
        away = np.linalg.norm(points - self.start - t[:, None] * axis, axis=1)
        return away - (self.radius_start + t * (self.radius_end - self.radius_start))


@dataclass(frozen=True)
class Shape:
    """A left atrium: body semi-axes (3,) mm, flattening exponent, surface waves, tubes by opening, lengths times ``scale``."""

    seed: int
    axes: FloatArray
    waves: FloatArray
    phases: FloatArray
    tubes: dict[str, Tube]
    scale: float = 1.0

    def implicit(self, points: FloatArray) -> FloatArray:
        """(k,) mm: about the distance to the cavity's surface, veins and appendage uncut, negative inside."""
        p = np.asarray(points, dtype=np.float64).reshape(-1, 3) / self.scale
        value = self._body(p)
        for tube in self.tubes.values():
            value = smooth_minimum(value, tube.distance(p), tube.blend_mm)
        return value * self.scale

    def distance(self, points: FloatArray) -> FloatArray:
        """(k,) mm: the distance to the cavity's surface, negative inside; within some 3 mm of it to .01 mm (root mean square).

        ``implicit`` rises by less than 1 per mm where parts are joined: over its slope half-way to the surface it is a distance.
        """
        p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        value = self.implicit(p)
        rise = self._gradient(p)
        half = p - (0.5 * value / np.maximum((rise**2).sum(axis=1), _FLAT))[:, None] * rise
        slope = np.linalg.norm(self._gradient(half), axis=1)
        return value / np.maximum(slope, _FLAT)

    def _gradient(self, points: FloatArray) -> FloatArray:
        """(k, 3) of ``implicit``, by central differences."""
        h = 0.05
        sides = [self.implicit(points + h * axis) - self.implicit(points - h * axis) for axis in np.eye(3)]
        return np.column_stack(sides) / (2.0 * h)

    def _body(self, p: FloatArray) -> FloatArray:
        # superellipsoid of exponent 2.4: rounded, a little boxy as an atrium between spine and aorta is
        e = 2.4
        q = np.abs(p / self.axes)
        norm = np.maximum((q**e).sum(axis=1) ** (1 / e), 1e-9)
        gradient = (q ** (e - 1)) / self.axes * norm[:, None] ** (1 - e)
        distance = (norm - 1.0) / np.maximum(np.linalg.norm(gradient, axis=1), 1e-9)
        distance = np.clip(distance, -40.0, 200.0)
        direction = unit(p)
        for amplitude, phase, wave in zip(self.phases[:, 0], self.phases[:, 1], self.waves, strict=True):
            distance = distance - amplitude * np.sin(direction @ wave + phase)
        return distance

    def cuts(self) -> list[Cut]:
        """The flat cut of each opening, mm."""
        result = []
        for name, tube in self.tubes.items():
            centre = (tube.start + tube.cut_mm * tube.direction) * self.scale
            radius = max(tube.radius_start, tube.radius_end)
            result.append(Cut(centre, tube.direction, 1.6 * radius * self.scale, PLANES[name]))
        return result

    def at_ostia(self, outside_mm: float = 2.5) -> Shape:
        """The shape with its veins and appendage cut ``outside_mm`` beyond their ostia as ostium.flare_end defines them.

        Exact sections across each tube's axis are taken; as drawn, the vessels are cut about 7 mm from the body wherever
        they flare.
        """
        step = 0.25

        def radius_at(centre: FloatArray, directions: FloatArray) -> FloatArray:
            return first_crossing(self.implicit, centre, directions)

        tubes = {}
        for name, tube in self.tubes.items():
            if name != "mv":
                length = float(np.linalg.norm(tube.end - tube.start)) * self.scale
                along = np.arange(length, 0.0, -step)
                places = tube.start * self.scale + along[:, None] * tube.direction
                radius = np.sqrt([area_and_middle(tube.direction, p, radius_at)[0] / np.pi for p in places])
                end = flare_end(radius, step)
                if end is None:
                    raise AnatomyError(f"The {name} of seed {self.seed} does not flare into the body.")
                tube = replace(tube, cut_mm=(length - step * end + outside_mm) / self.scale)
            tubes[name] = tube
        return replace(self, tubes=tubes)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Box (low, high), each (3,) mm, that holds the uncut surface with 4 mm to spare."""
        ends = np.array([[t.end - t.radius_end, t.end + t.radius_end] for t in self.tubes.values()]).reshape(-1, 3)
        reach = self.axes * 1.1
        low = np.minimum(-reach, ends.min(axis=0)) - 4.0
        high = np.maximum(reach, ends.max(axis=0)) + 4.0
        return low * self.scale, high * self.scale


def first_crossing(
    implicit: Callable[[FloatArray], FloatArray], centre: FloatArray, directions: FloatArray, reach_mm: float = 30.0
) -> FloatArray:
    """Distances (k,) mm from an inner ``centre`` along unit ``directions`` (k, 3) to the surface; ``reach_mm`` if farther."""
    steps = np.arange(0.0, reach_mm + 0.25, 0.5)
    at = centre + steps[None, :, None] * directions[:, None]
    value = implicit(at.reshape(-1, 3)).reshape(len(directions), -1)
    outside = value > 0
    after = np.where(outside.any(axis=1), outside.argmax(axis=1), len(steps) - 1)
    rows, before = np.arange(len(directions)), np.maximum(after - 1, 0)
    low, high = value[rows, before], value[rows, after]
    share = np.where(high > low, np.clip(-low / np.where(high > low, high - low, 1.0), 0.0, 1.0), 1.0)
    return steps[before] + share * (steps[after] - steps[before])


def smooth_minimum(a: FloatArray, b: FloatArray, width: float) -> FloatArray:
    """The smaller of two distances, rounded where they differ by less than ``width`` (cubic polynomial)."""
    h = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - h**3 * width / 6.0


def draw(seed: int) -> Shape:
    """The shape of a seed, at scale 1 (the body alone about 60 mL); every number from a stated range."""
    rng = np.random.default_rng([20260401, seed])

    def about(value: float, spread: float) -> float:
        return float(value + spread * rng.uniform(-1, 1))

    axes = np.array([about(28.0, 2.0), about(19.0, 1.5), about(23.5, 2.0)])

    def on_body(direction: FloatArray, share: float) -> FloatArray:
        d = unit(direction)
        return share * d / ((np.abs(d / axes) ** 2.4).sum()) ** (1 / 2.4)

    def tilt(direction: list[float], spread: float) -> FloatArray:
        return unit(np.array(direction) + spread * rng.uniform(-1, 1, 3))

    # where each vessel leaves the body, which way it points, radius at its ostium, how far out it is cut
    veins = {
        "rspv": ([-0.85, 0.10, 0.62], [-0.88, 0.05, 0.45], about(7.2, 0.8)),
        "ripv": ([-0.90, 0.42, -0.32], [-0.85, 0.50, -0.15], about(6.7, 0.8)),
        "lspv": ([0.74, 0.32, 0.72], [0.72, 0.30, 0.62], about(6.9, 0.8)),
        "lipv": ([0.82, 0.62, -0.22], [0.80, 0.62, -0.05], about(6.2, 0.7)),
        "appendage": ([0.86, -0.62, 0.34], [0.72, -0.62, 0.28], about(6.9, 0.8)),
    }
    tubes: dict[str, Tube] = {}
    mitral = tilt([0.30, -0.42, -0.86], 0.05)
    reach = float(np.linalg.norm(on_body(mitral, 1.0)))
    radius = about(15.5, 1.2)
    tubes["mv"] = Tube(0.35 * reach * mitral, (reach + 18.0) * mitral, radius * 1.05, radius, 0.65 * reach + about(4.5, 0.7), 7.0)
    for name, (place, way, size) in veins.items():
        ostium = on_body(tilt(place, 0.05), 0.96)
        direction = tilt(way, 0.08)
        start = ostium - 9.0 * direction
        tubes[name] = Tube(start, ostium + 24.0 * direction, size * 1.08, size * 0.9, 9.0 + about(7.0, 1.0), 8.0)
    waves = rng.normal(0, 1.6, (3, 3))
    phases = np.column_stack([rng.uniform(0.3, 0.9, 3), rng.uniform(0, 2 * np.pi, 3)])
    return Shape(seed, axes, waves, phases, tubes)


def cohort_volume(seed: int) -> float:
    """The seed's cavity volume in mL, uniform over the range of the published cohort."""
    return float(np.random.default_rng([20260402, seed]).uniform(*COHORT_ML))
