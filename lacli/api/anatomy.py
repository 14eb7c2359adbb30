"""Anatomy in one call each: a parametric atrium, a bundle from an image or a surface, epicardial fat."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.api.progress import Cancel, OnProgress, Stage, check
from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.anatomy.wall.fat import Fat
    from lacli.contracts.bundle import Bundle


@dataclass(frozen=True)
class Meshing:
    """A bundle made from an image or a surface, the folder it is in, and the report on its quality.

    report: numbers with their units in their names (openings, volumes, thickness, cell quality, notes); pictures: names of
    those drawn into the folder; warnings: what a user must know of it.
    """

    folder: Path
    bundle: Bundle
    report: dict[str, Any]
    pictures: tuple[str, ...]
    warnings: tuple[str, ...]


def mesh(
    source: Path,
    folder: Path,
    *,
    la: int | None = None,
    lv: int | None = None,
    wall: int | None = None,
    labels: str | None = None,
    preset: str | None = None,
    cell_size_mm: float = 3.5,
    thickness_mm: float = 2.0,
    order: int = 2,
    layers: int | None = None,
    ring_width_mm: float = 2.5,
    smoothing_mm: float | None = None,
    wave_mm: float | None = None,
    landmarks: Path | None = None,
    fibres: str = "laplace-dirichlet",
    frame: str = "unknown",
    unit: str | None = None,
    accept_low_confidence: bool = False,
    also: Sequence[Path] = (),
    figures: bool = False,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Meshing:
    """The anatomy bundle of a label map or a surface, written whole to ``folder``, with its openings in landmarks.toml.

    Points (n, 3) are in mm: of images in ITK's LPS, else in the surface's own axes. la, lv, wall: labels of the atrium's
    blood (None: the only one there), the ventricle's, the atrial wall; labels: more of them, ``la=2,lv=3,laa=61,pv=53``;
    preset: the same by the name of a published set; layers: cells through the wall (None: thickness over
    cell size); smoothing_mm: of voxels (None: 1.25 coarsest spacings); wave_mm: shorter waves of the wall's surface are taken
    out (0: none; None: of label maps those of the voxels, of surfaces none); landmarks: a landmarks.toml that wins over what is
    found; fibres: ``laplace-dirichlet``, ``uac``, or a file with fibres; frame: of a surface, ``lps``, ``ras`` or
    ``unknown``; unit: of a mesh file (None: told from its size); also: files that get the wall too.
    Raises AnatomyError, UsageError, StorageError, Cancelled (nothing is written then).
    """
    from lacli.anatomy import meshing
    from lacli.anatomy.build import Options
    from lacli.anatomy.inputs.meshes import meshfile
    from lacli.base.files import check_folder
    from lacli.base.threads import one_thread

    own = None if fibres in meshing.FIBRE_RULES else Path(fibres)
    rule = fibres if own is None else meshing.FIBRE_RULES[0]
    options = Options(
        cell_size_mm, thickness_mm, order, ring_width_mm, rule, smoothing_mm, wave_mm, layers, accept_low_confidence
    )
    meshing.check_options(options, frame, unit)
    check_folder(folder)
    # landmarks may lie there: they are written again, with what they say
    meshing.check_new(folder, also, [source] if own is None else [source, own])
    own_fibres = None if own is None else meshfile.read_fibres(own)
    start = time.process_time()
    stage = Stage("reading", meshing.STEPS, progress, cancel).begin()
    with meshing.naming(source), meshing.explaining(folder), one_thread():
        built = meshing.built_from(source, la, lv, wall, options, landmarks, frame, unit, stage.next, labels, preset)
    if own_fibres is not None:
        built = replace(built, bundle=replace(built.bundle, fibre=meshfile.carry_fibres(built.bundle, *own_fibres)))
    with meshing.storing(folder), one_thread():
        bundle, report = meshing.save(source, folder, built, options, also, start, str(own or fibres))
    drawn, trouble = meshing.draw(folder) if figures else ([], "")
    return Meshing(folder, bundle, report, tuple(drawn), (trouble,) if trouble else ())


@dataclass(frozen=True)
class Synthesis:
    """A synthetic atrium or patient: its folder, and what is in it (numbers with their units in their names)."""

    folder: Path
    report: dict[str, Any]


def synthesize(
    folder: Path,
    *,
    seed: int = 1,
    volume_ml: float | None = None,
    thickness_mm: float = 2.0,
    cell_size_mm: float = 4.0,
    order: int = 2,
    frames: int = 10,
    descent_mm: float = 8.0,
    cohort: int = 0,
    image: bool = False,
    voxel_mm: float = 0.6,
    gated: bool = False,
    noise_hu: float = 25.0,
    blur: float = 0.6,
    motion_blur: float = 0.0,
    contrast_drift_hu: float = 0.0,
    heart_rate: float = 65.0,
    parameters: Mapping[str, float] | None = None,
    arm: str | None = None,
    targets: str = "published",
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> tuple[Synthesis, ...]:
    """Parametric left atria from their seeds: one in ``folder``, or a ``cohort`` of folders there, seeds following on.

    Points (n, 3) are in LPS mm. volume_ml: of the cavity (None: the seed's own, 47 to 135 mL); frames: of the annulus' motion
    over the cycle, descent_mm: how far it descends; image: also labels.nrrd and ct.nrrd of ``voxel_mm``. gated: a patient
    instead, its bundle, a gated CT of a simulated cycle and its truth: noise_hu its noise (sd, HU), blur in voxels (sd),
    motion_blur the exposure as a fraction of the RR interval, contrast_drift_hu the blood's fall over the cycle, heart_rate
    in beats per minute, parameters known ones by name with unit. arm: a cohort for ``lacli cohort`` instead, its targets
    simulated on a finer mesh at drawn parameters: ``heterogeneous`` (every region its own stiffness), ``control`` (one
    everywhere), ``thickness`` (one, in a wall of varying thickness); targets: ``published``; ``motion``, which adds the
    components of the displacement and the area strain of each region; or ``course``, which adds three frames before
    end-systole. A folder that was made from the same is kept.
    Raises UsageError, AnatomyError (a folder holds something else), StorageError, Cancelled.
    """
    from lacli.base.files import check_folder
    from lacli.contracts.parameters import parameter_box
    from lacli.synthetic.atrium_folder import write_atrium
    from lacli.synthetic.gated import Acquisition
    from lacli.synthetic.gated_case import write_patient

    if cohort < 0 or seed < 0:
        raise UsageError("--seed and --cohort must not be negative.")
    if not 0.2 <= voxel_mm <= 3.0:
        raise UsageError(f"--voxel-mm must lie between 0.2 and 3 mm, got {voxel_mm:g}.")
    wanted = {"volume_ml": volume_ml, "thickness_mm": thickness_mm, "cell_size_mm": cell_size_mm, "order": order}
    moved = {"frames": frames, "descent_mm": descent_mm}
    acquisition = Acquisition(frames, (voxel_mm,) * 3, noise_hu, blur, motion_blur, contrast_drift_hu)
    given = dict(parameters or {})
    if gated:
        acquisition.check()
        if not 20.0 <= heart_rate <= 250.0:
            raise UsageError(f"--heart-rate is {heart_rate:g}; it must be 20 to 250 beats per minute.")
        for name, value in given.items():
            parameter_box([name])
            if not value >= 0:
                raise UsageError(f"--parameter {name}={value:g}: write it as name=number, not negative.")
    if arm is not None:
        return _arm(
            folder, arm, range(seed, seed + cohort), {**wanted, **moved}, image or gated, targets,
            Stage("", cohort, progress, cancel),
        )  # fmt: skip
    check_folder(folder)
    places = [(seed + i, folder / f"la{seed + i:02d}" if cohort else folder) for i in range(max(cohort, 1))]
    made = []
    stage = Stage("synthesizing", len(places), progress, cancel).begin()
    for number, place in places:
        if gated:
            atrium = {**wanted, "descent_mm": descent_mm}

            def tell(what: str, done: int, total: int, name: str = place.name) -> None:
                stage.of(f"{name}: {what}", done, total)

            report = write_patient(place, number, atrium, given, acquisition, heart_rate, tell)
        else:
            report = write_atrium(number, place, {**wanted, **moved}, voxel_mm if image else None)
            stage.step()
        made.append(Synthesis(place, report))
    return tuple(made)


def _arm(
    folder: Path, arm: str, seeds: Sequence[int], atrium: Mapping[str, Any], imaged: bool, targets: str, stage: Stage
) -> tuple[Synthesis, ...]:
    from lacli.base.files import check_folder
    from lacli.synthetic.cohort import ARMS, TARGETS, write_cohort

    known = next((one for one in ARMS if one == arm), None)
    if known is None:
        raise UsageError(f"--arm {arm}: must be one of {', '.join(ARMS)}.")
    if targets not in TARGETS:
        raise UsageError(f"--targets {targets}: must be one of {', '.join(TARGETS)}.")
    if not seeds:
        raise UsageError("--arm is of a cohort; say with --cohort how many patients.")
    if imaged:
        raise UsageError("--arm simulates the targets; leave --gated and --image out.")
    check_folder(folder)
    begun: list[str] = []

    def tell(name: str) -> None:
        stage.name = name
        stage.reach(len(begun))
        begun.append(name)

    stage.begin()
    rows = write_cohort(folder, seeds, known, atrium, tell, targets)
    stage.reach(len(seeds))
    return tuple(Synthesis(Path(row["folder"]), row) for row in rows)


@dataclass(frozen=True)
class FatSegmentation:
    """Epicardial fat in each published window of HU (volumes in mL, whole and by region), and the folder of its files.

    report: what fat.json holds; notes: what a user must know of the images.
    """

    folder: Path
    windows: dict[str, Fat]
    report: dict[str, Any]
    notes: tuple[str, ...]


def fat(
    ct: Path,
    folder: Path,
    *,
    bundle: Path | None = None,
    labels: Path | None = None,
    la: int | None = None,
    reach_mm: float = 5.0,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> FatSegmentation:
    """The epicardial fat of a CT (HU) within ``reach_mm`` of the atrium's blood pool; its surface and voxels go to ``folder``.

    Volumes are in mL, points (n, 3) in LPS mm. The blood pool is that of ``labels`` (its label ``la``; None: the only one),
    else the cavity of the ``bundle``, whose regions are counted where it is given.
    Raises UsageError, AnatomyError where there is no fat, StorageError, Cancelled (nothing is written then).
    """
    from lacli.anatomy.inputs import image as images
    from lacli.anatomy.meshing import naming, storing
    from lacli.anatomy.wall import fat as segmentation
    from lacli.anatomy.wall import fat_files, fitting
    from lacli.base.files import check_folder
    from lacli.contracts.bundle import load

    if bundle is None and labels is None:
        raise UsageError(
            "Give the blood pool: --anatomy BUNDLE, or --labels MAP with --la LABEL, or both (regions come from the bundle)."
        )
    if not 0.5 <= reach_mm <= 20.0:
        raise UsageError(f"--within-mm is {reach_mm:g} mm; it must be 0.5 to 20 mm.")
    check_folder(folder)
    stage = Stage("reading", 2 + len(segmentation.WINDOWS), progress, cancel).begin()
    volume = images.read(ct)
    anatomy = None if bundle is None else load(bundle)
    stage.next("blood pool")
    pool, seen = fat_files.pool_of(labels, la, anatomy)
    notes = [*(f"{ct}: {note}" for note in volume.doubts(pool.points.mean(axis=0))), *seen]
    with naming(ct):
        notes += fitting.check_pool(volume, pool)
        if anatomy is not None:
            fitting.check_bundle(anatomy, pool.points)
    found = {}
    for window in segmentation.WINDOWS:
        stage.next(f"fat, {window} window")
        with naming(ct):
            found[window] = segmentation.segment(volume, pool, anatomy, window, reach_mm)
    if any(one.edge is None for one in found.values()):
        notes.append(
            f"{ct}: no edge of the blood is seen at the pool's surface (no contrast, or the pool is another's): blood that "
            "shines through the wall is not taken off the fat"
        )
    check(cancel, "the segmentation of fat")
    stage.next("mesh")
    with storing(folder):
        report = fat_files.save(found, folder, ct, reach_mm, notes)
    return FatSegmentation(folder, found, report, tuple(notes))
