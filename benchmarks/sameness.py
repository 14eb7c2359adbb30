"""Products of commands as plain content, and whether two are the same (bit for bit, or to the solver's tolerance)."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pandas as pd

UNTOLD = {"cpu_s", "peak_memory_mb", "wall_s", "attempts", "message"}  # cost, not content


def same(one: object, other: object) -> str:
    """``bit``, ``tolerance`` (numbers within 1e-6 of each other) or ``NO``."""
    if repr(one) == repr(other):
        return "bit"
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        kinds = {same(one[key], other[key]) for key in one}
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        kinds = {same(a, b) for a, b in zip(one, other, strict=True)}
    elif isinstance(one, float) and isinstance(other, float) and abs(one - other) <= 1e-6 * max(1.0, abs(one)):
        return "tolerance"
    else:
        return "NO"
    return "NO" if "NO" in kinds else "tolerance" if "tolerance" in kinds else "bit"


def features(at: Path) -> dict[str, dict[str, float]]:
    """Features of all runs below ``at``, by key, without their cost."""
    found = {file.parent.name: json.loads(file.read_text()) for file in sorted((at / "runs").glob("*/features.json"))}
    return {key: {n: v for n, v in values.items() if n not in UNTOLD} for key, values in found.items()}


def rows(at: Path) -> object:
    """A design's table without its costs."""
    frame = pd.read_csv(at / "design.csv", float_precision="round_trip")
    return frame.drop(columns=[name for name in frame if name in UNTOLD]).to_dict("list")


def bundle_of(at: Path) -> object:
    """A bundle's files."""
    return {name: hashlib.sha256((at / "bundle" / name).read_bytes()).hexdigest() for name in ("wall.vtu", "boundary.vtp")}


def chains(at: Path) -> object:
    """A calibration's chain and result."""
    with np.load(at / "calibration" / "chain.npz", allow_pickle=False) as arrays:
        content = {name: arrays[name].tolist() for name in arrays.files}
    return {"chain": content, "result": json.loads((at / "calibration" / "result.json").read_text())["posterior"]}
