"""Frames of a gated CT registered to end-diastole, each kept by its content, and the displacement of the bundle's points."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lacli.anatomy.inputs import image as images
from lacli.anatomy.inputs.image import Image
from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError, LacliError
from lacli.base.notes import note
from lacli.base.processes.process import while_wanted
from lacli.base.version import __version__
from lacli.motion import frames as framing
from lacli.motion.field import Field, read_field
from lacli.motion.frames import Source
from lacli.motion.registration import ENGINES, register_apart

Monitor = Callable[[str, int, int], None]  # what is being done, how many are done, of how many


@dataclass(frozen=True)
class Pair:
    """Two images on one grid to be registered; ``name`` for messages."""

    name: str
    fixed: Image
    moving: Image

    def digest(self, engine: str) -> str:
        """Of all that determines the field: both volumes, their grid, engine and its settings, our version."""
        total = hashlib.sha256(f"{__version__} {engine} {ENGINES[engine].settings}".encode())
        for image in (self.fixed, self.moving):
            for array in (image.spacing, image.origin, image.direction, image.array):
                total.update(f"{array.shape}{array.dtype}".encode())
                total.update(np.ascontiguousarray(array).tobytes())
        return total.hexdigest()[:20]


@dataclass(frozen=True)
class Run:
    """Fields of all pairs in order, the CPU seconds of those registered now, the largest memory of one (MB), number kept."""

    fields: list[Field]
    cpu_s: float
    peak_memory_mb: float
    kept: int


def load_frames(sources: Sequence[Source], surface: Endocardium, work_mm: float, monitor: Monitor) -> tuple[list[Image], float]:
    """All frames around the atrium, checked against each other and the bundle; share of the endocardium that fits the first."""
    result: list[Image] = []
    first: Image | None = None
    share = 1.0
    for number, source in enumerate(sources):
        image = framing.read(source)
        framing.check_hounsfield(image, source)
        if first is None:
            for doubt in image.doubts(surface.ed.mean(axis=0)):  # the others share the first's grid
                note(f"{source}: {doubt}")
            share = framing.check_is_bundles_image(image, surface, source)
            first = image
        else:
            framing.check_same_grid(first, image, source, sources[0])
        result.append(framing.around(image, surface.ed, work_mm))
        monitor("reading frames", number + 1, len(sources))
    return result, share


def register_all(pairs: Sequence[Pair], engine: str, folder: Path, workers: int, monitor: Monitor, what: str) -> Run:
    """Register every pair, ``workers`` at a time; a field that ``folder`` holds under the pair's digest is not made again."""
    folder.mkdir(parents=True, exist_ok=True)
    fields: list[Field | None] = [None] * len(pairs)
    cpu, peak, kept, done = 0.0, 0.0, 0, 0

    def one(index: int) -> tuple[int, float, float]:
        pair = pairs[index]
        key = pair.digest(engine)
        file = folder / f"{key}.nrrd"
        if file.is_file():
            try:
                fields[index] = read_field(file)
                return index, 0.0, 0.0
            except InputError:
                file.unlink(missing_ok=True)  # damaged: made again
        ends = [folder / f".part-{key}-{end}.nrrd" for end in ("fixed", "moving")]
        try:
            for path, image in zip(ends, (pair.fixed, pair.moving), strict=True):
                images.write(image, path)
            try:
                with while_wanted(lambda: not over.is_set()):
                    made = register_apart(engine, ends[0], ends[1], file)
            except LacliError as error:
                raise LacliError(f"{pair.name}: {error}") from error
            fields[index] = made.field
            return index, made.cpu_s, made.peak_memory_mb
        finally:
            for path in ends:
                path.unlink(missing_ok=True)

    monitor(what, 0, len(pairs))
    over = threading.Event()
    pool = ThreadPoolExecutor(max_workers=workers)
    try:
        waiting = {pool.submit(one, index) for index in range(len(pairs))}
        while waiting:
            finished, waiting = wait(waiting, timeout=0.5, return_when=FIRST_EXCEPTION)
            for future in finished:
                _, seconds, memory = future.result()
                cpu, peak, done = cpu + seconds, max(peak, memory), done + 1
                kept += seconds == 0.0
            if finished:
                monitor(what, done, len(pairs))
    finally:
        over.set()  # on an error, or Ctrl-C, the engines that still run are ended: nothing is left behind
        pool.shutdown(wait=True, cancel_futures=True)
    return Run([field for field in fields if field is not None], cpu, peak, kept)


def displacement_of(
    fields: Sequence[Field], times: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray, float | None]:
    """Times (f,) below 1, displacement (f, n, 3) mm of points (n, 3) from the first frame's fields of the later frames, and the
    closure: where the last frame is end-diastole again (time 1), the mean |u| left there, spread over the cycle."""
    moved = np.stack([np.zeros_like(points), *(field.at(points) for field in fields)])
    if times[-1] < 1.0:
        return times, moved, None
    left = moved[-1]
    moved = moved - times[:, None, None] * left
    return times[:-1], moved[:-1], float(np.linalg.norm(left, axis=1).mean())
