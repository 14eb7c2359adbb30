"""Motion of the mitral annulus over a heart cycle: positions of the wall's points on it, frame by frame.

Files: ``motion.npz`` in a bundle's folder with times (f,), wall_point (n,), positions (f, n, 3) mm, es_time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lacli.anatomy.bundle import RINGS, Bundle
from lacli.errors import AnatomyError, InputError
from lacli.scene import Scene
from lacli.store import DAMAGED

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
FILE = "motion.npz"


@dataclass(frozen=True)
class Motion:
    """times (f,) in [0, 1) of the cycle, rising, the first 0 = end-diastole = the bundle's geometry; wall_point (n,): ids of
    the bundle's points (corners and edge middles of the triangles tagged RINGS["mv"]); positions (f, n, 3) mm; es_time:
    end-systole, the atrium's largest volume, in the cycle's unit."""

    times: FloatArray
    wall_point: IntArray
    positions: FloatArray
    es_time: float

    def displacement(self) -> FloatArray:
        """(f, n, 3) mm from the first frame."""
        return self.positions - self.positions[0]


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
    es_time = float(times[max(1, int(np.argmin(np.abs(times - es_time))))])
    course = np.where(
        times <= es_time,
        0.5 - 0.5 * np.cos(np.pi * times / es_time),
        0.5 + 0.5 * np.cos(np.pi * (times - es_time) / (1 - es_time)),
    )
    across = (ring - middle) - np.outer((ring - middle) @ axis, axis)
    shift = descent_mm * axis + circumference_change * across
    return Motion(times, ids, ring + course[:, None, None] * shift, es_time)


def save_motion(motion: Motion, folder: Path) -> Path:
    """Write ``motion.npz`` into ``folder`` (under a temporary name first)."""
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / FILE
    partial = folder / (FILE + ".partial.npz")
    np.savez_compressed(
        partial, times=motion.times, wall_point=motion.wall_point, positions=motion.positions, es_time=np.array(motion.es_time)
    )
    partial.replace(target)
    return target


def load_motion(folder: Path) -> Motion:
    """Read ``motion.npz`` of ``folder``. Raises InputError where it is missing, damaged or inconsistent."""
    file = folder / FILE
    if not file.is_file():
        raise InputError(f"{file}: no such file. `lacli synthesize` writes one; without it the annulus stays in place.")
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            motion = Motion(
                np.asarray(data["times"], dtype=np.float64),
                np.asarray(data["wall_point"], dtype=np.int64),
                np.asarray(data["positions"], dtype=np.float64),
                float(data["es_time"]),
            )
    except DAMAGED as error:
        raise InputError(f"{file}: cannot be read as a motion ({type(error).__name__}: {error}).") from error
    f, n = len(motion.times), len(motion.wall_point)
    if motion.positions.shape != (f, n, 3):
        raise InputError(f"{file}: positions are {motion.positions.shape}, expected ({f}, {n}, 3).")
    if f < 2 or motion.times[0] != 0 or np.any(np.diff(motion.times) <= 0) or motion.times[-1] >= 1:
        raise InputError(f"{file}: times must rise from 0 and stay below 1.")
    if not (np.isfinite(motion.positions).all() and 0 < motion.es_time < 1):
        raise InputError(f"{file}: a position is not finite, or es_time is not between 0 and 1.")
    return motion


def scene_motion(scene: Scene, bundle: Bundle) -> Motion | None:
    """The annulus's motion that the scene asks for, or None where it is held."""
    if scene.motion.annulus == "none":
        return None
    if scene.motion.annulus == "axial":
        return descend(bundle, scene.motion.frames, scene.motion.amplitude_mm, scene.motion.es_time, 0.0)
    motion = load_motion(scene.anatomy.bundle)
    if motion.wall_point.max() >= len(bundle.points) or motion.wall_point.min() < 0:
        raise AnatomyError(f"{scene.anatomy.bundle}/motion.npz names points that wall.vtu does not have; write both together.")
    gap = float(np.abs(motion.positions[0] - bundle.points[motion.wall_point]).max())
    if gap > 1e-3:
        raise AnatomyError(f"{scene.anatomy.bundle}/motion.npz: its first frame is {gap:.3g} mm away from the bundle's geometry.")
    return motion
