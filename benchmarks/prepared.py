"""A synthetic atrium on disk, with the motion of its annulus, made once. Used by benchmarks that keep their runs."""

from __future__ import annotations

from pathlib import Path

from lacli.contracts import bundle as bundles
from lacli.contracts.motion import save_motion
from lacli.synthetic.atrium import synthesize


def prepared(out: Path, seed: int, cell_size_mm: float) -> Path:
    """The bundle's folder below ``out``, for that seed and cell size (mm)."""
    folder = out / f"bundle_{seed}_{cell_size_mm:g}mm"
    if not folder.is_dir():
        bundle, motion = synthesize(seed, None, cell_size_mm=cell_size_mm)
        bundles.save(bundle, folder)
        save_motion(motion, folder)
    return folder
