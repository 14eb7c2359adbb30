"""Parametric atria in the forms that files have: open, with stubs, a common trunk, five veins, no appendage, mirrored, in
centimetres, cut obliquely; with the truth of their openings."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.coordinates.frame import unit
from lacli.anatomy.cuts.cut import Cut, cut_open
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.labels import PLANES, is_plane, plane_of
from lacli.geometry.surface import Surface
from lacli.synthetic.atrium import GRID_MM, isosurface
from lacli.synthetic.shape import Shape, draw

VARIANTS = ("open", "stubs", "trunk", "five", "bare", "mirrored", "cm", "oblique")
FIFTH = 99  # label of a right middle vein's plane
TILT_DEG = 25.0


def write(folder: Path, seeds: Iterable[int], only: str = "") -> None:
    """A surface per seed and variant (those whose file's name holds ``only``), open at its planes, and ``truth.json``.

    The few that cannot be cut in their form are left out.
    """
    import pyvista as pv

    truth: list[dict[str, Any]] = []
    for seed in seeds:
        for variant in VARIANTS:
            name = f"{variant}_{seed:03d}.vtp"
            if only not in name:
                continue
            try:
                points, triangles, openings = make(seed, variant)
            except AnatomyError:  # a seed whose vessels leave no room for this form: said by its absence
                continue
            pv.PolyData.from_regular_faces(points, triangles).save(folder / name)
            truth.append(
                {
                    "file": name,
                    "args": {},
                    "openings": {n: c.tolist() for n, c in openings.items()},
                    "appendage": "open" if "laa" in openings else "none",
                    "units": "cm" if variant == "cm" else "mm",
                    "tol_mm": 10,
                    "expect": "right",
                }
            )
    (folder / "truth.json").write_text(json.dumps(truth))


def make(seed: int, variant: str) -> tuple[FloatArray, np.ndarray, dict[str, FloatArray]]:
    """Points (n, 3) in the variant's unit, triangles (t, 3), and centres (3,) of the openings ("laa": the appendage)."""
    shape = draw(seed)
    if variant == "stubs":
        shape = shape.at_ostia(0.0)
    shape, cuts = _cuts(shape, variant, np.random.default_rng([20261125, seed]))
    surface = isosurface(shape, GRID_MM)
    for cut in cuts:
        surface = cut_open(surface, cut)
    openings = {_name(c.label): _middle(surface, c.label) for c in cuts if c.label != FIFTH}
    if variant == "trunk":
        step = 0.5 * (shape.tubes["rspv"].start - shape.tubes["ripv"].start)
        whole = openings["rspv"]
        openings |= {"rspv": whole + step, "ripv": whole - step}
    points, triangles = surface.points, surface.triangles[~is_plane(surface.label)]
    if variant == "mirrored":
        flip = np.array([-1.0, 1.0, 1.0])
        points, triangles = points * flip, triangles[:, ::-1]
        openings = {n: c * flip for n, c in openings.items()}
    if variant == "cm":
        points, openings = points / 10.0, {n: c / 10.0 for n, c in openings.items()}
    return points, triangles, openings


def _cuts(shape: Shape, variant: str, rng: np.random.Generator) -> tuple[Shape, list[Cut]]:
    """The shape with its variant's vessels, and where they are cut."""
    tubes = dict(shape.tubes)
    if variant == "bare":
        del tubes["appendage"]
    if variant == "five":
        upper, lower = tubes["rspv"], tubes["ripv"]
        way = unit(upper.direction + lower.direction)
        ostium = (upper.start + lower.start) / 2 + 9.0 * way
        tubes["middle"] = replace(
            upper, start=ostium - 9.0 * way, end=ostium + 24.0 * way, radius_start=3.6, radius_end=3.3, blend_mm=3.0
        )
    if variant == "trunk":
        upper, lower = tubes["rspv"], tubes["ripv"]
        way, middle = unit(upper.direction + lower.direction), (upper.start + lower.start) / 2
        apart = 5.5 * unit(upper.start - lower.start)
        for name, sign in (("rspv", 1.0), ("ripv", -1.0)):
            start = middle + sign * apart
            tubes[name] = replace(tubes[name], start=start, end=start + 33.0 * way)
    shape = replace(shape, tubes=tubes)
    cuts = []
    for name, tube in tubes.items():
        if variant == "trunk" and name == "ripv":
            continue
        centre, way, reach = (
            tube.start + tube.cut_mm * tube.direction,
            tube.direction,
            (1.25 if variant == "five" else 1.6) * tube.radius_start,
        )
        if variant == "trunk" and name == "rspv":
            centre, reach = centre - 0.5 * (tube.start - tubes["ripv"].start), 2.0 * reach
        if variant == "oblique" and name != "mv":
            aside = unit(np.cross(way, rng.normal(size=3)))
            way = unit(way + np.tan(np.radians(TILT_DEG)) * aside)
            # farther out, so that the lower side of the slanted section stays clear of the flare
            centre, reach = centre + 1.2 * np.tan(np.radians(TILT_DEG)) * tube.radius_start * tube.direction, 1.3 * reach
        cuts.append(Cut(centre, way, reach, PLANES.get(name, FIFTH)))
    return shape, cuts


def _name(label: int) -> str:
    name = plane_of(label)
    return "laa" if name == "appendage" else name


def _middle(surface: Surface, label: int) -> FloatArray:
    mine = surface.label == label
    middle = surface.points[surface.triangles[mine]].mean(axis=1)
    return np.asarray(np.average(middle, axis=0, weights=surface.areas()[mine]))
