"""What the labels of a map mean: given one by one, or by the name of a published set."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings.candidate import PATCH, VEIN, Candidate
from lacli.anatomy.openings.ostium import across
from lacli.base.arrays import BoolArray, IntArray
from lacli.base.errors import AnatomyError, UsageError

VESSELS = {"laa": "appendage", "appendage": "appendage", "pv": VEIN} | {n: n for n in ("rspv", "ripv", "lspv", "lipv")}
NAMES = ("la", "lv", "wall", *VESSELS)
LEAST_ML = 0.02  # of a piece of a vessel's label: smaller ones are specks
LEAST_CONTACT_MM2 = 12.0  # of a vessel with the atrium

# label numbers as the sets' own sources have them; "+" where two labels are one thing
PRESETS = {
    # github.com/wasserth/TotalSegmentator, totalsegmentator/map_to_binary.py: class_map["heartchambers_highres"], ["total"]
    "totalsegmentator": (
        "la=2,lv=3,laa=61,pv=53",
        "heartchambers_highres (2, 3), with labels 61 and 53 of the task total (version 2) written into the same map",
    ),
    # the same file: class_map["total_v1"]
    "totalsegmentator-1": ("la=45,lv=46", "task total of version 1: heart_atrium_left and heart_ventricle_left"),
    # github.com/CemrgApp: four-chamber scripts (create_myo.py) and HeartLabels
    "four-chamber": (
        "la=4,lv=1,wall=104,laa=12,pv=8+9+10+11",
        "CemrgApp's four-chamber pipeline (LA_BP_label 4, LPV1 - RPV2 8 - 11, LAA 12, LA_myo_label 104)",
    ),
    # MM-WHS 2017 (Zhuang and Shen 2016), and the same numbers in its successor WHS++ (CARE 2024, track 5)
    "mmwhs": ("la=420,lv=500", "MM-WHS challenge, blood of left atrium (veins and appendage in it) and ventricle"),
}


@dataclass(frozen=True)
class Meaning:
    """Labels of the atrium's blood, the ventricle's and the atrial wall, and of vessels: label -> opening, VEIN, or "" (any)."""

    la: int | None = None
    lv: int | None = None
    wall: int | None = None
    vessels: Mapping[int, str] = field(default_factory=dict)


def read(text: str) -> Meaning:
    """From ``la=2,lv=3,laa=61,pv=53+54``. Raises UsageError on names, numbers and repeats that are none."""
    meaning, seen = Meaning(), dict[int, str]()
    for part in text.split(","):
        found = re.fullmatch(r"\s*([a-z]+)\s*=\s*(\d{1,9}(?:\+\d{1,9})*)\s*", part.lower())
        if found is None or found[1] not in NAMES:
            raise UsageError(
                f"--labels: '{part.strip()[:40]}' is not NAME=NUMBER with a name of {', '.join(NAMES)} (pv=7+8 for two)."
            )
        name, values = found[1], [int(v) for v in found[2].split("+")]
        for value in values:
            if value == 0 or value in seen:
                raise UsageError(f"--labels: label {value} is {'the background' if value == 0 else f'{seen[value]} and {name}'}.")
            seen[value] = name
        if name in VESSELS:
            meaning = replace(meaning, vessels={**meaning.vessels, **dict.fromkeys(values, VESSELS[name])})
        elif len(values) > 1 or getattr(meaning, name) is not None:
            raise UsageError(f"--labels: {name} is one label.")
        else:
            numbers = {"la": meaning.la, "lv": meaning.lv, "wall": meaning.wall, name: values[0]}
            meaning = Meaning(numbers["la"], numbers["lv"], numbers["wall"], meaning.vessels)
    return meaning


def preset(name: str, present: set[int]) -> Meaning:
    """Of a published set, without what the map does not have. Raises UsageError on other names."""
    if name not in PRESETS:
        raise UsageError(f"--preset is '{name}'; it must be one of {', '.join(PRESETS)} (--presets prints them).")
    whole = read(PRESETS[name][0])
    vessels = {label: what for label, what in whole.vessels.items() if label in present}
    lv, wall = (value if value in present else None for value in (whole.lv, whole.wall))
    return replace(whole, lv=lv, wall=wall, vessels=vessels)


def joined(labels: Image, la: int, vessels: Mapping[int, str]) -> Image:
    """The map with all vessels' labels as the atrium's blood. Raises AnatomyError where one has no voxel."""
    for value in vessels:
        if not (labels.array == value).any():
            raise AnatomyError(
                f"label {value} ({vessels[value] or 'vessel'}) has no voxel in the image; leave it out of --labels."
            )
    return labels.with_array(np.where(np.isin(labels.array, list(vessels)), la, labels.array)) if vessels else labels


def candidates(labels: Image, la: int, vessels: Mapping[int, str]) -> list[Candidate]:
    """A candidate for each place where a vessel's label meets the atrium's: its ostium, looking along the vessel."""
    if not vessels:
        return []
    beside = ndimage.binary_dilation(labels.array == la)
    found = []
    for value, said in vessels.items():
        made = [
            c
            for piece, touching in _pieces(labels, value, beside)
            for contact in _places(touching)
            if (c := _of_contact(labels, piece, contact, said)) is not None
        ]
        if said not in (VEIN, ""):
            made = sorted(made, key=lambda c: -c.area_mm2)[:1]
        found += made
    return found


def _pieces(labels: Image, value: int, beside: BoolArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Voxels (n, 3), [k, j, i], of each connected piece of a label but specks, and those of them that touch the atrium.

    Each is looked at in its own box: a map may hold hundreds of specks, and an array of the image's size for each fills memory.
    """
    parts, count = ndimage.label(labels.array == value, structure=np.ones((3, 3, 3)))
    size = sum((np.bincount(slab.ravel(), minlength=count + 1) for slab in parts), np.zeros(count + 1, dtype=np.int64))
    for k, box in enumerate(ndimage.find_objects(parts), start=1):
        if size[k] * labels.voxel_ml >= LEAST_ML:
            piece = parts[box] == k
            corner = [side.start for side in box]
            yield np.argwhere(piece) + corner, np.argwhere(piece & beside[box]) + corner


def _places(contact: IntArray) -> list[IntArray]:
    """The connected places among voxels (n, 3) of contact (two veins of one label may hang together)."""
    if not len(contact):
        return []
    low = contact.min(axis=0)
    mask = np.zeros(contact.max(axis=0) - low + 1, dtype=bool)
    mask[tuple((contact - low).T)] = True
    parts, count = ndimage.label(mask, structure=np.ones((3, 3, 3)))
    place = parts[tuple((contact - low).T)]
    return [contact[place == k] for k in range(1, count + 1)]


def _of_contact(labels: Image, piece: IntArray, contact: IntArray, said: str) -> Candidate | None:
    area = float(len(contact)) * (1000.0 * labels.voxel_ml) ** (2 / 3)
    if area < LEAST_CONTACT_MM2:
        return None
    ostium = labels.to_world(contact[:, ::-1].astype(float)).mean(axis=0)
    vessel = labels.to_world(piece[:, ::-1].astype(float))
    away = np.linalg.norm(vessel - ostium, axis=1)
    near = vessel[away < max(12.0, 0.5 * float(away.max()))]
    way = near.mean(axis=0) - ostium
    if np.linalg.norm(way) < 1e-6:
        return None
    way = way / np.linalg.norm(way)
    half = across(way) * np.sqrt(area / np.pi)
    return Candidate(
        ostium, way, area, PATCH, half, float(((vessel - ostium) @ way).max()), vessel[int(away.argmax())], said=said
    )


def unnamed(labels: Image, la: int, known: set[int], least_ml: float = 0.1) -> list[int]:
    """Labels that touch the atrium and are much smaller than it: vessels, maybe."""
    body = labels.array == la
    touching, count = np.unique(labels.array[ndimage.binary_dilation(body, iterations=2) & ~body], return_counts=True)
    size = {int(v): float((labels.array == v).sum()) * labels.voxel_ml for v in touching[count > 10] if v and int(v) not in known}
    whole = float(body.sum()) * labels.voxel_ml
    return [v for v, ml in size.items() if least_ml < ml < 0.25 * whole]
