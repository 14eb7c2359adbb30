"""What may be an opening, wherever it was seen: a rim, a flat cap, a labelled patch, a branch, the ventricle's contact."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lacli.base.arrays import FloatArray

RIM, CAP, PATCH, BRANCH, CONTACT, GIVEN = "open rim", "flat cap", "labelled patch", "branch", "ventricle contact", "given"
GUESS = "shape alone"  # a closed valve: the largest flat patch, or the side opposite the veins
VEIN = "vein"  # said of a candidate that is some vein, its side and height unknown


@dataclass(frozen=True)
class Candidate:
    """One place where the atrium may open.

    centre (3,) mm; direction (3,) unit, out of the atrium; area_mm2 across it; source: one of the kinds above; half_axis (3,) mm:
    half of its longest diameter; length_mm: how far a vessel goes on inside the file past its ostium; tip (3,) mm: the far end;
    cap: label of its triangles on the closed surface, 0 if it has none; said: by the input, an opening's name, VEIN, or "".
    """

    centre: FloatArray
    direction: FloatArray
    area_mm2: float
    source: str
    half_axis: FloatArray
    length_mm: float = 0.0
    tip: FloatArray | None = None
    cap: int = 0
    said: str = ""

    @property
    def diameter_mm(self) -> float:
        """Of the circle of its area."""
        return float(2.0 * np.sqrt(self.area_mm2 / np.pi))

    @property
    def elongation(self) -> float:
        """Longest diameter over that of the circle of its area, at least 1."""
        return max(1.0, 2.0 * float(np.linalg.norm(self.half_axis)) / max(self.diameter_mm, 1e-9))

    def words(self) -> str:
        """Kind, size and place, for messages."""
        return f"{self.source}, {self.diameter_mm:.0f} mm wide at {place(self.centre)}"


def place(point: FloatArray) -> str:
    """A point (3,) for messages."""
    return "(" + ", ".join(f"{x:.0f}" for x in point) + ") mm"


def of_ring(ring: FloatArray, outward: FloatArray, source: str, **more: object) -> Candidate:
    """From an ordered closed curve (k, 3) mm; ``outward`` (3,) chooses the side that its normal points to."""
    centre = centroid(ring)
    vector = area_vector(ring)
    size = float(np.linalg.norm(vector))
    direction = vector / max(size, 1e-12)
    direction = direction if direction @ outward >= 0 else -direction
    return Candidate(centre, direction, size, source, half_axis(ring, centre), **more)  # type: ignore[arg-type]


def area_vector(ring: FloatArray) -> FloatArray:
    """Normal times area (3,) mm2 of a closed curve (k, 3)."""
    x = ring - ring.mean(axis=0)
    return np.asarray(0.5 * np.cross(x, np.roll(x, -1, axis=0)).sum(axis=0))


def centroid(ring: FloatArray) -> FloatArray:
    """Mean (3,) of a closed curve (k, 3) along its length, whatever the spacing of its points."""
    after = np.roll(ring, -1, axis=0)
    length = np.linalg.norm(after - ring, axis=1)
    return np.asarray(((ring + after) / 2 * length[:, None]).sum(axis=0) / max(float(length.sum()), 1e-12))


def half_axis(ring: FloatArray, centre: FloatArray) -> FloatArray:
    """Half of the longest diameter (3,) mm of a closed curve (k, 3), along its main axis."""
    _, _, axes = np.linalg.svd(ring - centre, full_matrices=False)
    along = (ring - centre) @ axes[0]
    return np.asarray(0.5 * float(np.ptp(along)) * axes[0])


def halves(whole: Candidate, apart: float = 0.5) -> tuple[Candidate, Candidate]:
    """A common trunk's two veins: each at ``apart`` of the longest half diameter from its middle, with half of its area."""
    step = apart * whole.half_axis
    area = 0.5 * whole.area_mm2
    one = replace(whole, area_mm2=area, half_axis=0.5 * whole.half_axis)
    return replace(one, centre=whole.centre + step), replace(one, centre=whole.centre - step)
