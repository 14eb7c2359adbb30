"""Motion of the mitral annulus over a heart cycle: positions of the wall's points on it, frame by frame.

Files: ``motion.npz`` in a bundle's folder with times (f,), wall_point (n,), positions (f, n, 3) mm, es_time.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lacli.base.arrays import IntArray
from lacli.base.errors import AnatomyError, InputError
from lacli.base.schema import Array, array_file
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import RINGS
from lacli.contracts.motion import FILE, Motion, load_motion
from lacli.contracts.sections import MotionSettings

ERROR = "annulus_error_mm"  # array of motion.npz: root mean square error of the tracked annulus's points at end-systole
MOST = 0.5  # of the displacement: a motion that is known to no more is none


def annulus_points(bundle: Bundle) -> IntArray:
    """Ids of the points on the mitral ring's outer faces (corners and, in 10-node cells, edge middles)."""
    points = np.unique(bundle.triangles[bundle.tags == RINGS["mv"]])
    if len(points) == 0:
        raise InputError(f"The bundle has no mitral annulus (no boundary triangle with tag {RINGS['mv']}); it cannot be moved.")
    return points


def descend(
    bundle: Bundle, frames: int = 10, descent_mm: float = 8.0, es_time: float = 0.4, circumference_change: float = 0.04
) -> Motion:
    """The annulus as a ring that moves ``descent_mm`` along the mitral axis, away from the atrium, and back.

    The axis runs from the cavity's centre to the annulus'. The time course rises as a half cosine to its peak at
    ``es_time`` and falls as one; the ring widens by ``circumference_change`` (a share) with it. 0 gives a rigid motion.
    """
    if not 0.0 <= descent_mm < np.inf:
        raise InputError(f"The annulus descends by a finite length (mm) that is not negative, got {descent_mm:g}.")
    if frames < 4:
        raise InputError(f"A motion needs at least 4 frames, got {frames}.")
    if not 0.0 < es_time < 1.0:
        raise InputError(f"es_time must lie between 0 and 1 of the cycle, got {es_time}.")
    ids = annulus_points(bundle)
    ring = bundle.points[ids]
    middle = ring.mean(axis=0)
    corner = bundle.points[bundle.cavity_triangles()[:, :3]]
    vector = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(vector, axis=1)
    centre = np.average(corner.mean(axis=1), axis=0, weights=area)
    axis = (middle - centre) / np.linalg.norm(middle - centre)
    # end-systole is one of the frames, so that the peak is reached
    times = np.arange(frames) / frames
    es_time = _peak(frames, es_time)
    course = np.where(
        times <= es_time,
        0.5 - 0.5 * np.cos(np.pi * times / es_time),
        0.5 + 0.5 * np.cos(np.pi * (times - es_time) / (1 - es_time)),
    )
    across = (ring - middle) - np.outer((ring - middle) @ axis, axis)
    shift = descent_mm * axis + circumference_change * across
    return Motion(times, ids, ring + course[:, None, None] * shift, es_time)


def _peak(frames: int, es_time: float) -> float:
    times = np.arange(frames) / frames
    return float(times[max(1, int(np.argmin(np.abs(times - es_time))))])


def end_systole(settings: MotionSettings, folder: Path) -> float:
    """End-systole of a simulation, as a share of the cycle: that of the annulus' motion, if there is one, else as set.

    folder: the bundle's. Raises InputError where its motion is missing or damaged.
    """
    if settings.annulus == "bundle":
        return load_motion(folder).es_time
    return settings.es_time if settings.annulus == "none" else _peak(settings.frames, settings.es_time)


def asked_motion(settings: MotionSettings, bundle: Bundle, folder: Path) -> Motion | None:
    """The annulus's motion that a scene asks for, or None where it is held; ``folder`` is the bundle's.

    Raises AnatomyError where its file does not fit the bundle, InputError where it is missing or damaged.
    """
    if settings.annulus == "none":
        return None
    if settings.annulus == "axial":
        return descend(bundle, settings.frames, settings.amplitude_mm, settings.es_time, 0.0)
    motion = load_motion(folder)
    if motion.wall_point.max() >= len(bundle.points) or motion.wall_point.min() < 0:
        raise AnatomyError(f"{folder}/motion.npz names points that wall.vtu does not have; write both together.")
    gap = float(np.abs(motion.positions[0] - bundle.points[motion.wall_point]).max())
    if gap > 1e-3:
        raise AnatomyError(f"{folder}/motion.npz: its first frame is {gap:.3g} mm away from the bundle's geometry.")
    if settings.annulus_times == 1.0:
        return motion
    return replace(motion, positions=motion.positions[0] + settings.annulus_times * motion.displacement())


def known_error(folder: Path) -> float | None:
    """The share of its displacement at end-systole that the annulus of a bundle's ``motion.npz`` is known to (a standard
    deviation); None where the file tells no error, as that of a motion which was not tracked.

    Raises InputError where it is missing or damaged.
    """
    motion = load_motion(folder)
    with array_file(folder / FILE, "a motion", "Write the bundle again.") as arrays:
        if ERROR not in arrays.names:
            return None
        error = float(arrays.read({ERROR: Array(least=0.0)})[ERROR])
    moved = motion.displacement()[int(np.argmin(np.abs(motion.times - motion.es_time)))]
    length = float(np.sqrt((moved**2).sum(axis=1).mean()))
    return min(error / length, MOST) if length > 0.0 else None
