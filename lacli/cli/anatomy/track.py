"""``lacli track``: the motion of a patient's atrium from a gated CT, and targets for its calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.api import motion as api
from lacli.base.errors import UsageError
from lacli.cli.terminal.console import err, one_bar, out, print_json, print_table
from lacli.cli.terminal.modes import refuse


def command(
    ctx: typer.Context,
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
    priors: Annotated[
        Path | None,
        typer.Option(
            help="What is known of inputs beside the images, as measured pressures (TOML, [priors.NAME]); for targets.toml."
        ),
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
    if motion != "images":
        refuse(ctx, f"with --motion {motion}", "--engine", "--work-mm", "--workers", "--known-motions", "--harmonics")
    if motion in ("images", "labels"):
        refuse(ctx, f"with --motion {motion}", "--axes")
    if motion != "labels":
        refuse(ctx, f"with --motion {motion}", "--label")
    if published:
        refuse(ctx, "with --published, whose targets are of end-systole", "--at")
    with one_bar("tracking") as show:
        found = api.track(
            images, bundle, folder, times=_numbers(times, "--times"), engine=engine, motion=motion, axes=axes, label=label,
            error_mm=_numbers(error_mm, "--error-mm"), published=published, at=_numbers(at, "--at"), priors=priors,
            work_mm=work_mm, workers=workers, known_motions=known_motions, harmonics=harmonics, update_bundle=update_bundle,
            figures=figures, progress=show,
        )  # fmt: skip
    _say(found, as_json)
    if found.pictures:
        err.print(f"pictures: {', '.join(path.name for path in found.pictures)}", highlight=False)
    for text in found.warnings:
        err.print(text, highlight=False)


def _numbers(text: str | None, option: str) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(word) for word in text.replace(" ", ",").split(",") if word]
    except ValueError:
        raise UsageError(f"{option} {text}: give numbers separated by commas.") from None


def _say(found: api.Tracking, as_json: bool) -> None:
    targets, phases = found.targets.targets, found.tracked.course.phases
    rows = list(zip(targets.names, targets.mean.tolist(), targets.sd.tolist(), found.targets.time, strict=True))
    if as_json:
        values = {name: {"mean": mean, "sd": sd} for name, mean, sd, _ in rows}
        print_json({"folder": str(found.folder), **found.report, "targets": values})
        return
    shown = [[name, mean, sd] for name, mean, sd, time in rows if time is None]
    print_table(f"at end-systole, {phases.es:.3f} of the RR interval", ["target", "mean", "sd"], shown)
    err.print(
        f"frames' times: {found.report['times_from']}; the nearest frame to ES is {phases.es_gap:.3f} of the RR interval away."
    )
    if shrinkage := found.report["shrinkage"]:
        told = ", ".join(f"{kind} {-100.0 * part['share']:.1f} +- {100.0 * part['sd']:.1f} %" for kind, part in shrinkage.items())
        err.print(
            f"registration finds too little motion, by known motions: {told}; undone in targets and transients.", highlight=False
        )
    ring = found.report["annulus"]
    undone = f", {-100.0 * ring['share']:.1f} +- {100.0 * ring['sd']:.1f} % of it undone" if shrinkage else ""
    err.print(
        f"the mitral annulus, which moves simulations: {ring['es_displacement_mm']:.2f} +- {ring['es_error_mm']:.2f} mm at "
        f"end-systole{undone}.",
        highlight=False,
    )
    out.print(
        f"written: {found.folder} (motion.npz, targets.toml, transients.csv, frames/, {len(targets.names)} targets)",
        highlight=False,
    )
