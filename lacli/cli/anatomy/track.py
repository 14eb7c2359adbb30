"""``lacli track``: the motion of a patient's atrium from a gated CT, and targets for its calibration."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from lacli.base.errors import UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table, progress


def command(
    images: Annotated[
        list[Path],
        typer.Argument(
            metavar="IMAGES...",
            help="Frames in order, end-diastole first: files (.nrrd .nii .mha), DICOM folders, a 4-D file, a folder of them.",
        ),
    ],
    bundle: Annotated[Path, typer.Option("--bundle", help="Anatomy bundle made from the end-diastolic frame.")],
    folder: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for motion.npz, targets.toml, frames/, transients.csv.")
    ] = Path("motion"),
    times: Annotated[
        str | None, typer.Option(help="Times of the frames: fractions or percentages of the RR interval, separated by commas.")
    ] = None,
    engine: Annotated[str, typer.Option(help="Registration engine: greedy or demons.")] = "greedy",
    motion: Annotated[
        str, typer.Option(help="What IMAGES are: images; or given motion: fields, surfaces, other-surfaces, labels.")
    ] = "images",
    axes: Annotated[str, typer.Option(help="Of given fields and surfaces: lps (ITK) or ras.")] = "lps",
    label: Annotated[int | None, typer.Option(help="With --motion labels: the label of the atrium's blood.")] = None,
    error_mm: Annotated[
        str | None, typer.Option(help="Of a given motion: its error along the normal and tangential, sd in mm (0.3,0.6).")
    ] = None,
    published: Annotated[
        bool, typer.Option("--published", help="The seven targets of the published calibration with its uncertainties.")
    ] = False,
    at: Annotated[
        str | None, typer.Option(help="Times of the targets beside ES (fractions of RR). Default: every frame.")
    ] = None,
    work_mm: Annotated[float, typer.Option(help="Voxel size in which is registered, mm; finer frames are averaged.")] = 0.9,
    workers: Annotated[int, typer.Option(help="Registrations at a time, one core each.")] = 2,
    known_motions: Annotated[
        int, typer.Option(help="Frames whose motion is applied and tracked again, to measure the error.")
    ] = 5,
    harmonics: Annotated[int, typer.Option(help="Smooth in time by so many harmonics of the cycle; 0: no smoothing.")] = 0,
    update_bundle: Annotated[
        bool, typer.Option("--update-bundle", help="Also put motion.npz into the bundle: its annulus then moves as tracked.")
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw transients, surfaces, slices and an animation into OUT.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
) -> None:
    """Track the atrium through the frames of a gated CT: motion, transients, phases, and targets with their covariance.

    Frames that are registered are kept in OUT/registration; a rerun goes on from them.

    Example: lacli track ct/phase_*.nii.gz --bundle anatomy --out motion --times 0,10,20,30,40,50,60,70,80,90
    """
    from lacli.base.files import check_folder, replacing
    from lacli.contracts.bundle import load
    from lacli.motion import frames as framing
    from lacli.motion.frames import Source
    from lacli.motion.given import displacement
    from lacli.motion.patient import Settings, from_given, put, scratch, track
    from lacli.motion.store import check_replaceable, write_all
    from lacli.motion.targets import measured
    from lacli.motion.targets import published as the_seven

    settings = Settings(engine, work_mm, workers, known_motions, harmonics)
    settings.check()
    wanted = None if at is None else _numbers(at, "--at")
    given = None if times is None else _numbers(times, "--times")
    stated = _stated(motion, error_mm)
    if axes not in ("lps", "ras"):
        raise UsageError(f"--axes {axes}: lps (ITK) or ras.")
    check_folder(folder)
    check_replaceable(folder)
    anatomy = load(bundle)
    with progress() as bar:
        task = bar.add_task("tracking", total=1)

        def monitor(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)

        if stated is None:
            sources = framing.find(images)
            moments, origin = framing.cycle_times(sources, given)
            names = [str(source) for source in sources]
            tracked = track(anatomy, sources, moments, settings, folder / "registration", monitor)
        else:
            moved = displacement(anatomy, motion, images, axes, label, monitor)
            moments, origin = framing.cycle_times([Source(Path(f"frame {i}")) for i in range(len(moved))], given)
            names = [str(path) for path in images]
            tracked = from_given(anatomy, moments, moved, stated, motion)
        assert tracked.ed_residual is not None
        found = (
            the_seven(tracked.course, tracked.ed_residual.whole) if published else measured(tracked.course, tracked.model, wanted)
        )
        notes = {"bundle": str(bundle), "frames": names, "times_from": origin, "published": published}
        partial = scratch(folder)
        try:
            info = write_all(partial, anatomy, tracked, found, notes)
            put(partial, folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        if update_bundle:
            with replacing(bundle / "motion.npz") as temporary:
                shutil.copyfile(folder / "motion.npz", temporary)
    _say(info, tracked, found, folder, as_json)
    if figures:
        _draw(folder, bundle, [str(p) for p in images] if stated is None else [])


def _draw(folder: Path, bundle: Path, images: list[str]) -> None:
    """Pictures are extras: what goes wrong with them is said, and is no failure."""
    from lacli.report.motion_figures import draw_apart

    drawn, trouble = draw_apart(folder, bundle, images)
    if drawn:
        err.print(f"pictures: {', '.join(path.name for path in drawn)}", highlight=False)
    if trouble:
        err.print(f"some pictures could not be drawn: {trouble}", highlight=False)


def _stated(motion: str, error_mm: str | None) -> tuple[float, float] | None:
    """The error of a given motion; None where images are tracked and it is measured."""
    if motion == "images":
        if error_mm is not None:
            raise UsageError("--error-mm is for a given motion; of images that are tracked here the error is measured.")
        return None
    if error_mm is None:
        raise UsageError(f"--motion {motion} needs --error-mm NORMAL,TANGENTIAL (sd, mm): nobody but its maker knows its error.")
    values = _numbers(error_mm, "--error-mm")
    if len(values) != 2 or not all(0.0 < value < 20.0 for value in values):
        raise UsageError(f"--error-mm {error_mm}: two numbers above 0, sd in mm along the normal and tangential (0.3,0.6).")
    return values[0], values[1]


def _numbers(text: str, option: str) -> list[float]:
    try:
        return [float(word) for word in text.replace(" ", ",").split(",") if word]
    except ValueError:
        raise UsageError(f"{option} {text}: give numbers separated by commas.") from None


def _say(info: dict[str, Any], tracked: Any, found: Any, folder: Path, as_json: bool) -> None:
    phases = tracked.course.phases
    if as_json:
        values = {
            name: {"mean": float(mean), "sd": float(sd)}
            for name, mean, sd in zip(found.targets.names, found.targets.mean, found.targets.sd, strict=True)
        }
        print_json({"folder": str(folder), **info, "targets": values})
        return
    shown = [
        [name, float(mean), float(sd)]
        for name, mean, sd, time in zip(found.targets.names, found.targets.mean, found.targets.sd, found.time, strict=True)
        if time is None
    ]
    print_table(f"at end-systole, {phases.es:.3f} of the RR interval", ["target", "mean", "sd"], shown)
    err.print(f"frames' times: {info['times_from']}; the nearest frame to ES is {phases.es_gap:.3f} of the RR interval away.")
    out.print(
        f"written: {folder} (motion.npz, targets.toml, transients.csv, frames/, {len(found.targets.names)} targets)",
        highlight=False,
    )
