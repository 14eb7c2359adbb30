"""A simulated heart cycle as a smooth motion of all of space: the wall's displacement, extended and interpolated in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import CubicSpline, RBFInterpolator
from scipy.sparse import csr_array

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError, LacliError
from lacli.contracts.scene import Scene, build_scene, with_parameters
from lacli.freefem.run import Progress
from lacli.mechanics.simulation import run_scene

GRID_MM = 3.0
REACH_MM = 20.0  # the motion fades out over this length around the wall
CENTRES = 1500
_TAPER_MM = 6.0
_CLOSED_MM = 0.2  # a passive wall under its first pressure is back where it was


@dataclass(frozen=True)
class Cycle:
    """Displacement of the wall's points (k, n, 3) mm from end-diastole at times (k,), 0 to 1 of the cycle."""

    times: FloatArray
    displacement: FloatArray

    def spline(self) -> CubicSpline:
        """Periodic cubic spline, time -> (n, 3) mm."""
        return CubicSpline(self.times, self.displacement, axis=0, bc_type="periodic")


# of the pressures (mmHg), of the pericardium's stiffness and of where its springs end: uniform, and digits kept
LOADS = {
    "edp_mmhg": (5.0, 9.0, 3),
    "esp_mmhg": (17.0, 24.0, 3),
    "k_peri_kpa_per_um": (0.0005, 0.002, 6),
    "pth": (0.6, 0.85, 3),
}


def draw_parameters(seed: int) -> dict[str, float]:
    """Parameters of a seed's atrium, in the middle of the study's ranges: stiffness differs between regions."""
    rng = np.random.default_rng([20260411, seed])
    regions = ("anterior", "posterior", "septum", "lateral", "roof")
    alpha = np.exp(rng.uniform(np.log(0.6), np.log(2.2), 5))
    return {
        **{f"alpha_{name}": round(float(value), 4) for name, value in zip(regions, alpha, strict=True)},
        **{name: round(float(rng.uniform(low, high)), digits) for name, (low, high, digits) in LOADS.items()},
    }


def cycle_scene(bundle: Path, parameters: dict[str, float], es_time: float, order: int) -> Scene:
    """The scene of a whole cycle: pressure to ES, down to a plateau (diastasis), and down again to EDP (booster)."""
    base = build_scene(
        {
            "anatomy": {"bundle": str(bundle)},
            "numerics": {"order": order},
            "outputs": {"frames": 4, "conduit": True, "fields": "all", "unloaded": False},
        },
        [],
        folder=Path("/"),
        where="the synthetic cycle",
    )
    scene = with_parameters(base, parameters)
    low, high = scene.loads.edp_mmhg, scene.loads.esp_mmhg
    plateau = low + 0.35 * (high - low)
    rest = 1.0 - es_time
    # the plateau spans an eighth of the cycle where the heart is slow enough to have one
    transient = [(0.0, low), (es_time, high), (es_time + 0.4 * rest, plateau), (es_time + 0.65 * rest, plateau), (1.0, low)]
    document = scene.model_dump(mode="json", exclude_none=True)
    document["loads"]["transient_mmhg"] = transient
    return build_scene(document, [], folder=Path("/"), where="the synthetic cycle")


def simulate(scene: Scene, folder: Path, on_progress: Callable[[Progress], None] | None = None) -> Cycle:
    """Run the scene in ``folder``; the wall's motion at the states the run keeps. LacliError where the run fails."""
    result = run_scene(scene, folder, on_progress)
    if result.status != "done":
        raise LacliError(
            f"the simulation of the synthetic cycle failed ({result.kind}): {result.message} Choose other parameters."
        )
    times = pd.read_csv(result.folder / "transients.csv")["time"].to_numpy()
    files = _series(result.folder / "fields" / "series.pvd")
    if len(times) != len(files):
        raise LacliError(f"{result.folder}: {len(files)} fields for {len(times)} states.")
    moved = np.stack([_displacement(file) for file in files])
    gap = float(np.linalg.norm(moved[-1] - moved[0], axis=1).mean())
    if gap > _CLOSED_MM:
        raise LacliError(f"the synthetic cycle does not close: the wall ends {gap:.2f} mm from where it began.")
    # what is left is the solver's tolerance; spread over the cycle it closes exactly
    moved = moved - moved[0] - times[:, None, None] * (moved[-1] - moved[0])
    moved[-1] = moved[0]
    return Cycle(times, moved)


def _series(file: Path) -> list[Path]:
    import re

    return [file.parent / name for name in re.findall(r'file="([\w.]+\.vtu)"', file.read_text(encoding="utf-8"))]


def _displacement(file: Path) -> FloatArray:
    return np.asarray(meshio.vtu.read(file).point_data["displacement"], dtype=np.float64)


@dataclass(frozen=True)
class SpaceMotion:
    """Displacement of all of space: u (k, nx, ny, nz, 3) mm at times (k,) on a regular grid from ``origin``, 0 beyond it.

    Between grid points and times it is a cubic spline.
    """

    times: FloatArray
    origin: FloatArray
    spacing: float
    values: FloatArray

    @classmethod
    def extend(cls, cycle: Cycle, points: FloatArray) -> SpaceMotion:
        """From the wall's points (n, 3): radial functions on some of them, none 20 mm away.

        Not smoothed: what the images show must be what the parameters make of the wall.
        """
        if len(points) != cycle.displacement.shape[1]:
            raise AnatomyError(f"the cycle moves {cycle.displacement.shape[1]} points, the wall has {len(points)}.")
        low, high = points.min(axis=0) - REACH_MM, points.max(axis=0) + REACH_MM
        count = np.ceil((high - low) / GRID_MM).astype(int) + 1
        chosen = farthest_points(points, CENTRES)
        anchors = _box(low, low + GRID_MM * (count - 1), 15.0)
        known = np.concatenate([cycle.displacement[:, chosen], np.zeros((len(cycle.times), len(anchors), 3))], axis=1)
        centres = np.vstack([points[chosen], anchors])
        fit = RBFInterpolator(
            centres, np.moveaxis(known, 1, 0).reshape(len(centres), -1), kernel="thin_plate_spline", smoothing=1e-3
        )
        axes = [a + GRID_MM * np.arange(n) for a, n in zip(low, count, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        value = np.concatenate([fit(part) for part in np.array_split(grid, max(1, len(grid) // 4000))])
        value = np.moveaxis(value.reshape(*count, len(cycle.times), 3), 3, 0)
        fade = np.ones(tuple(count))
        for axis in range(3):
            edge = np.minimum(np.arange(count[axis]), np.arange(count[axis])[::-1]) * GRID_MM / _TAPER_MM
            s = np.clip(edge, 0.0, 1.0)
            shape = [1, 1, 1]
            shape[axis] = -1
            fade = fade * (s * s * (3 - 2 * s)).reshape(shape)
        value = value * fade[None, ..., None]
        value[0] = value[-1] = 0.0
        return cls(cycle.times, low, GRID_MM, value)

    def at(self, time: float) -> SpaceField:
        """The field at one time of the cycle."""
        spline = CubicSpline(self.times, self.values.reshape(len(self.times), -1), axis=0, bc_type="periodic")
        return SpaceField(self.origin, self.spacing, np.asarray(spline(time)).reshape(self.values.shape[1:]))


@dataclass(frozen=True)
class SpaceField:
    """A displacement u (nx, ny, nz, 3) mm on a regular grid along x, y, z; 0 beyond it; a cubic spline between."""

    origin: FloatArray
    spacing: float
    values: FloatArray

    def __call__(self, points: FloatArray) -> FloatArray:
        """u at points (n, 3) mm: (n, 3)."""
        index = ((points - self.origin) / self.spacing).T
        return np.stack([ndimage.map_coordinates(self.values[..., i], index, order=3, mode="constant") for i in range(3)], axis=1)

    def inverse(self, spacing: float = 1.5, sweeps: int = 25) -> SpaceField:
        """v with v(x) = -u(x + v(x)), by fixed point on a finer grid."""
        size = (np.array(self.values.shape[:3]) - 1) * self.spacing
        count = np.round(size / spacing).astype(int) + 1
        axes = [a + spacing * np.arange(n) for a, n in zip(self.origin, count, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        smooth = [ndimage.spline_filter(self.values[..., i], order=3) for i in range(3)]
        v = np.zeros_like(grid)
        for _ in range(sweeps):
            index = ((grid + v - self.origin) / self.spacing).T
            new = -np.stack(
                [ndimage.map_coordinates(s, index, order=3, mode="constant", prefilter=False) for s in smooth], axis=1
            )
            change = float(np.abs(new - v).max())
            v = new
            if change < 1e-3:
                break
        return SpaceField(self.origin, spacing, v.reshape(*count, 3))

    def inverse_error_mm(self, inverse: SpaceField, points: FloatArray) -> float:
        """Largest |x + v(x) + u(x + v(x)) - x| over points (n, 3), mm: what the pair misses of the identity."""
        v = inverse(points)
        return float(np.linalg.norm(v + self(points + v), axis=1).max())

    def on_axes(self, axes: list[FloatArray]) -> NDArray[np.float32]:
        """u on the grid of three axes of coordinates (mm): (len x, len y, len z, 3) of float32, by one spline an axis."""
        value: Any = self.values.astype(np.float32)
        for i, axis in enumerate(axes):
            weights = _spline_weights(self.values.shape[i], (axis - self.origin[i]) / self.spacing)
            flat = np.moveaxis(value, i, 0)
            value = np.moveaxis((weights @ flat.reshape(flat.shape[0], -1)).reshape(len(axis), *flat.shape[1:]), 0, i)
        return np.asarray(value, dtype=np.float32)


def _spline_weights(count: int, index: FloatArray) -> Any:
    """(len(index), count) sparse: cubic spline interpolation along an axis as a matrix, 0 beyond its ends."""
    # a unit in one place decays over a few grid points: the matrix is a band
    full = ndimage.spline_filter1d(np.eye(count), order=3, axis=0)
    inside = (index >= 0) & (index <= count - 1)
    rows = np.zeros((len(index), count), dtype=np.float32)
    for column in range(count):
        rows[:, column] = ndimage.map_coordinates(full[:, column], index[None], order=3, mode="constant", prefilter=False)
    rows[~inside] = 0.0
    rows[np.abs(rows) < 1e-7] = 0.0
    return csr_array(rows)


def farthest_points(points: FloatArray, count: int) -> IntArray:
    """Ids of ``count`` points, each as far as can be from those before it."""
    count = min(count, len(points))
    chosen = np.zeros(count, dtype=np.int64)
    distance = np.full(len(points), np.inf)
    for i in range(1, count):
        distance = np.minimum(distance, ((points - points[chosen[i - 1]]) ** 2).sum(axis=1))
        chosen[i] = int(np.argmax(distance))
    return chosen


def _box(low: FloatArray, high: FloatArray, step: float) -> FloatArray:
    """Points on the faces of a box, about ``step`` apart."""
    axes = [np.linspace(a, b, int(np.ceil((b - a) / step)) + 1) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[((grid <= low + 1e-9) | (grid >= high - 1e-9)).any(axis=1)]
