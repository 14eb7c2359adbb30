"""A wave's matched region as a file: checked when read."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path

import numpy as np

from lacli.base.schema import Array, array_file, unfit, write_arrays
from lacli.inference.box import Box
from lacli.inference.matching.matching import Match
from lacli.inference.matching.nroy import RegionSample

# numbers: volume, its sd, acceptance, correlation, evaluations; share, its sd, change: unknown ones are NaN
_SCHEMA = {
    "points": Array(shape=("n", "d")),
    "level": Array(shape=("n",), least=0.0, most=1.0),
    "numbers": Array(shape=(8,), finite=False),
}


def save_match(path: Path, found: Match, identity: str) -> None:
    """Write the region to an .npz file, with what it was made from (the text of an identity), whole or not at all."""
    points, level, *rest = astuple(found.sample)
    numbers = np.array([*rest, found.share, found.share_sd, found.change], float)
    write_arrays(path, {"points": points, "level": level, "numbers": numbers, "identity": identity})


def load_match(path: Path, box: Box) -> Match:
    """Read what ``save_match`` wrote of a region of the box; InputError if it cannot be."""
    with array_file(path, "a matched region", "Remove it to match anew.", sealed=True) as file:
        a = file.read(_SCHEMA)
        volume, volume_sd, acceptance, correlation, evaluations, share, share_sd, change = (float(v) for v in a["numbers"])
        if a["points"].shape[1] != box.d or not len(a["points"]):
            raise unfit(f"its points are of shape {a['points'].shape}, {box.d} inputs are expected")
        if not box.contains(a["points"]).all():
            raise unfit("a point of it is out of the box")
        if not (0 < share <= 1 and share_sd >= 0 and evaluations >= 0 and np.isfinite(share_sd)):
            raise unfit(f"its share of the box is {share:g} with standard error {share_sd:g}")
    sample = RegionSample(a["points"], a["level"], volume, volume_sd, acceptance, correlation, int(evaluations))
    return Match(sample, share, share_sd, change)
