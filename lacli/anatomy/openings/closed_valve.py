"""A mitral valve that is closed in the file: the veins' names from all the places where it may be, and the likeliest of these.

Where the valve is decides left and right, so no single guess of it may. The atrium's body is sampled; at each place the veins
are named as if the valve were there, and the readings of all places together give the names and the confidence in them. The
place itself stays a guess: over ten public atria it scatters by 6 - 9 mm about its mean in the veins' own frame, and the body
is as flat elsewhere as where a valve was closed (benchmarks/closed_valve.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lacli.anatomy.openings import naming
from lacli.anatomy.openings.candidate import GUESS, Candidate
from lacli.anatomy.openings.landmarks import Axes
from lacli.anatomy.openings.ostium import across
from lacli.base.arrays import FloatArray
from lacli.geometry.surface import Surface

PLACES = 30
APART_MM = 6.0  # least distance of two places
CLEAR_MM = 12.0  # of a vessel's ostium
VALVE_MM = 30.0  # diameter of the valve at each place
# mean and sd, mm, from the veins' mean: to the left, to the back, upward; ten public atria
PLACE = ((12.7, -34.3, -8.1), (5.6, 8.3, 9.3))
FLAT_WITHIN = 4.0  # nats: a flat patch at a place that likely is the valve


def places(surface: Surface, vessels: Sequence[Candidate], most: int = PLACES, apart_mm: float = APART_MM) -> list[Candidate]:
    """Where the valve may be: points spread over the body, clear of the vessels, farthest apart first, ``most`` at most."""
    points = surface.points
    free = np.ones(len(points), dtype=bool)
    for vessel in vessels:
        step = points - vessel.centre
        along = step @ vessel.direction
        beside = np.linalg.norm(step - along[:, None] * vessel.direction, axis=1)
        free &= np.linalg.norm(step, axis=1) > CLEAR_MM
        free &= (along < 0) | (along > max(vessel.length_mm, 5.0) + 3.0) | (beside > 1.2 * vessel.diameter_mm)
    choice = np.flatnonzero(free)
    if len(choice) == 0:
        return []
    picked = [int(choice[np.argmax(np.linalg.norm(points[choice] - points.mean(axis=0), axis=1))])]
    gap = np.full(len(choice), np.inf)
    while len(picked) < most:
        gap = np.minimum(gap, np.linalg.norm(points[choice] - points[picked[-1]], axis=1))
        if gap.max() < apart_mm:
            break
        picked.append(int(choice[gap.argmax()]))
    normals = np.zeros_like(points)
    for k in range(3):
        np.add.at(normals, surface.triangles[:, k], surface.area_vectors())
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return [_valve(points[i], normals[i]) for i in picked]


def _valve(centre: FloatArray, normal: FloatArray) -> Candidate:
    area = np.pi * VALVE_MM**2 / 4
    return Candidate(centre, normal, area, GUESS, across(normal) * VALVE_MM / 2, said="mv")


def name(
    surface: Surface, vessels: Sequence[Candidate], flat: Candidate, axes: Axes | None
) -> tuple[naming.Naming | None, Candidate]:
    """Names for ``vessels`` and a valve after them, and that valve: ``flat`` (of mitral_from_shape) where its place fits.

    The confidence is the share of the likelihood, summed over the valve's places, of the vessels' names.
    """
    tried = [replace(flat, said="mv"), *places(surface, vessels)]
    found: list[tuple[float, int, naming.Reading]] = []
    for k, valve in enumerate(tried):
        one = naming.assign([*vessels, valve], axes)
        if one is not None:
            found += [(reading.cost, k, reading) for reading in (one.best, one.second) if reading is not None]
    if not found:
        return None, flat
    groups: dict[object, list[tuple[float, int, naming.Reading]]] = {}
    for row in found:
        groups.setdefault(_key(row[2]), []).append(row)
    least = min(cost for cost, _, _ in found)
    weight = {key: sum(float(np.exp(least - cost)) for cost, _, _ in rows) for key, rows in groups.items()}
    best, *others = sorted(groups, key=lambda key: -weight[key])
    chosen = min(groups[best], key=lambda row: row[0] + unlikely(row[2], vessels, tried[row[1]]))
    for row in groups[best]:
        if row[1] == 0 and unlikely(row[2], vessels, flat) < FLAT_WITHIN:
            chosen = row
    second = min(groups[others[0]], key=lambda row: row[0])[2] if others else None
    return naming.Naming(chosen[2], second, weight[best] / sum(weight.values())), tried[chosen[1]]


def _key(reading: naming.Reading) -> object:
    return (tuple(sorted((n, i) for n, i in reading.names.items() if n in naming.VEINS)), reading.trunk, reading.missing)


def unlikely(reading: naming.Reading, vessels: Sequence[Candidate], valve: Candidate) -> float:
    """Nats by which the valve's place is off its mean in the frame of the veins that the reading names."""
    if reading.missing or reading.trunk is not None:
        return 0.0
    rs, ri, ls, li = (vessels[reading.names[n]].centre for n in naming.VEINS)
    left = (ls + li) / 2 - (rs + ri) / 2
    left = left / max(float(np.linalg.norm(left)), 1e-9)
    up = (rs - ri) + (ls - li)
    up = up - (up @ left) * left
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    back = np.cross(up, left) * (-1.0 if reading.mirrored else 1.0)
    step = valve.centre - (rs + ri + ls + li) / 4
    at = np.array([step @ left, step @ back, step @ up])
    return float(0.5 * (((at - PLACE[0]) / np.array(PLACE[1])) ** 2).sum())
