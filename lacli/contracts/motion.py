"""The motion of the mitral annulus as a file: ``motion.npz`` in a bundle's folder.

Arrays: times (f,), wall_point (n,), positions (f, n, 3) mm, es_time. Other arrays in the file are not read for a simulation.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import InputError
from lacli.base.schema import Array, array_file, unfit, write_arrays

FILE = "motion.npz"
# a position further than this from the image's origin is no millimetre
_FARTHEST = 1e5
_SCHEMA = {
    "times": Array(shape=("f",), rising=True),
    "wall_point": Array("int", ("n",), least=0, distinct=True),
    "positions": Array(shape=("f", "n", 3), least=-_FARTHEST, most=_FARTHEST),
    "es_time": Array(least=0.0, most=1.0, open_=True),
}


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

    def of_points(self, kept: IntArray) -> Motion:
        """The motion of those points of the bundle (ids, rising), which are numbered anew in their order."""
        inside = np.isin(self.wall_point, kept)
        return Motion(self.times, np.searchsorted(kept, self.wall_point[inside]), self.positions[:, inside], self.es_time)


def save_motion(motion: Motion, folder: Path) -> Path:
    """Write ``motion.npz`` into ``folder`` (whole or not at all), with a seal; one that users write needs none."""
    arrays = {
        "times": motion.times, "wall_point": motion.wall_point, "positions": motion.positions, "es_time": float(motion.es_time),
    }  # fmt: skip
    write_arrays(folder / FILE, arrays)
    return folder / FILE


def load_motion(folder: Path) -> Motion:
    """Read ``motion.npz`` of ``folder``. Raises InputError where it is missing, damaged or inconsistent."""
    file = folder / FILE
    if not file.is_file():
        raise InputError(f"{file}: no such file. `lacli synthesize` writes one; without it the annulus stays in place.")
    with array_file(file, "a motion", "Write the bundle again, or remove the file: the annulus then stays in place.") as arrays:
        a = arrays.read(_SCHEMA)
        if len(a["times"]) < 2 or a["times"][0] != 0 or a["times"][-1] >= 1:
            raise unfit("times must rise from 0 and stay below 1")
    return Motion(a["times"], a["wall_point"], a["positions"], float(a["es_time"]))
