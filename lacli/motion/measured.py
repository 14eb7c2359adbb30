"""A patient's motion as measured: from images that are tracked or motion that is given, to targets and files."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lacli.base.errors import UsageError
from lacli.base.files import replacing
from lacli.contracts.bundle import Bundle
from lacli.motion import frames as framing
from lacli.motion.frames import Source
from lacli.motion.given import displacement
from lacli.motion.patient import Settings, Tracked, from_given, put, scratch, track
from lacli.motion.store import PICTURES, write_all
from lacli.motion.targets import Covaried, measured, published
from lacli.motion.tracking import Monitor


@dataclass(frozen=True)
class Given:
    """Motion that is given: its kind (fields, surfaces, other-surfaces, labels), axes (lps, ras), the blood's label, and the
    sd of its error along the normal and tangential, mm."""

    kind: str
    axes: str
    label: int | None
    error_mm: tuple[float, float]


def stated_error(motion: str, error_mm: Sequence[float] | None) -> tuple[float, float] | None:
    """The error (sd, mm) of a given motion; None where images are tracked and it is measured. Raises UsageError."""
    if motion == "images":
        if error_mm is not None:
            raise UsageError("--error-mm is for a given motion; of images that are tracked here the error is measured.")
        return None
    if error_mm is None:
        raise UsageError(f"--motion {motion} needs --error-mm NORMAL,TANGENTIAL (sd, mm): nobody but its maker knows its error.")
    if len(error_mm) != 2 or not all(0.0 < value < 20.0 for value in error_mm):
        said = ",".join(f"{value:g}" for value in error_mm)
        raise UsageError(f"--error-mm {said}: two numbers above 0, sd in mm along the normal and tangential (0.3,0.6).")
    return error_mm[0], error_mm[1]


def from_images(
    bundle: Bundle, images: Sequence[Path], times: Sequence[float] | None, settings: Settings, folder: Path, monitor: Monitor
) -> tuple[Tracked, list[str], str]:
    """Motion tracked through the frames (registrations kept in ``folder``), their names, and where their times are from."""
    sources = framing.find(images)
    moments, origin = framing.cycle_times(sources, times)
    return track(bundle, sources, moments, settings, folder / "registration", monitor), [str(s) for s in sources], origin


def from_motion(
    bundle: Bundle, files: Sequence[Path], times: Sequence[float] | None, given: Given, monitor: Monitor
) -> tuple[Tracked, list[str], str]:
    """Motion as the files give it, their names, and where the times are from."""
    moved = displacement(bundle, given.kind, files, given.axes, given.label, monitor)
    moments, origin = framing.cycle_times([Source(Path(f"frame {i}")) for i in range(len(moved))], times)
    return from_given(bundle, moments, moved, given.error_mm, given.kind), [str(file) for file in files], origin


def targets_of(tracked: Tracked, the_seven: bool, at: Sequence[float] | None) -> Covaried:
    """Targets at end-systole and at times ``at`` (fractions of RR; None: every frame), or the published calibration's seven."""
    assert tracked.ed_residual is not None
    return published(tracked.course, tracked.ed_residual.whole) if the_seven else measured(tracked.course, tracked.model, at)


def write(
    folder: Path, bundle: Path, anatomy: Bundle, tracked: Tracked, found: Covaried, notes: dict[str, Any], update_bundle: bool
) -> dict[str, Any]:
    """What is told of the motion; its files are put into ``folder`` together, and its motion.npz into the bundle if asked."""
    partial = scratch(folder)
    try:
        info = write_all(partial, anatomy, tracked, found, notes)
        if (folder / "tracking.json").is_file():
            for name in PICTURES:  # of the former motion: whether this one is drawn is seen later
                (folder / name).unlink(missing_ok=True)
        put(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    if update_bundle:
        with replacing(bundle / "motion.npz") as temporary:
            shutil.copyfile(folder / "motion.npz", temporary)
    return info
