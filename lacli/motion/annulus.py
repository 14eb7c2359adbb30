"""Motion of the mitral annulus over a heart cycle: positions of the wall's points on it, frame by frame.

Files: ``motion.npz`` in a bundle's folder with times (f,), wall_point (n,), positions (f, n, 3) mm, es_time.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
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
    if settings.annulus_times == 1.0 and not any(settings.annulus_off_mm):
        return motion
    moved = settings.annulus_times * motion.displacement()
    if any(settings.annulus_off_mm):
        moved = moved + np.tensordot(np.array(settings.annulus_off_mm), off_modes(motion), axes=1)
    return replace(motion, positions=motion.positions[0] + moved)


def off_modes(motion: Motion) -> FloatArray:
    """What ``motion.annulus_off_mm`` multiplies, (ANNULUS_MODES, f, n, 3): displacements of root mean square length 1 at
    end-systole, along the way of the annulus's middle; aside, in two directions across that; a tilt about either; wider.

    They grow and fall as the annulus's displacement does. Raises InputError for an annulus that stands still.
    """
    ring, moved = motion.positions[0], motion.displacement()
    course = np.sqrt((moved**2).sum(axis=2).mean(axis=1))
    es = int(np.argmin(np.abs(motion.times - motion.es_time)))
    if course[es] == 0.0:
        raise InputError("motion.annulus_off_mm: the annulus does not move, and its errors grow with its motion; leave it out.")
    arms = ring - ring.mean(axis=0)
    across = np.linalg.svd(arms, full_matrices=False)[2]
    way = moved[es].mean(axis=0)
    # an annulus that only widens has no way: the normal of its plane
    axis = way / np.linalg.norm(way) if np.linalg.norm(way) > 0.1 * course[es] else across[2]
    arms = arms - np.outer(arms @ axis, axis)
    one, two = np.linalg.svd(arms, full_matrices=False)[2][:2]
    even = np.ones((len(ring), 1))
    fields = np.stack([even * axis, even * one, even * two, np.outer(arms @ one, axis), np.outer(arms @ two, axis), arms])
    fields /= np.sqrt((fields**2).sum(axis=2).mean(axis=1))[:, None, None]
    return np.asarray(fields[:, None] * (course / course[es])[None, :, None, None])


def known_error(folder: Path) -> tuple[float, float] | None:
    """What the annulus of a bundle's ``motion.npz`` is known to at end-systole (a standard deviation): root mean square error of
    a point (mm), and that as a share of its displacement, at most MOST; None where the file tells no error, as that of a motion
    which was not tracked.

    Raises InputError where it is missing or damaged.
    """
    motion = load_motion(folder)
    with array_file(folder / FILE, "a motion", "Write the bundle again.") as arrays:
        if ERROR not in arrays.names:
            return None
        error = float(arrays.read({ERROR: Array(least=0.0)})[ERROR])
    moved = motion.displacement()[int(np.argmin(np.abs(motion.times - motion.es_time)))]
    length = float(np.sqrt((moved**2).sum(axis=1).mean()))
    share = min(error / length, MOST) if length > 0.0 else 0.0
    return (share * length, share) if length > 0.0 else None
