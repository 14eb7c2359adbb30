"""One patient's motion from a gated CT: frames registered, errors measured by known motion, targets, files."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.base.errors import UsageError
from lacli.contracts.bundle import Bundle
from lacli.motion import frames as framing
from lacli.motion import tracking
from lacli.motion.annulus import annulus_points
from lacli.motion.axes import wall_normals
from lacli.motion.errors import uncertainty
from lacli.motion.errors.ring import AnnulusError, annulus_error
from lacli.motion.errors.stated import stated_error, stated_model
from lacli.motion.errors.uncertainty import ErrorModel, SurfaceError
from lacli.motion.frames import Source
from lacli.motion.registration import ENGINES
from lacli.motion.targets import Course
from lacli.motion.tracking import Monitor


@dataclass(frozen=True)
class Settings:
    """engine: of ENGINES; work_mm: voxels that are registered; workers: registrations at a time; known_motions: how many frames'
    motions are applied and tracked again; harmonics: 0, or of the cycle that smooth the motion in time."""

    engine: str = "greedy"
    work_mm: float = framing.WORK_MM
    workers: int = 2
    known_motions: int = 5
    harmonics: int = 0

    def check(self) -> None:
        """UsageError where a setting is out of range."""
        if self.engine not in ENGINES:
            raise UsageError(f"--engine {self.engine}: there are {', '.join(ENGINES)}.")
        if not 0.4 <= self.work_mm <= 3.0:
            raise UsageError(f"--work-mm is {self.work_mm:g}; it must be 0.4 to 3 mm.")
        if not 1 <= self.workers <= 64:
            raise UsageError(f"--workers is {self.workers}; it must be 1 to 64.")
        if self.known_motions < 2:
            raise UsageError(f"--known-motions is {self.known_motions}; at least 2 are needed to see how errors go together.")
        if not 0 <= self.harmonics <= 20:
            raise UsageError(f"--harmonics is {self.harmonics}; it must be 0 (no smoothing) to 20.")


@dataclass(frozen=True)
class Tracked:
    """The course of the bundle's points, the errors measured, and how.

    known: time and surface error of each frame whose motion was applied, as a true motion would have it; ed_residual: that of
    end-diastole registered to itself with fresh noise (or, ``closure_mm``, to a frame at the end of the cycle); annulus: what its
    positions, as they are in the course, err by.
    """

    course: Course
    model: ErrorModel
    known: list[tuple[float, SurfaceError]]
    ed_residual: SurfaceError | None
    closure_mm: float | None
    annulus: AnnulusError
    info: dict[str, Any] = field(default_factory=dict)


def track(
    bundle: Bundle, sources: Sequence[Source], times: FloatArray, settings: Settings, folder: Path, monitor: Monitor
) -> Tracked:
    """Track the bundle's points through the frames; fields are kept in ``folder`` by their content, a rerun goes on from them.

    Raises InputError where frames do not fit each other or the bundle, LacliError where a registration fails.
    """
    settings.check()
    surface = Endocardium.of(bundle)
    images, share = tracking.load_frames(sources, surface, settings.work_mm, monitor)
    pairs = [tracking.Pair(str(s), images[0], image) for s, image in zip(sources[1:], images[1:], strict=True)]
    run = tracking.register_all(pairs, settings.engine, folder, settings.workers, monitor, "registering frames")
    times, moved, closure = tracking.displacement_of(run.fields, times, bundle.points)
    if settings.harmonics:
        moved = smoothed(times, moved, settings.harmonics)
    course = Course.of(surface, times, moved, closure is not None)
    monitor("preparing known motions", 0, 1)
    count = len(times) - 1
    mean = uncertainty.template(images[0], images[1 : count + 1], run.fields[:count])
    chosen = uncertainty.chosen_frames(count, settings.known_motions)
    known = [uncertainty.known_pair("end-diastole again", mean, None, bundle.points, 0)]
    known += [
        uncertainty.known_pair(f"known motion of {sources[i + 1]}", mean, run.fields[i], bundle.points, i + 1) for i in chosen
    ]
    again = tracking.register_all(
        [k.pair for k in known], settings.engine, folder, settings.workers, monitor, "measuring the error by known motion"
    )
    found = [f.at(bundle.points) for f in again.fields]
    normal = wall_normals(bundle, surface)
    ring = annulus_points(bundle)
    errors, changes, by_frame, at_ring = [], [], [], []
    for i, k, u in zip(chosen, known[1:], found[1:], strict=True):
        error = uncertainty.as_of_a_true_motion(u - k.displacement, normal)
        right, got = (surface.features(bundle.points + k.displacement + e) for e in (np.zeros_like(error), error))
        errors.append({key: got[key] - right[key] for key in right})
        changes.append({key: right[key] - course.features[0][key] for key in right})
        by_frame.append((float(times[i + 1]), uncertainty.surface_error(surface, error)))
        at_ring.append(error[ring])
    model = uncertainty.error_model(errors, changes)
    course = course.restored(model.shrinkage)
    annulus = annulus_error(at_ring, [k.displacement[ring] for k in known[1:]])
    info = {
        "engine": settings.engine,
        "engine_settings": ENGINES[settings.engine].settings,
        "work_mm": settings.work_mm,
        "voxels": int(images[0].array.size),
        "voxel_mm": images[0].spacing.tolist(),
        "noise_hu": float(mean.noise_hu),
        "true_over_known_normal": uncertainty.EASIER[0],
        "true_over_known_tangential": uncertainty.EASIER[1],
        "endocardium_that_fits_ed": share,
        "registration_cpu_s": run.cpu_s + again.cpu_s,
        "peak_memory_mb": max(run.peak_memory_mb, again.peak_memory_mb),
        "registrations_kept": run.kept + again.kept,
        "registrations": len(pairs) + len(known),
    }
    return Tracked(course, model, by_frame, uncertainty.surface_error(surface, found[0]), closure, annulus, info)


def smoothed(times: FloatArray, displacement: FloatArray, harmonics: int) -> FloatArray:
    """The displacement (f, n, 3) by least squares as a sum of harmonics of the cycle that is 0 at end-diastole."""
    if 2 * harmonics >= len(times):
        raise UsageError(f"--harmonics {harmonics} needs more than {2 * harmonics} frames, there are {len(times)}.")
    angle = 2.0 * np.pi * times[:, None] * np.arange(1, harmonics + 1)
    basis = np.hstack([1.0 - np.cos(angle), np.sin(angle)])
    flat = displacement.reshape(len(times), -1)
    coefficients, *_ = np.linalg.lstsq(basis, flat, rcond=None)
    return (basis @ coefficients).reshape(displacement.shape)


def scratch(folder: Path) -> Path:
    """A temporary folder beside ``folder`` for results that are not complete yet."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))


def put(partial: Path, folder: Path) -> None:
    """Move everything of ``partial`` into ``folder``, replacing what is there under the same names."""
    folder.mkdir(parents=True, exist_ok=True)
    for item in sorted(partial.iterdir()):
        goal = folder / item.name
        if goal.is_dir():
            shutil.rmtree(goal)
        item.replace(goal)
    partial.rmdir()


def from_given(bundle: Bundle, times: FloatArray, displacement: FloatArray, error_mm: tuple[float, float], how: str) -> Tracked:
    """A motion tracked elsewhere, displacement (f, n, 3) mm of the bundle's points, its error (normal, tangential) as stated."""
    surface = Endocardium.of(bundle)
    closure = None
    if times[-1] >= 1.0:
        left = displacement[-1]
        closure = float(np.linalg.norm(left, axis=1).mean())
        displacement, times = (displacement - times[:, None, None] * left)[:-1], times[:-1]
    course = Course.of(surface, times, displacement, closure is not None)
    model = stated_model(bundle, course, *error_mm)
    info = {
        "engine": f"given {how}",
        "error": "stated, not measured",
        "error_normal_mm": error_mm[0],
        "error_tangential_mm": error_mm[1],
    }
    annulus = AnnulusError(0.0, 0.0, float(np.hypot(*error_mm)))
    return Tracked(course, model, [], stated_error(*error_mm), closure, annulus, info)
