"""Errors of a motion that was tracked elsewhere, as its maker states them: along the normal and tangential, mm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.features import kind_of
from lacli.contracts.labels import REGIONS
from lacli.motion.axes import nodal_axes
from lacli.motion.errors.uncertainty import SHARED, ErrorModel, SurfaceError
from lacli.motion.targets import Course

# of each error that goes with no other: a region does not shift as one body
_OWN = 0.1
_STEP_MM = 1e-3


def stated_model(bundle: Bundle, course: Course, normal_mm: float, tangential_mm: float) -> ErrorModel:
    """For a motion whose error is stated, not measured: sd along the normal and along each tangent, mm, taken as one shift of a
    whole region (the worst case for its means), independent between regions, half shared between frames.

    Strains err by the tangential sd at both ends of a region, over the root of its area. All features of a region err by its one
    shift, and go together as they move with it about the largest atrium.
    """
    surface = course.surface
    keys = tuple(surface.features(surface.ed))
    area = {name: float(surface.area[surface.region == number].sum()) for name, number in REGIONS.items()}
    whole = float(surface.area.sum())
    sd = []
    for key in keys:
        kind, region = kind_of(key)
        if kind == "volume":
            sd.append(normal_mm * whole / 1000.0)  # mm3 -> mL
        elif kind.endswith("strain"):
            sd.append(2.0**0.5 * tangential_mm / np.sqrt(area[region]) * (2.0 if kind == "area_strain" else 1.0))
        else:
            sd.append(
                {"n": normal_mm, "a": tangential_mm, "b": tangential_mm}.get(kind, float(np.hypot(normal_mm, tangential_mm)))
            )
    return ErrorModel(keys, np.array(sd), _together(bundle, course, keys, normal_mm, tangential_mm), SHARED, 0)


def _together(bundle: Bundle, course: Course, keys: Sequence[str], normal_mm: float, tangential_mm: float) -> FloatArray:
    """Correlation (k, k) of the features' errors where every region shifts by itself along its normal and its two tangents."""
    surface = course.surface
    largest = int(np.argmax([row["volume_ml"] for row in course.features]))
    x = course.positions[largest]
    columns = []
    for axis, mm in _axes(bundle, surface, normal_mm, tangential_mm):
        for weight in _weights(surface, len(x)):
            step = _STEP_MM * weight[:, None] * axis
            ahead, behind = surface.features(x + step), surface.features(x - step)
            columns.append([mm * (ahead[key] - behind[key]) / (2.0 * _STEP_MM) for key in keys])
    moved = np.array(columns).T
    size = np.linalg.norm(moved, axis=1, keepdims=True)
    moved = np.divide(moved, size, out=np.zeros_like(moved), where=size > 0)
    correlation = (1.0 - _OWN) * moved @ moved.T
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(correlation)


def _axes(bundle: Bundle, surface: Endocardium, normal_mm: float, tangential_mm: float) -> list[tuple[FloatArray, float]]:
    """Unit vectors (n, 3) along which a region shifts, and how far: the normal, and two tangents, the bundle's own where it has
    universal coordinates."""
    axes = nodal_axes(bundle, surface)
    normal = axes["normal"]
    some = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    one = axes.get("alpha", np.cross(normal, some))
    one = one / np.maximum(np.linalg.norm(one, axis=1, keepdims=True), 1e-12)
    return [(normal, normal_mm), (one, tangential_mm), (np.cross(normal, one), tangential_mm)]


def _weights(surface: Endocardium, count: int) -> list[FloatArray]:
    """By region that there is: of each point (n,) the share of the area around it that is the region's."""
    parts = []
    for number in REGIONS.values():
        part = np.zeros(count)
        here = surface.region == number
        for corner in surface.faces[here].T:
            np.add.at(part, corner, surface.area[here].sum(axis=1))
        parts.append(part)
    total = np.maximum(np.sum(parts, axis=0), 1e-12)
    return [part / total for part in parts if part.any()]


def stated_error(normal_mm: float, tangential_mm: float) -> SurfaceError:
    """The same error everywhere."""
    names = ("global", *REGIONS)
    both = float(np.hypot(normal_mm, tangential_mm))
    return SurfaceError(dict.fromkeys(names, both), dict.fromkeys(names, normal_mm), dict.fromkeys(names, tangential_mm))
