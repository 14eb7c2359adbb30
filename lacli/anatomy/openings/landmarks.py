"""The openings of an atrium: planes of valve, veins and appendage, named, with confidences; ``landmarks.toml`` in and out."""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.openings.branches import Branch, Skeleton
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.labels import OPENINGS

SIDES = ("lateral", "septal", "lspv_roof", "rspv_roof")


@dataclass(frozen=True)
class Opening:
    """A cut: centre (3,) mm, normal (3,) out of the atrium, beyond (3,) mm a point of what is cut off; confidence 0 .. 1."""

    name: str
    centre: FloatArray
    normal: FloatArray
    beyond: FloatArray
    diameter_mm: float
    confidence: float
    source: str


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


def name_branches(
    skeleton: Skeleton, mitral_centre: FloatArray, world: Axes | None
) -> tuple[dict[str, Branch], dict[str, float], list[str]]:
    """Branches by name, confidence of each name, and notes.

    The appendage is low over the mitral valve, in front, and on the left; of the veins two are left, two right, and the
    superior one of each pair lies in front of and above the inferior. Without known axes (``world`` None) the shape decides: the
    appendage's side is the left one, and superior - left - posterior are right-handed.

    Raises AnatomyError where a side has fewer than two veins (common trunk, or one not segmented).
    """
    branches = list(skeleton.branches)
    notes: list[str] = []
    if len(branches) < 3:
        raise AnatomyError(_too_few(branches))
    ostia = np.array([b.centre for b in branches])
    scale = float(np.linalg.norm(ostia - ostia.mean(axis=0), axis=1).mean())
    appendage, sure = _appendage(branches, skeleton, mitral_centre, world, scale)
    veins = [i for i in range(len(branches)) if i != appendage]
    left, right, side_sure, axes = _sides(branches, veins, appendage, mitral_centre, world, scale)
    named: dict[str, Branch] = {}
    confidence: dict[str, float] = {}
    if appendage is not None:
        named["appendage"], confidence["appendage"] = branches[appendage], sure
    else:
        notes.append("no appendage was found; its ring and plane are left out")
    extra = 0
    for side, group in (("l", left), ("r", right)):
        if len(group) < 2:
            raise AnatomyError(_missing(side, [branches[i] for i in group]))
        chosen = sorted(group, key=lambda i: -branches[i].diameter_mm)[:2]
        for i in group:
            if i not in chosen:
                extra += 1
                named[f"extra{extra}"], confidence[f"extra{extra}"] = branches[i], 0.5
                notes.append(
                    f"a third vein on the {'left' if side == 'l' else 'right'} (diameter {branches[i].diameter_mm:.0f} mm, at "
                    f"{_words(branches[i].centre)}) is cut and closed as wall"
                )
        height = [branches[i].centre @ (axes.superior - axes.posterior) for i in chosen]
        upper, lower = (chosen[0], chosen[1]) if height[0] > height[1] else (chosen[1], chosen[0])
        certain = float(np.clip(abs(height[0] - height[1]) / (0.5 * scale), 0.0, 1.0))
        for name, i in ((f"{side}spv", upper), (f"{side}ipv", lower)):
            named[name], confidence[name] = branches[i], round(min(0.99, 0.3 + 0.7 * min(certain, side_sure)), 2)
    return named, confidence, notes


def _words(point: FloatArray) -> str:
    return "(" + ", ".join(f"{x:.0f}" for x in point) + ") mm"


def _too_few(branches: list[Branch]) -> str:
    places = "; ".join(f"{b.diameter_mm:.0f} mm wide at {_words(b.centre)}" for b in branches) or "none"
    return (
        f"only {len(branches)} vessel{'s' * (len(branches) != 1)} of the blood pool found ({places}); four veins are needed. "
        "Include at least 5 mm of each vein in the segmentation, or give the ostia in landmarks.toml."
    )


def _missing(side: str, group: list[Branch]) -> str:
    word = "left" if side == "l" else "right"
    if not group:
        return f"no vein was found on the {word}; include 5 mm of each vein in the segmentation or give them in landmarks.toml."
    return (
        f"only one vein was found on the {word} ({group[0].diameter_mm:.0f} mm wide at {_words(group[0].centre)}): "
        "either the other is not in the segmentation, or both share a common trunk. Segment at least 5 mm of each vein beyond "
        f"the trunk, or give both ostia ([{side}spv] and [{side}ipv]: centre, normal) in landmarks.toml."
    )


def _appendage(
    branches: list[Branch], skeleton: Skeleton, mitral: FloatArray, world: Axes | None, scale: float
) -> tuple[int | None, float]:
    """Which branch is the appendage (None: no branch is one) and how sure."""
    ostia = np.array([b.centre for b in branches])
    to_valve = np.linalg.norm(ostia - mitral, axis=1) / scale
    if world is None:
        if len(branches) < 5:
            return None, 0.0
        score = -to_valve
    else:
        middle = skeleton.middle
        tips = np.array([b.tip for b in branches])
        front = -((0.5 * (ostia + tips)) - middle) @ world.posterior / scale
        left = (ostia - middle) @ world.left / scale
        score = front - to_valve + 0.3 * np.clip(left, -1, 1)
        eligible = (left > 0.1) & (front > 0.1)
        if not eligible.any():
            return None, 0.0
        score = np.where(eligible, score, -np.inf)
    order = np.argsort(-score)
    gap = score[order[0]] - score[order[1]] if len(order) > 1 and np.isfinite(score[order[1]]) else 1.0
    return int(order[0]), round(float(np.clip(0.5 + gap, 0.5, 0.99)), 2)


def _sides(
    branches: list[Branch], veins: list[int], appendage: int | None, mitral: FloatArray, world: Axes | None, scale: float
) -> tuple[list[int], list[int], float, Axes]:
    ostia = np.array([branches[i].centre for i in veins])
    if world is not None:
        x = ostia @ world.left
        order = np.argsort(x)
        gaps = np.diff(x[order])
        # the widest gap that leaves both sides someone, preferring the middle ones
        cut = int(np.argmax(gaps)) + 1
        right, left = [veins[i] for i in order[:cut]], [veins[i] for i in order[cut:]]
        return left, right, float(np.clip(gaps.max() / (0.7 * scale), 0, 1)), world
    best: tuple[float, list[int], list[int]] | None = None
    for code in range(1, 2 ** (len(veins) - 1)):
        first = [v for k, v in enumerate(veins) if code >> k & 1]
        second = [v for v in veins if v not in first]
        if abs(len(first) - len(second)) > 1:
            continue
        spread = sum(
            float(
                np.linalg.norm(
                    np.array([branches[i].centre for i in g]) - np.mean([branches[i].centre for i in g], axis=0), axis=1
                ).sum()
            )
            for g in (first, second)
        )
        if best is None or spread < best[0]:
            best = (spread, first, second)
    if best is None:
        raise AnatomyError(_too_few([branches[i] for i in veins]))
    _, first, second = best
    if appendage is None:
        raise AnatomyError("left and right cannot be told without an appendage or known axes; give the veins in landmarks.toml.")
    centres = [np.mean([branches[i].centre for i in g], axis=0) for g in (first, second)]
    away = [float(np.linalg.norm(c - branches[appendage].centre)) for c in centres]
    left, right = (first, second) if away[0] < away[1] else (second, first)
    up = ostia.mean(axis=0) - mitral
    up /= np.linalg.norm(up)
    across = centres[0] - centres[1] if away[0] < away[1] else centres[1] - centres[0]
    across -= (across @ up) * up
    across /= np.linalg.norm(across)
    axes = Axes(across, np.cross(up, across), up, False)
    return left, right, float(np.clip(abs(away[0] - away[1]) / scale, 0, 1)), axes


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
        openings[name] = Opening(name, centre, normal / size, beyond, float(table.get("diameter_mm", 0.0)), 1.0, "landmarks file")
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
