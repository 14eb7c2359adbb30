"""The motion of the mitral annulus as a file: ``motion.npz`` in a bundle's folder.

Arrays: times (f,), wall_point (n,), positions (f, n, 3) mm, es_time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import InputError
from lacli.base.files import DAMAGED

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
