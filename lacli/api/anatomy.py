"""Anatomy in one call each: a bundle from an image or a surface."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.api.progress import Cancel, OnProgress, Stage

if TYPE_CHECKING:
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
    cell size); smoothing_mm: of voxels (None: 1.25 coarsest spacings); landmarks: a landmarks.toml that wins over what is
    found; fibres: ``laplace-dirichlet``, ``uac``, or a file with fibres; frame: of a surface, ``lps``, ``ras`` or
    ``unknown``; unit: of a mesh file (None: told from its size); also: files that get the wall too.
    Raises AnatomyError, UsageError, StorageError, Cancelled (nothing is written then).
    """
    from lacli.anatomy import meshing
    from lacli.anatomy.build import Options
    from lacli.anatomy.inputs import meshfile
    from lacli.base.files import check_folder

    own = None if fibres in meshing.FIBRE_RULES else Path(fibres)
    rule = fibres if own is None else meshing.FIBRE_RULES[0]
    options = Options(cell_size_mm, thickness_mm, order, ring_width_mm, rule, smoothing_mm, layers, accept_low_confidence)
    meshing.check_options(options, frame, unit)
    check_folder(folder)
    meshing.check_new(folder, also)
    own_fibres = None if own is None else meshfile.read_fibres(own)
    start = time.process_time()
    stage = Stage("reading", meshing.STEPS, progress, cancel).begin()
    with meshing.naming(source), meshing.explaining(folder):
        built = meshing.built_from(source, la, lv, wall, options, landmarks, frame, unit, stage.next, labels, preset)
    if own_fibres is not None:
        built = replace(built, bundle=replace(built.bundle, fibre=meshfile.carry_fibres(built.bundle, *own_fibres)))
    with meshing.storing(folder):
        bundle, report = meshing.save(source, folder, built, options, also, start, str(own or fibres))
    drawn, trouble = meshing.draw(folder) if figures else ([], "")
    return Meshing(folder, bundle, report, tuple(drawn), (trouble,) if trouble else ())
