"""The openings of an atrium: planes of valve, veins and appendage, named, with confidences; ``landmarks.toml`` in and out.

An opening whose name is in doubt is written unconfirmed, with a check sum of its numbers. Given back as it is, it is no answer:
it is found anew. It counts once somebody says so (``confirmed = true``) or has changed its numbers.
"""

from __future__ import annotations

import json
import os
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.documents import read_toml
from lacli.base.errors import AnatomyError
from lacli.contracts.labels import OPENINGS

SIDES = ("lateral", "septal", "lspv_roof", "rspv_roof")


@dataclass(frozen=True)
class Opening:
    """A cut: centre (3,) mm, normal (3,) out of the atrium, beyond (3,) mm a point of what is cut off; confidence 0 .. 1.

    cap: label of the surface's own cap that closes it where no cut is needed, else 0; takes: the opening whose ring and plane a
    further vein takes; shares: the other vein of a common trunk, whose opening a carina parts in two; confirmed: whether its
    name is certain, or somebody's word.
    """

    name: str
    centre: FloatArray
    normal: FloatArray
    beyond: FloatArray
    diameter_mm: float
    confidence: float
    source: str
    cap: int = 0
    takes: str = ""
    shares: str = ""
    confirmed: bool = True


@dataclass(frozen=True)
class Landmarks:
    """All openings by name ("extra1" ... are veins beyond four), and points (3,) mm of the side lines where known."""

    openings: dict[str, Opening]
    sides: dict[str, FloatArray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Axes:
    """Unit directions left, posterior, superior; ``known`` if they come from the image, not from the shape."""

    left: FloatArray
    posterior: FloatArray
    superior: FloatArray
    known: bool


LPS = Axes(np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]), True)


def write(landmarks: Landmarks, path: Path) -> None:
    """Write ``landmarks.toml``: one table per opening, one of side points; mm in the frame of the input."""
    import tomli_w

    document: dict[str, Any] = {
        "about": "Openings of the left atrium, mm, in the input's frame (images: LPS). normal points out of the atrium. "
        "Edit and give back with --landmarks: what stands here wins, what is left out is found. What has confirmed = false is "
        "in doubt: correct its numbers, or write confirmed = true if they are right; left as it is, it is found anew."
    }
    for name, opening in landmarks.openings.items():
        table = {
            "centre": [round(float(x), 3) for x in opening.centre],
            "normal": [round(float(x), 4) for x in opening.normal],
            "beyond": [round(float(x), 3) for x in opening.beyond],
            "diameter_mm": round(opening.diameter_mm, 2),
            "confidence": round(opening.confidence, 2),
            "source": opening.source,
            **{key: value for key in ("takes", "shares") if (value := getattr(opening, key))},
        }
        document[name] = table if opening.confirmed else {**table, "confirmed": False, "as_found": _sum(table)}
    if landmarks.sides:
        document["sides"] = {name: [round(float(x), 3) for x in point] for name, point in landmarks.sides.items()}
    temporary = path.with_name(f".part-{os.getpid()}-{path.name}")
    temporary.write_bytes(tomli_w.dumps(document).encode())
    temporary.replace(path)


def read(path: Path) -> Landmarks:
    """Read ``landmarks.toml``, without the openings that are unconfirmed and as they were found; a note names those.

    Raises AnatomyError on an unknown name, or a vector that is not three finite numbers.
    """
    document = read_toml(path, error=AnatomyError, missing="no such file of landmarks")
    openings: dict[str, Opening] = {}
    sides: dict[str, FloatArray] = {}
    doubted: list[str] = []
    for name, table in document.items():
        if name == "about":
            continue
        if name == "sides" and isinstance(table, dict):
            for key, value in table.items():
                if key not in SIDES:
                    raise AnatomyError(f"{path}: unknown side point '{key}'; the known ones are {', '.join(SIDES)}.")
                sides[key] = _vector(path, f"sides.{key}", value)
            continue
        if name not in OPENINGS and not name.startswith("extra"):
            raise AnatomyError(
                f"{path}: unknown opening '{name}'; the known ones are {', '.join(OPENINGS)}, extra1, extra2, sides."
            )
        if not isinstance(table, dict) or "centre" not in table or "normal" not in table:
            raise AnatomyError(f"{path}: [{name}] needs 'centre' (mm) and 'normal' (out of the atrium).")
        if _unconfirmed(path, name, table):
            doubted.append(name)
            continue
        centre, normal = (_vector(path, f"{name}.{key}", table[key]) for key in ("centre", "normal"))
        size = float(np.linalg.norm(normal))
        if size < 1e-9:
            raise AnatomyError(f"{path}: {name}.normal has no direction.")
        beyond = _vector(path, f"{name}.beyond", table["beyond"]) if "beyond" in table else centre + 3.0 * normal / size
        takes, shares = (str(table.get(key, "")) for key in ("takes", "shares"))
        for key, value in (("takes", takes), ("shares", shares)):
            if value and value not in OPENINGS:
                raise AnatomyError(f"{path}: {name}.{key} is '{value}'; the known openings are {', '.join(OPENINGS)}.")
        diameter = float(table.get("diameter_mm", 0.0))
        openings[name] = Opening(name, centre, normal / size, beyond, diameter, 1.0, "landmarks file", 0, takes, shares)
    notes = (f"{path}: {', '.join(doubted)} not confirmed there and unchanged: found anew",) if doubted else ()
    return Landmarks(openings, sides, notes)


def _sum(table: dict[str, Any]) -> str:
    """Check sum of the numbers that say where an opening is; the same however a person's editor writes them."""
    numbers = [table.get(key) for key in ("centre", "normal", "beyond")]
    flat = [float(x) for vector in numbers if isinstance(vector, list) for x in vector if isinstance(x, int | float)]
    return f"{zlib.crc32(json.dumps(flat).encode()):08x}"


def _unconfirmed(path: Path, name: str, table: dict[str, Any]) -> bool:
    """Whether an opening is in doubt still: said so, and its numbers are those that were found.

    One that says so without a check sum is in doubt, whatever its numbers.
    """
    confirmed = table.get("confirmed", True)
    if not isinstance(confirmed, bool):
        raise AnatomyError(f"{path}: {name}.confirmed must be true or false.")
    return not confirmed and table.get("as_found", _sum(table)) == _sum(table)


def _vector(path: Path, key: str, value: Any) -> FloatArray:
    try:
        vector = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.array([np.nan])
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise AnatomyError(f"{path}: '{key}' must be three finite numbers, mm.")
    return vector


def override(found: Landmarks, given: Landmarks | None) -> Landmarks:
    """What was given wins over what was found."""
    if given is None:
        return found
    return Landmarks({**found.openings, **given.openings}, {**found.sides, **given.sides}, (*found.notes, *given.notes))
