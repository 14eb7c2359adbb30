"""Can a mitral valve that is closed in the file be told from the shape? Open atria are closed, and three rules seek the valve.

    python benchmarks/closed_valve.py FOLDER [--domes -3 -1.5 0 1.5 3 5] [--only WORD]

FOLDER holds surfaces and truth.json as for atria.py. Each valve's rim is closed by a dome of each height (mm, inward where
negative), as segmentations close it, and the whole smoothed through voxels of 1 mm; the veins keep their rims. A file without a
rim at its valve is taken as it is. Where the veins are named rightly, points 3 mm apart over the body are judged by

place       where valves lie in the frame of the veins (closed_valve.PLACE),
flat        how far the surface bulges: mean height of what is within 9 mm over the plane of what is 12 - 15 mm away,
both        the sum of the two as negative logarithms of likelihood, bulges of FLAT counting as flat.

Printed are the distances (mm) of each rule's best point from the true valve, that of the largest flat patch, the share of the
likelihood by both that lies within 10 mm of the truth (what a rule's confidence could be at best), and the patch's width (mm) and
by how much the surface turns at its border (degrees). `lacli mesh` takes the patch only where that border is as sharp as a cut's
and its place is likely. Asked: what is taken is within the file's tolerance.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import atria
import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy.inputs import extraction, repair
from lacli.anatomy.inputs.image import is_image
from lacli.anatomy.inputs.meshes import anything
from lacli.anatomy.inputs.voxels import voxel_field, voxels
from lacli.anatomy.openings import branches, closed_valve, finding, naming
from lacli.anatomy.openings.candidate import CAP, GUESS, Candidate
from lacli.anatomy.openings.mitral import SHARP_DEG, border_turn_deg
from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import AnatomyError
from lacli.geometry.surface import Surface

WITHIN_MM = 10.0
FLAT = (0.5, 0.7)  # mm: mean and spread of the bulge of closed valves, the kindest of those tried
NARROW_MM = 6.0  # a rim narrower than that is a hole


def dome(shape: tuple[int, ...], low: FloatArray, rim: Candidate, height: float) -> BoolArray:
    """Voxels of 1 mm between a rim's plane and the sphere's cap of that height (mm) over it."""
    radius = (rim.diameter_mm**2 / 4 + height**2) / (2 * abs(height))
    way = rim.direction * np.sign(height)
    middle = rim.centre - (radius - abs(height)) * way
    k, j, i = np.indices(shape)
    at = np.stack([i, j, k], axis=-1) + low
    return np.asarray((np.linalg.norm(at - middle, axis=-1) < radius) & ((at - rim.centre) @ way > 0))


def closed(whole: Surface, rim: Candidate, height: float) -> Surface:
    """The surface with the rim closed by a dome."""
    field = voxels(whole, 1.0)
    mask = field.array > 0.5
    if height:
        cap = dome(mask.shape, field.origin, rim, height)
        mask = mask | cap if height > 0 else mask & ~cap
    return extraction.surface_of(field.with_array(mask), 1.25, 1.0)


def bulges(surface: Surface, at: list[Candidate]) -> FloatArray:
    """(k,) mm: of the surface around each candidate."""
    points = surface.points
    normal = np.zeros_like(points)
    for k in range(3):
        np.add.at(normal, surface.triangles[:, k], surface.area_vectors())
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    tree = cKDTree(points)
    found = []
    for one in at:
        near = np.array(tree.query_ball_point(one.centre, 15.0))
        far = np.linalg.norm(points[near] - one.centre, axis=1)
        outward = normal[near[far < 5.0]].mean(axis=0)
        same = normal[near] @ outward > 0.0  # not the wall on the other side
        ring, inner = points[near[(far > 12.0) & same]], points[near[(far < 9.0) & same]]
        middle = ring.mean(axis=0)
        _, _, axes = np.linalg.svd(ring - middle, full_matrices=False)
        found.append(float((inner - middle).mean(axis=0) @ axes[2] * np.sign(axes[2] @ outward)))
    return np.array(found)


@dataclass(frozen=True)
class Row:
    """Distances (mm) from the valve, by rule; share of the likelihood near it; the patch's width (mm) and border (degrees)."""

    place: float
    flat: float
    both: float
    patch: float
    share: float
    wide: float
    turn: float
    taken: bool
    right: bool

    def words(self) -> str:
        """A line."""
        ways = "".join(f"{v:8.1f}" for v in (self.place, self.flat, self.both, self.patch))
        verdict = "" if not self.taken else "  taken" if self.right else "  TAKEN, WRONG"
        return f"{ways}{self.share:8.2f}{self.wide:8.1f}{self.turn:8.0f}{verdict}"


def judged(surface: Surface, seen: list[Candidate], truth: dict[str, Any]) -> Row | str:
    """The rules' answers for a closed surface, or why there are none."""
    scale = atria.SCALE[truth["units"]]
    valve = scale * np.array(truth["openings"]["mv"])
    everything, _ = finding.gather(surface, seen, branches.find(voxel_field(surface, 1.0)), None)
    if not everything or everything[-1].source != GUESS:
        return "  a valve was seen"
    *vessels, patch = everything
    named, _ = closed_valve.name(surface, vessels, patch, None)
    if named is None or named.best.missing or named.best.trunk is not None:
        return "  veins not found"
    off = [np.linalg.norm(vessels[named.best.names[n]].centre - scale * np.array(truth["openings"][n])) for n in naming.VEINS]
    if max(off) > truth["tol_mm"]:
        return f"  veins misnamed (confidence {named.confidence:.2f}, cost {named.best.cost:.1f})"
    spots = closed_valve.places(surface, vessels, 400, 3.0)
    place = np.array([closed_valve.unlikely(named.best, vessels, c) for c in spots])
    bulge = bulges(surface, spots)
    both = place + 0.5 * (np.maximum(bulge - FLAT[0], 0.0) / FLAT[1]) ** 2
    gap = np.array([np.linalg.norm(c.centre - valve) for c in spots])
    weight = np.exp(both.min() - both)
    share = float(weight[gap <= WITHIN_MM].sum() / weight.sum())
    away = float(np.linalg.norm(patch.centre - valve))
    turn = 0.0 if patch.said else border_turn_deg(surface, patch)
    near = closed_valve.unlikely(named.best, vessels, patch) < closed_valve.FLAT_WITHIN
    certain = named.confidence >= naming.LEAST_CONFIDENCE and named.best.cost <= naming.MOST_COST
    best = (float(gap[np.argmin(c)]) for c in (place, bulge, both))
    return Row(*best, away, share, patch.diameter_mm, turn, certain and near and turn >= SHARP_DEG, away <= truth["tol_mm"])


def main() -> None:
    """A row a file and dome, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--domes", type=float, nargs="+", default=[-3.0, -1.5, 0.0, 1.5, 3.0, 5.0])
    parser.add_argument("--only", default="", help="files whose name holds this word")
    asked = parser.parse_args()
    rows: list[Row] = []
    print(f"{'file':24s}{'dome':>6}{'place':>8}{'flat':>8}{'both':>8}{'patch':>8}{'share':>8}{'wide':>8}{'turn':>8}")
    for truth in json.loads((asked.folder / "truth.json").read_text()):
        if (
            is_image(asked.folder / truth["file"])
            or asked.only not in truth["file"]
            or not set(atria.NEEDED) <= set(truth["openings"])
        ):
            continue
        try:
            mesh = anything.read(asked.folder / truth["file"])
            whole = repair.repair(mesh.points, mesh.triangles)
        except AnatomyError as error:
            print(f"{truth['file']:24s} no surface ({str(error)[:60]})")
            continue
        valve = atria.SCALE[truth["units"]] * np.array(truth["openings"]["mv"])
        rim = min(whole.rims, key=lambda c: float(np.linalg.norm(c.centre - valve)), default=None)
        there = rim is not None and np.linalg.norm(rim.centre - valve) <= truth["tol_mm"]
        seen = [replace(c, cap=0, source=CAP) for c in whole.rims if c is not rim and c.diameter_mm > NARROW_MM]
        for height in asked.domes if there else [float("nan")]:
            surface = closed(whole.surface, rim, height) if rim is not None and there else whole.surface
            got = judged(surface, seen if there else [], truth)
            print(f"{truth['file']:24s}{height:6g}{got if isinstance(got, str) else got.words()}", flush=True)
            rows += [] if isinstance(got, str) else [got]
    near = {name: sum(getattr(row, name) <= WITHIN_MM for row in rows) for name in ("place", "flat", "both", "patch")}
    print(f"within {WITHIN_MM:g} mm of {len(rows)}: {near}; share above .9: {sum(row.share > 0.9 for row in rows)}")
    taken = [row for row in rows if row.taken]
    print(f"taken {len(taken)}, right {sum(row.right for row in taken)} of them (asked: all)")


if __name__ == "__main__":
    main()
