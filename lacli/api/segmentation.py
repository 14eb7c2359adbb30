"""Blood pool, wall and fat from a CT and a rough label map, in one call."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.api.progress import Cancel, OnProgress, Stage, check
from lacli.base.errors import AnatomyError, UsageError

if TYPE_CHECKING:
    from lacli.anatomy.segmentation.road import Options, Segmented

STEPS = 6


def segment(
    ct: Path,
    labels: Path,
    out: Path,
    options: Options,
    *,
    anatomy: Path | None = None,
    picture: bool = True,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Segmented:
    """Pool, wall and fat of a CT (HU) from a rough label map on the same grid, written to ``out`` and beside it.

    out: label map (its ending says the format); beside it, of the same name, .json (thickness per region with its error, mm),
    .vtp (endocardium with thickness, bound, flag) and .png (slices with contours). anatomy: a bundle of the same patient whose
    regions are reported, else the patient's six sides. Everything is written or nothing. Raises InputError, AnatomyError,
    UsageError, StorageError, Cancelled.
    """
    from lacli.anatomy.inputs import image
    from lacli.anatomy.segmentation import road
    from lacli.base.files import check_file, storing
    from lacli.contracts.bundle import load

    if not image.is_image(out):
        raise UsageError(f"--out {out}: the ending is not one of {', '.join(image.SUFFIXES)}.")
    if out.absolute() in (ct.absolute(), labels.absolute()):
        raise UsageError(f"--out {out} is an input; choose another name.")
    check_file(out)
    stage = Stage("segmenting", STEPS, progress, cancel).begin()
    bundle = None if anatomy is None else load(anatomy)
    volume, rough = image.read(ct), image.read_labels(labels)
    stage.step()
    try:
        found = road.segment(volume, rough, options, bundle, lambda _: stage.step())
    except AnatomyError as error:
        raise AnatomyError(f"{ct} with {labels}: {error}") from error
    check(cancel, "segmenting")
    with storing(out), tempfile.TemporaryDirectory(prefix=".part-", dir=_made(out.parent)) as part:
        _write(found, volume, Path(part), out, ct, labels, picture)
        for file in sorted(Path(part).iterdir(), key=lambda p: p.name == out.name):  # the map last: it says that all is there
            shutil.move(file, out.parent / file.name)
    stage.reach(STEPS)
    return found


def stem(out: Path) -> str:
    """The label map's name without its ending, which the files beside it share."""
    from lacli.anatomy.inputs.image import SUFFIXES

    ending = max((s for s in SUFFIXES if out.name.lower().endswith(s)), key=len)
    return out.name[: -len(ending)]


def report(found: Segmented, ct: Path, labels: Path) -> dict[str, Any]:
    """What was found, as one JSON document: HU, thickness per region with its error (mm), volumes (mL), notes."""
    from lacli.anatomy.segmentation.wall import FLAGS

    area = found.wall.area
    return {
        "ct": str(ct),
        "labels": str(labels),
        "numbers": asdict(found.numbers),
        "blood": asdict(found.blood),
        "myocardium": asdict(found.muscle),
        "blur_mm": found.wall.blur_mm,
        "volume_ml": {n: found.volume_ml(v) for n, v in asdict(found.numbers).items() if v is not None},
        "thickness": [{**asdict(r), "doubtful": r.doubtful} for r in found.thickness],
        "share_of_surface": {words: float(area[found.wall.flag == kind].sum() / area.sum()) for kind, words in FLAGS.items()},
        "notes": list(found.notes),
    }


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _write(found: Segmented, volume: Any, part: Path, out: Path, ct: Path, labels: Path, picture: bool) -> None:
    import numpy as np

    from lacli.anatomy import pictures
    from lacli.anatomy.inputs import image
    from lacli.base.files import write_json
    from lacli.report import segmentation_figures

    name = stem(out)
    image.write(found.labels, part / out.name)
    write_json(part / f"{name}.json", report(found, ct, labels))
    mesh = pictures.polydata(found.wall.surface)
    for key, values in (
        ("thickness_mm", found.wall.thickness), ("flag", found.wall.flag), ("error_mm", found.wall.error),
        ("bound_mm", np.where(np.isfinite(found.wall.bound), found.wall.bound, np.nan)),
    ):  # fmt: skip
        mesh.point_data[key] = values
    mesh.save(part / f"{name}.vtp")
    if picture:
        segmentation_figures.slices(volume, found, part / f"{name}.png")
