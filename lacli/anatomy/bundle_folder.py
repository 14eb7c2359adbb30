"""The folder of a bundle: which files of it are ours, and may go where another bundle takes its place."""

from __future__ import annotations

from pathlib import Path

from lacli.base.errors import AnatomyError

# all that is written into a bundle's folder, by whom; it is made again with the bundle, or of no use to a new one
BUNDLE = ("wall.vtu", "boundary.vtp", "anatomy.json")
MESHED = ("landmarks.toml", "quality.json", "quality.txt")
PICTURES = ("openings.png", "uac.png", "regions.png", "fibres.png", "thickness.png", "cuts.png")
IMAGES = ("labels.nrrd", "ct.nrrd")  # by `lacli synthesize --image`
LATER = ("motion.npz", "accuracy.json")  # by `lacli synthesize` and `lacli track`; by `lacli tradeoff`
OURS = frozenset((*BUNDLE, *MESHED, *PICTURES, *IMAGES, *LATER))


def check_replaceable(folder: Path) -> None:
    """Before a new bundle takes the folder's place: AnatomyError where files of somebody else would go with the old one."""
    if not folder.is_dir():
        return
    others = sorted(p.name for p in folder.iterdir() if not (p.name in OURS or p.name.startswith(".part-")))
    if others:
        raise AnatomyError(
            f"{folder}: also holds {', '.join(others)}, and would be replaced whole; move that away, or choose another folder."
        )
