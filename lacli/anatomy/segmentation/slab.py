"""The blurred slab: HU along a normal through blood, wall and what lies outside, fitted by least squares.

    I(s) = B + (M - B) Phi((s - e) / w) + (O - M) Phi((s - e - t) / w)

with B, M, O the HU of blood, wall and outside, e the endocardium's place, t the thickness, w the blur's standard deviation, all
lengths in mm along the normal. A wall thinner than two or three voxels never shows its own HU: half-maximum widths are then too
large, counts of voxels larger still, but the slab's thickness is not (Prevrhal 1999, Treece 2010 for cortical bone).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy import special

from lacli.base.arrays import BoolArray, FloatArray, IntArray

STEP_MM = 0.25
INSIDE_MM, OUTSIDE_MM = 2.5, 9.0  # a profile's ends, from the pool's surface
PAST = 2.0  # blurs beyond the wall's outside that are still compared: farther out there may be anything
LEAST_MM, MOST_MM = 0.3, 7.0
_SWEEPS = 12


def places() -> FloatArray:
    """Where a profile is sampled (m,) mm, positive outward."""
    return np.arange(-INSIDE_MM, OUTSIDE_MM + 0.5 * STEP_MM, STEP_MM)


@dataclass(frozen=True)
class Slabs:
    """Fits of n profiles: edge, thickness (n,) mm; blood, outside (n,) HU; misfit (n,): root mean square of what is left, HU;
    slope (n,): HU of misfit per mm of thickness about the best fit, by which noise becomes error."""

    edge: FloatArray
    thickness: FloatArray
    blood: FloatArray
    outside: FloatArray
    misfit: FloatArray
    slope: FloatArray

    def take(self, which: IntArray) -> Slabs:
        """Those of ``which`` (k,)."""
        return Slabs(*(getattr(self, f.name)[which] for f in fields(self)))


def model(s: FloatArray, edge: FloatArray, thickness: FloatArray, blood: FloatArray, outside: FloatArray, muscle: float,
          blur: float) -> FloatArray:  # fmt: skip
    """HU (n, m) of n slabs at places ``s`` (m,) mm."""
    first = special.ndtr((s - edge[:, None]) / blur)
    second = special.ndtr((s - (edge + thickness)[:, None]) / blur)
    return np.asarray(blood[:, None] + (muscle - blood)[:, None] * first + (outside - muscle)[:, None] * second)


def first_guess(s: FloatArray, profiles: FloatArray, blood_hu: float, muscle: float) -> Slabs:
    """Edges at half-maximum: where a profile first falls below half blood, half wall, and then below half wall, half least."""
    n = len(profiles)
    row = np.arange(n)
    middle = 0.5 * (blood_hu + muscle)
    inner = _falls(s, profiles, np.full(n, middle), np.full(n, -INSIDE_MM))
    after = s >= inner[:, None]
    near = after & (s <= inner[:, None] + MOST_MM)
    least_at = np.where(near, profiles, np.inf).argmin(axis=1)
    # the first minimum that is clearly darker than the wall, not the deepest of all: there may be fat behind the pericardium
    dark = near & (profiles < muscle - 0.5 * np.maximum(muscle - profiles[row, least_at], 0.0)[:, None])
    start = np.where(dark.any(axis=1), dark.argmax(axis=1), least_at)
    window = (s >= np.take(s, start)[:, None]) & (s <= np.take(s, start)[:, None] + 2.0)
    outside = np.where(window, profiles, np.inf).min(axis=1)
    outside = np.minimum(outside, muscle - 20.0)
    outer = _falls(s, profiles, 0.5 * (muscle + outside), inner)
    thickness = np.clip(outer - inner, LEAST_MM, MOST_MM)
    inside = s < (inner - 1.0)[:, None]
    count = inside.sum(axis=1)
    blood = np.where(count > 2, (inside * profiles).sum(axis=1) / np.maximum(count, 1), blood_hu)
    zero = np.zeros(n)
    return Slabs(inner, thickness, blood, outside, zero, zero)


def _falls(s: FloatArray, profiles: FloatArray, level: FloatArray, start: FloatArray) -> FloatArray:
    """First place (n,) from ``start`` on where a profile is below ``level``, linear between samples; the end where nowhere."""
    below = (profiles < level[:, None]) & (s >= start[:, None] - 1e-9)
    found = below.any(axis=1)
    at = np.where(found, below.argmax(axis=1), len(s) - 1)
    row, before = np.arange(len(at)), np.maximum(at - 1, 0)
    high, low = profiles[row, before], profiles[row, at]
    share = np.where(found & (high > level) & (high > low), (high - level) / np.maximum(high - low, 1e-9), 1.0)
    return np.asarray(np.maximum(s[before] + share * (s[at] - s[before]), start))


def fit(s: FloatArray, profiles: FloatArray, start: Slabs, muscle: float, blur: float) -> Slabs:
    """Levenberg-Marquardt on edge, thickness, blood and outside of each profile (n, m) at ``s``; wall HU and blur given."""
    edge, thickness, blood, outside = (a.copy() for a in (start.edge, start.thickness, start.blood, start.outside))
    damping = np.full(len(edge), 1e-2)
    weight = _window(s, edge, thickness, blur)
    left = profiles - model(s, edge, thickness, blood, outside, muscle, blur)
    cost = (weight * left**2).sum(axis=1)
    for sweep in range(_SWEEPS):
        if sweep in (3, 6, 9):  # the window follows the wall's outside
            weight = _window(s, edge, thickness, blur)
            cost = (weight * left**2).sum(axis=1)
        jacobian = _jacobian(s, edge, thickness, blood, outside, muscle, blur)
        normal = np.einsum("nm,nmi,nmj->nij", weight, jacobian, jacobian)
        right = np.einsum("nm,nmi,nm->ni", weight, jacobian, left)
        diagonal = np.einsum("nii->ni", normal)
        damped = normal + np.einsum("ni,ij->nij", damping[:, None] * diagonal + 1e-9 + 1e-6 * diagonal.max(axis=1)[:, None],
                                    np.eye(4))  # fmt: skip
        step = np.linalg.solve(damped, right[..., None])[..., 0]
        step[:, :2] = np.clip(step[:, :2], -0.5, 0.5)
        tried = (
            np.clip(edge + step[:, 0], -INSIDE_MM, INSIDE_MM),
            np.clip(thickness + step[:, 1], LEAST_MM, MOST_MM),
            blood + step[:, 2],
            np.clip(outside + step[:, 3], -1100.0, 1500.0),
        )
        new_left = profiles - model(s, *tried, muscle, blur)
        new_cost = (weight * new_left**2).sum(axis=1)
        better = new_cost <= cost
        edge, thickness, blood, outside = (np.where(better, b, a) for a, b in zip((edge, thickness, blood, outside), tried,
                                                                                strict=True))  # fmt: skip
        left = np.where(better[:, None], new_left, left)
        cost = np.where(better, new_cost, cost)
        damping = np.clip(np.where(better, damping / 4.0, damping * 6.0), 1e-6, 1e4)
    jacobian = _jacobian(s, edge, thickness, blood, outside, muscle, blur)
    normal = np.einsum("nm,nmi,nmj->nij", weight, jacobian, jacobian)
    normal += 1e-6 * np.einsum("ni,ij->nij", np.maximum(np.einsum("nii->ni", normal), 1e-6), np.eye(4))
    variance = np.linalg.inv(normal)[:, 1, 1]
    misfit = np.sqrt(cost / weight.sum(axis=1))
    return Slabs(edge, thickness, blood, outside, misfit, 1.0 / np.sqrt(np.maximum(variance, 1e-12)))


def _window(s: FloatArray, edge: FloatArray, thickness: FloatArray, blur: float) -> FloatArray:
    """1 on the blood, the wall and PAST blurs beyond it, 0 elsewhere (n, m)."""
    end = edge + thickness + PAST * blur
    return np.asarray((s >= (edge - 2.2)[:, None]) & (s <= end[:, None]), dtype=np.float64)


def _jacobian(s: FloatArray, edge: FloatArray, thickness: FloatArray, blood: FloatArray, outside: FloatArray, muscle: float,
              blur: float) -> FloatArray:  # fmt: skip
    z1, z2 = (s - edge[:, None]) / blur, (s - (edge + thickness)[:, None]) / blur
    bell1, bell2 = (np.exp(-0.5 * z**2) / (np.sqrt(2.0 * np.pi) * blur) for z in (z1, z2))
    by_thickness = -(outside - muscle)[:, None] * bell2
    by_edge = -(muscle - blood)[:, None] * bell1 + by_thickness
    return np.stack([by_edge, by_thickness, 1.0 - special.ndtr(z1), special.ndtr(z2)], axis=2)


def blur_of(s: FloatArray, profiles: FloatArray, start: Slabs, muscle: float, usable: BoolArray) -> float:
    """The image's blur, standard deviation in mm along the normal: the one with which slabs fit best, median over profiles.

    Of at most 1500 of those that are ``usable``; voxel size, reconstruction kernel and interpolation are all in it.
    """
    some = np.flatnonzero(usable)
    some = some[:: max(1, len(some) // 1500)]
    part = start.take(some)
    tried = np.array([0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 1.0, 1.2, 1.5])
    cost = []
    for blur in tried:
        fitted = fit(s, profiles[some], part, muscle, float(blur))
        # on one window for all blurs, the blood's side and the wall's: what is past the wall changes with the window
        z = profiles[some] - model(s, fitted.edge, fitted.thickness, fitted.blood, fitted.outside, muscle, float(blur))
        mask = (s >= (part.edge - 1.8)[:, None]) & (s <= (part.edge + part.thickness + 0.6)[:, None])
        cost.append(float(np.median((mask * z**2).sum(axis=1) / mask.sum(axis=1))))
    best = int(np.clip(np.argmin(cost), 1, len(tried) - 2))
    x, y = tried[best - 1 : best + 2], np.array(cost)[best - 1 : best + 2]
    curve = np.polyfit(x, y, 2)
    found = -curve[1] / (2.0 * curve[0]) if curve[0] > 0 else tried[int(np.argmin(cost))]
    return float(np.clip(found, x[0], x[-1]))
