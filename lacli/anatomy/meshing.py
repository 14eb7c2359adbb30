"""A bundle's folder from a label map or a surface: what is read, checked, meshed, written whole, and drawn."""

from __future__ import annotations

import glob
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy import build, quality
from lacli.anatomy.build import Built, Options, Say
from lacli.anatomy.bundle_folder import check_inputs, check_replaceable
from lacli.anatomy.inputs import image, labelled
from lacli.anatomy.inputs.meshes import anything, meshfile, surfacefile
from lacli.anatomy.opening_pictures import draw_readings
from lacli.anatomy.openings import landmarks
from lacli.anatomy.openings.finding import OpeningsError
from lacli.base.errors import AnatomyError, StorageError, UsageError
from lacli.base.processes.locks import lock
from lacli.base.processes.process import answer_of
from lacli.base.version import __version__
from lacli.contracts import bundle as contract

FIBRE_RULES = ("laplace-dirichlet", "uac")
LONGEST_WAVE_MM = 30.0  # longer ones are an atrium's own shape
STEPS = 6  # of which ``built_from`` tells


def check_options(options: Options, frame: str, unit: str | None) -> None:
    """Before the work: whether the choices are possible. Raises UsageError that names the option."""
    for name, value, low, high in (
        ("--cell-size-mm", options.cell_size_mm, 0.2, 10.0),
        ("--thickness-mm", options.thickness_mm, 0.2, 8.0),
        ("--ring-width-mm", options.ring_width_mm, 0.5, 10.0),
    ):
        if not low <= value <= high:
            raise UsageError(f"{name} is {value:g} mm; it must be {low:g} to {high:g} mm.")
    if options.wave_mm is not None and not 0.0 <= options.wave_mm <= LONGEST_WAVE_MM:
        raise UsageError(f"--wave-mm is {options.wave_mm:g} mm; it must be 0 (nothing is evened) to {LONGEST_WAVE_MM:g} mm.")
    if options.order not in (1, 2):
        raise UsageError(f"--order is {options.order}; it must be 1 or 2.")
    if options.layers is not None and not 1 <= options.layers <= 20:
        raise UsageError(f"--layers is {options.layers}; it must be 1 to 20.")
    if frame not in ("lps", "ras", "unknown"):
        raise UsageError(f"--frame is '{frame}'; it must be lps, ras or unknown.")
    if unit is not None and unit not in ("mm", "um", "cm", "m"):
        raise UsageError(f"--unit is '{unit}'; it must be mm, um, cm or m.")


@contextmanager
def naming(source: Path) -> Iterator[None]:
    """What is wrong with the anatomy, with the name of the file it is in."""
    try:
        yield
    except AnatomyError as error:
        if str(error).startswith(f"{source}:"):
            raise
        raise AnatomyError(f"{source}: {error}") from error


@contextmanager
def explaining(folder: Path) -> Iterator[None]:
    """Openings that are not certain are drawn, and written as landmarks to correct, beside the bundle's ``folder``."""
    try:
        yield
    except OpeningsError as error:
        if not error.readings or error.surface is None:
            raise
        folder.absolute().parent.mkdir(parents=True, exist_ok=True)
        file, picture = (folder.with_name(f"{folder.name}-{end}") for end in ("landmarks.toml", "readings.png"))
        with storing(file):
            landmarks.write(error.readings[0][1], file)
        drawn = draw_readings(error.surface, error.readings, picture)
        words = f"What was found is drawn in {picture} and written to {file}" if drawn else f"What was found is written to {file}"
        raise OpeningsError(
            f"{error} {words}: correct that file and give it back with --landmarks (what "
            "is right there needs confirmed = true; what is neither confirmed nor changed is found anew).",
            error.readings,
        ) from error


@contextmanager
def storing(folder: Path) -> Iterator[None]:
    """What the system says while writing, as a StorageError."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise StorageError(f"{folder}: cannot be written ({reason}: {error.filename}); nothing was left there.") from error


def check_new(folder: Path, also: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Before the work: nothing else stands in the bundle's place, no input either, and the other files can be written."""
    if folder.exists() and any(folder.iterdir()) and not (folder / "wall.vtu").is_file():
        raise UsageError(f"{folder}: the folder exists and holds something else than a bundle; choose another --out.")
    check_inputs(folder, inputs, also)
    check_replaceable(folder, [path.name for path in also if path.resolve().parent == folder.resolve()])
    for path in also:
        meshfile.check_ending(path)
        if not path.absolute().parent.is_dir() or not os.access(path.absolute().parent, os.W_OK | os.X_OK):
            raise StorageError(f"{path}: cannot be written, its folder does not exist or gives no permission; change --also.")


def built_from(
    source: Path,
    la: int | None,
    lv: int | None,
    wall: int | None,
    options: Options,
    landmarks_file: Path | None,
    frame: str,
    unit: str | None,
    say: Say,
    meaning: str | None = None,
    preset: str | None = None,
) -> Built:
    """The bundle of a label map or a surface, by the file's ending; ``say`` hears of each of the STEPS.

    la, lv, wall: labels of a map (None: the only one; none); meaning, preset: of labelled.read and labelled.preset, which
    those win over. frame, unit: of a surface. Raises AnatomyError, UsageError.
    """
    if (meaning is not None or preset is not None) and not image.is_image(source):
        raise UsageError(f"{source}: --labels and --preset are for label maps.")
    if meaning is not None and preset is not None:
        raise UsageError("--labels and --preset both say what labels mean; give one of them.")
    meshfile.check_surface(source)
    given = None if landmarks_file is None else landmarks.read(landmarks_file)
    if image.is_image(source):
        labels = image.read_labels(source)
        volumes = image.label_volumes(labels)
        said = labelled.Meaning()
        if meaning is not None:
            said = labelled.read(meaning)
        elif preset is not None:
            said = labelled.preset(preset, set(volumes))
        la = la_label(source, volumes, said.la if la is None else la)
        lv, wall = said.lv if lv is None else lv, said.wall if wall is None else wall
        return build.from_labels(labels, la, lv, options, given, say, wall, said.vessels)
    if not anything.is_mesh(source):
        known = ", ".join((*image.SUFFIXES, *surfacefile.SUFFIXES, ".elem"))
        raise UsageError(f"{source}: the ending is not one of {known}.")
    mesh = anything.read(source)
    axes = {
        "lps": landmarks.LPS,
        "ras": landmarks.Axes(np.array([-1.0, 0, 0]), np.array([0, -1.0, 0]), np.array([0, 0, 1.0]), True),
        "unknown": None,
    }[frame]
    return build.from_mesh(mesh, options, given, axes, say, unit)


def la_label(source: Path, volumes: dict[int, float], la: int | None) -> int:
    """The label of the atrium's blood: ``la``, or the only one. volumes: by label, mL. Raises AnatomyError, UsageError."""
    if not volumes:
        raise AnatomyError(f"{source}: every voxel is 0; the label map is empty.")
    listing = ", ".join(f"{label} ({ml:.3g} mL)" for label, ml in sorted(volumes.items()))
    if la is not None:
        if la not in volumes:
            raise AnatomyError(f"{source}: label {la} has no voxel; the labels are {listing}.")
        return la
    if len(volumes) > 1:
        raise UsageError(
            f"{source}: several labels: {listing}. Say which is the left atrium's blood with --la "
            "(and the left ventricle's with --lv)."
        )
    return next(iter(volumes))


def save(
    source: Path, folder: Path, built: Built, options: Options, also: Sequence[Path], start: float, fibres: str
) -> tuple[contract.Bundle, dict[str, Any]]:
    """The bundle as written and the report on it; everything is written under a temporary name, then swapped in.

    also: files that get the wall too; start: ``time.process_time`` when the work began; fibres: the rule or file, in words.
    """
    report, _ = quality.measure(built.bundle)
    report["measures"] = built.measures
    report["notes"] = list(built.notes)
    report["openings"] = {
        name: {"diameter_mm": o.diameter_mm, "confidence": o.confidence, "source": o.source}
        for name, o in built.landmarks.openings.items()
    }
    report["cpu_s"] = time.process_time() - start
    info = {
        "source": str(source),
        "lacli": __version__,
        "frame": "as the input; images: LPS, mm",
        "options": {**options.__dict__, "fibres": fibres},
        "landmarks": {
            name: {"centre": o.centre.tolist(), "normal": o.normal.tolist()} for name, o in built.landmarks.openings.items()
        },
        "thickness_mm": report["thickness_mm"],
        "volumes_ml": {"cavity": report["cavity_volume_ml"], "wall": report["wall_volume_ml"], **report["region_volume_ml"]},
        "notes": report["notes"],
        **built.bundle.info,
    }
    done = replace(built.bundle, info=info)
    contract.check(done, str(folder))
    folder.absolute().parent.mkdir(parents=True, exist_ok=True)
    with lock(folder.with_name(f".lock-{folder.name}"), "which writes the same bundle"):
        for left in folder.parent.glob(f".*-*-{glob.escape(folder.name)}"):  # by a process that was killed: the lock is ours
            if left.name.startswith((".part-", ".old-")):
                shutil.rmtree(left, ignore_errors=True)
        part, old = (folder.with_name(f".{word}-{os.getpid()}-{folder.name}") for word in ("part", "old"))
        try:
            part.mkdir()
            contract.save(done, part)
            landmarks.write(built.landmarks, part / "landmarks.toml")
            quality.write(report, part)
            if folder.exists():
                folder.replace(old)
            part.replace(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
    for path in also:
        meshfile.write(done, path)
    return done, report


def draw(folder: Path) -> tuple[list[str], str]:
    """Names of the pictures drawn into a bundle's folder, and what went wrong, in words.

    In a process of its own: a broken graphics driver must not end the caller.
    """
    try:
        done = answer_of([sys.executable, "-m", "lacli.anatomy.quality", str(folder)], timeout_s=300)
    except subprocess.TimeoutExpired:
        return [], "The pictures took longer than five minutes and were left out."
    drawn = [line for line in done.stdout.splitlines() if line.endswith(".png")]
    if done.returncode == 0:
        return drawn, ""
    there = ", ".join(drawn) or "none"
    return drawn, f"Some pictures could not be drawn: {there} are there (VTK needs EGL, OSMesa or an X server)."
