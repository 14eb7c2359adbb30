"""The folder of a bundle: which files of it are ours, and may go where another bundle takes its place."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError, InputError, UsageError
from lacli.contracts.identity import file_digest

# all that is written into a bundle's folder, by whom; it is made again with the bundle, or of no use to a new one
BUNDLE = ("wall.vtu", "boundary.vtp", "anatomy.json")
MESHED = ("landmarks.toml", "quality.json", "quality.txt")
PICTURES = ("openings.png", "uac.png", "regions.png", "fibres.png", "thickness.png", "cuts.png")
IMAGES = ("labels.nrrd", "ct.nrrd")  # by `lacli synthesize --image`; or a person put theirs there, which nothing makes again
LATER = ("motion.npz", "accuracy.json")  # by `lacli synthesize` and `lacli track`; by `lacli tradeoff`
OURS = frozenset((*BUNDLE, *MESHED, *PICTURES, *IMAGES, *LATER))
FILES = "files"  # in anatomy.json: digests of the files that were synthesized, by name


def check_replaceable(folder: Path, written_again: Collection[str] = ()) -> None:
    """Before a new bundle takes the folder's place: AnatomyError where files of somebody else would go with the old one.

    written_again: names of files there that the caller writes over as it was told to.
    """
    if not folder.is_dir():
        return
    ours = OURS.difference(IMAGES).union(written_again)
    names = [p.name for p in folder.iterdir() if not (p.name in ours or p.name.startswith(".part-"))]
    others = sorted(name for name in names if not (name in IMAGES and _synthesized(folder, name)))
    if others:
        raise AnatomyError(
            f"{folder}: also holds {', '.join(others)}, and would be replaced whole; move that away, or choose another folder."
        )


def check_inputs(folder: Path, inputs: Sequence[Path], also: Sequence[Path]) -> None:
    """Before the work: UsageError where what is read would be removed with the folder, or written over by a file of ``also``."""
    for file in inputs:
        if folder.resolve() in file.resolve().parents:
            raise UsageError(f"{file}: lies in {folder}, which is replaced whole; choose another --out, or move it out of there.")
        if file.resolve() in [other.resolve() for other in also]:
            raise UsageError(f"{file}: is an input, and would be written over; choose another --also.")


def _synthesized(folder: Path, name: str) -> bool:
    """Whether an image there is as it was synthesized with the bundle: its digest stands in anatomy.json."""
    try:
        return bool(read_json(folder / "anatomy.json")[FILES][name] == file_digest(folder / name))
    except (InputError, OSError, KeyError, TypeError):
        return False
