"""Motion in one call: the atrium's, from a gated CT or as it is given, and the targets of its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.api.progress import Cancel, OnProgress, Stage
from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.motion.patient import Tracked
    from lacli.motion.targets import Covaried


@dataclass(frozen=True)
class Tracking:
    """A patient's motion (t, n, 3) in mm and its measured error, the targets with their covariance, and their folder.

    report: what is told of it, numbers with their units in their names; pictures: those drawn; warnings: what is
    doubtful in the motion, and what went wrong with other pictures.
    """

    folder: Path
    tracked: Tracked
    targets: Covaried
    report: dict[str, Any]
    pictures: tuple[Path, ...]
    warnings: tuple[str, ...]


def track(
    images: Sequence[Path],
    bundle: Path,
    folder: Path,
    *,
    times: Sequence[float] | None = None,
    engine: str = "greedy",
    motion: str = "images",
    axes: str = "lps",
    label: int | None = None,
    error_mm: Sequence[float] | None = None,
    published: bool = False,
    at: Sequence[float] | None = None,
    priors: Path | None = None,
    work_mm: float = 0.9,
    workers: int = 2,
    known_motions: int = 5,
    harmonics: int = 0,
    update_bundle: bool = False,
    figures: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Tracking:
    """The motion of a bundle's points through the frames of a gated CT, end-diastole first, and targets, written to ``folder``.

    Motion (t, n, 3) is in mm, times are fractions (or percentages) of the RR interval. motion: what ``images`` are, or motion
    that is given (``fields``, ``surfaces``, ``other-surfaces``, ``labels`` with the blood's ``label``) with the two sd of its
    error, normal and tangential, in ``error_mm``, its ``axes`` being lps or ras; at: times of targets beside end-systole
    (None: every frame); published: the seven targets of the published calibration instead; priors: a file of ``[priors.NAME]``,
    what is known of inputs beside the images (measured pressures), which the targets then state; work_mm: voxels that are
    registered; workers: registrations at a time; known_motions: frames whose motion is tracked again to measure the error;
    harmonics: 0, or of the cycle that smooth in time; update_bundle: its annulus moves as tracked from then on.
    Raises UsageError, InputError where frames do not fit each other or the bundle, LacliError where a registration fails,
    StorageError, Cancelled (registrations that ended are kept).
    """
    from lacli.base.files import check_folder
    from lacli.contracts.bundle import load
    from lacli.contracts.priors import read_prior_file
    from lacli.motion import measured
    from lacli.motion.patient import Settings
    from lacli.motion.store import check_replaceable

    settings = Settings(engine, work_mm, workers, known_motions, harmonics)
    settings.check()
    stated = measured.stated_error(motion, error_mm)
    if axes not in ("lps", "ras"):
        raise UsageError(f"--axes {axes}: lps (ITK) or ras.")
    known = None if priors is None else read_prior_file(priors)
    check_folder(folder)
    check_replaceable(folder)
    anatomy = load(bundle)
    stage = Stage("tracking", 1, progress, cancel).begin()
    if stated is None:
        tracked, names, origin = measured.from_images(anatomy, images, times, settings, folder, stage.of)
    else:
        moved = measured.Given(motion, axes, label, stated)
        tracked, names, origin = measured.from_motion(anatomy, images, times, moved, stage.of)
    found = measured.targets_of(tracked, published, at).knowing(known)
    doubts = tracked.course.doubts(tracked.model)
    notes = {"bundle": str(bundle), "frames": names, "times_from": origin, "published": published, "warnings": doubts}
    report = measured.write(folder, bundle, anatomy, tracked, found, notes, update_bundle)
    drawn: list[Path] = []
    trouble = ""
    if figures:
        from lacli.report.motion_figures import draw_apart

        stage.of("drawing", 0, 1)
        drawn, trouble = draw_apart(folder, bundle, [str(p) for p in images] if stated is None else [])
    if trouble:
        doubts = [*doubts, f"some pictures could not be drawn: {trouble}"]
    return Tracking(folder, tracked, found, report, tuple(drawn), tuple(doubts))
