"""Tags of a surface's triangles: which rim lies in which patch, and patches without a rim (a closed appendage)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy.openings.candidate import PATCH, Candidate, of_ring
from lacli.base.arrays import FloatArray, IntArray
from lacli.contracts.labels import REGIONS, RINGS
from lacli.geometry import curves as paths
from lacli.geometry.surface import Surface

# as the group that publishes endocardia with universal atrial coordinates tags them
CARP_TAGS = {13: "appendage", 21: "lspv", 23: "lipv", 25: "rspv", 27: "ripv"}
BODY_TAG = 11
LEAST_MM2 = 30.0


@dataclass(frozen=True)
class Tagged:
    """Middles (t, 3) mm of triangles, their tags (t,), and what tags mean (tag -> opening)."""

    middle: FloatArray
    tag: IntArray
    names: dict[int, str]


def of_triangles(points: FloatArray, triangles: IntArray, tag: IntArray) -> Tagged | None:
    """Tags that are known to mean body, appendage and veins; None where they mean nothing known."""
    present = set(np.unique(tag).tolist())
    if present >= set(REGIONS.values()) and present & set(RINGS.values()):  # a wall of our own
        return Tagged(points[triangles].mean(axis=1), tag, {value: name for name, value in RINGS.items() if value in present})
    if BODY_TAG not in present or not present & set(CARP_TAGS):
        return None
    return Tagged(points[triangles].mean(axis=1), tag, {t: n for t, n in CARP_TAGS.items() if t in present})


def candidates(surface: Surface, rims: Sequence[Candidate], tagged: Tagged) -> list[Candidate]:
    """Rims with what the tags say of them, and a candidate for each patch that has none, at its border with the body."""
    middle = surface.points[surface.triangles].mean(axis=1)
    _, near = cKDTree(tagged.middle).query(middle)
    tag = tagged.tag[near]
    wall = surface.label == 0
    done: list[Candidate] = []
    for rim in rims:
        said = ""
        if rim.cap:
            at = np.zeros(len(surface.points), dtype=bool)
            at[surface.triangles[surface.label == rim.cap]] = True
            beside = wall & at[surface.triangles].any(axis=1)
            values, count = np.unique(tag[beside], return_counts=True)
            if len(values) and count.max() > 0.6 * count.sum():
                said = tagged.names.get(int(values[count.argmax()]), "")
        done.append(replace(rim, said=said) if said and said not in {c.said for c in done} else rim)
    for value, name in tagged.names.items():
        mine = wall & (tag == value)
        if name in {c.said for c in done} or surface.areas()[mine].sum() < LEAST_MM2:
            continue
        loops = paths.loops(paths.border_edges(surface.triangles, mine))
        if not loops:
            continue
        loop = max(loops, key=lambda one: paths.perimeter(surface.points, one))
        ring = surface.points[loop]
        outward = middle[mine].mean(axis=0) - ring.mean(axis=0)
        tip = middle[mine][int(np.argmax(np.linalg.norm(middle[mine] - ring.mean(axis=0), axis=1)))]
        done.append(of_ring(ring, outward, PATCH, tip=tip, said=name, length_mm=float(np.linalg.norm(tip - ring.mean(axis=0)))))
    return done
