"""The openings of an atrium: planes of valve, veins and appendage, named, with confidences; ``landmarks.toml`` in and out."""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.labels import OPENINGS

SIDES = ("lateral", "septal", "lspv_roof", "rspv_roof")


@dataclass(frozen=True)
class Opening:
    """A cut: centre (3,) mm, normal (3,) out of the atrium, beyond (3,) mm a point of what is cut off; confidence 0 .. 1.

    cap: label of the surface's own cap that closes it where no cut is needed, else 0; takes: the opening whose ring and plane a
    further vein takes; shares: the other vein of a common trunk, whose opening a carina parts in two.
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
        "Edit and give back with --landmarks: what stands here wins, what is left out is found."
    }
    for name, opening in landmarks.openings.items():
        document[name] = {
            "centre": [round(float(x), 3) for x in opening.centre],
            "normal": [round(float(x), 4) for x in opening.normal],
            "beyond": [round(float(x), 3) for x in opening.beyond],
            "diameter_mm": round(opening.diameter_mm, 2),
            "confidence": round(opening.confidence, 2),
            "source": opening.source,
            **{key: value for key in ("takes", "shares") if (value := getattr(opening, key))},
        }
    if landmarks.sides:
        document["sides"] = {name: [round(float(x), 3) for x in point] for name, point in landmarks.sides.items()}
    temporary = path.with_name(f".part-{os.getpid()}-{path.name}")
    temporary.write_bytes(tomli_w.dumps(document).encode())
    temporary.replace(path)


def read(path: Path) -> Landmarks:
    """Read ``landmarks.toml``. Raises AnatomyError on an unknown name, or a vector that is not three finite numbers."""
    try:
        document = tomllib.loads(path.read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise AnatomyError(f"{path}: the landmarks cannot be read ({error}).") from None
    openings: dict[str, Opening] = {}
    sides: dict[str, FloatArray] = {}
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
        centre, normal = (_vector(path, f"{name}.{key}", table[key]) for key in ("centre", "normal"))
        size = float(np.linalg.norm(normal))
        if size < 1e-9:
            raise AnatomyError(f"{path}: {name}.normal has no direction.")
        beyond = _vector(path, f"{name}.beyond", table["beyond"]) if "beyond" in table else centre + 3.0 * normal / size
        others = {key: str(table.get(key, "")) for key in ("takes", "shares")}
        for key, value in others.items():
            if value and value not in OPENINGS:
                raise AnatomyError(f"{path}: {name}.{key} is '{value}'; the known openings are {', '.join(OPENINGS)}.")
        diameter = float(table.get("diameter_mm", 0.0))
        openings[name] = Opening(name, centre, normal / size, beyond, diameter, 1.0, "landmarks file", 0, **others)
    return Landmarks(openings, sides)


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
    return Landmarks({**found.openings, **given.openings}, {**found.sides, **given.sides}, found.notes)
