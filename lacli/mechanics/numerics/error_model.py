"""Discretisation errors where none were measured: a model of them over anatomies, from order, cell size, wall and feature.

With h the mean edge of the endocardium's triangles, t the wall's mean thickness, L the square root of the endocardium's area
and s the feature's scale (``scale``), the typical error of linear cells is s exp(c + p ln(h / L) + q ln(t / h)): p and q by the
order of the cells, c by the order and the feature's key. At times of less motion than end-systole's errors fall slower than the
motion, by a power e of the order: their scale is s_t (d_ES / d_t)^e.
Quadratic cells bend, and what is left is the shape that a cell does not follow: instead of h / L stands the angle that the
endocardium turns by from a triangle to the next, root mean square, for imaged atria are rougher than synthetic ones. What is
stated is the typical error times a factor, such that 95 % of the true errors of anatomies which the fit has not seen lie within
twice the stated: a standard deviation, were errors normal. Coefficients and that share stand in ``error_model.json``, written
by ``benchmarks/errors.py``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.documents import read_json
from lacli.base.errors import InputError
from lacli.contracts.bundle import Bundle
from lacli.contracts.features import family
from lacli.contracts.labels import BODY_REGIONS, ENDO, is_body
from lacli.geometry.curves import edge_table, side_pairs
from lacli.geometry.tetrahedra import volumes
from lacli.geometry.triangles import area_normals

# the turn from triangle to triangle falls with their edges to that power, on synthetic atria; on imaged ones to .65 - .85
_TURN = 0.85
LEAST_TURN = 0.02  # rad: no atrium is flatter
FILE = Path(__file__).with_name("error_model.json")


@dataclass(frozen=True)
class Resolution:
    """What the error depends on beside the feature: ``order`` of the cells, mean edge ``h_mm`` and extent ``l_mm`` (square root
    of the area) of the endocardium, mean thickness ``t_mm`` of the wall, ``turn`` (rad, root mean square) of the endocardium
    between neighbouring triangles."""

    order: int
    h_mm: float
    l_mm: float
    t_mm: float
    turn: float

    @property
    def slopes(self) -> tuple[float, float]:
        """The logarithms of what errors are powers of: h / L, or the turn of quadratic cells, and t / h."""
        return math.log(self.h_mm / self.l_mm if self.order == 1 else self.turn), math.log(self.t_mm / self.h_mm)

    def finer(self, share: float) -> Resolution:
        """The same wall with edges of that share in length."""
        return replace(self, h_mm=self.h_mm * share, turn=self.turn * share**_TURN)


def resolution(bundle: Bundle, order: int) -> Resolution:
    """The resolution of a bundle's mesh with cells of that order."""
    corners = bundle.triangles[bundle.tags == ENDO][:, :3]
    at = bundle.points[corners]
    h = float(np.mean(np.linalg.norm(at - np.roll(at, 1, axis=1), axis=2)))
    body = bundle.tets[is_body(bundle.region)][:, :4]
    wall = float(np.abs(volumes(bundle.points, body)).sum())
    inside = np.zeros(len(bundle.points), bool)
    inside[body] = True
    thickness = wall / _area(bundle, corners[inside[corners].all(axis=1)])
    return Resolution(order, h, math.sqrt(_area(bundle, corners)), thickness, _turn(at, corners))


def _area(bundle: Bundle, corners: IntArray) -> float:
    return 0.5 * float(np.linalg.norm(area_normals(bundle.points[corners]), axis=1).sum())


def _turn(at: FloatArray, corners: IntArray) -> float:
    """Angle between the planes of neighbouring triangles (rad), root mean square by their areas; at least LEAST_TURN."""
    vector = area_normals(at)
    area = np.linalg.norm(vector, axis=1)
    one, two = side_pairs(edge_table(corners)[2])[0].T // 3
    cosine = (vector[one] * vector[two]).sum(axis=1) / np.maximum(area[one] * area[two], 1e-300)
    angle, weight = np.arccos(np.clip(cosine, -1.0, 1.0)), area[one] + area[two]
    return max(math.sqrt(float((weight * angle**2).sum() / weight.sum())), LEAST_TURN)


def moved_mm(features: Mapping[str, Any]) -> dict[str, float]:
    """How far the body moved (mm), by the time in the features' names ("" for end-systole): d of the whole, else the mean of the
    regions' d, else of their sqrt(n^2 + a^2 + b^2). Times of which nothing is told are absent."""
    found = {}
    for time in {name.partition("@")[2] for name in features}:
        mark = f"@{time}" if time else ""
        whole = _number(features.get(f"d_global_mm{mark}"))
        regions = [_number(features.get(f"d_{region}_mm{mark}")) for region in BODY_REGIONS]
        parts = [math.hypot(*(_number(features.get(f"{kind}_{region}_mm{mark}")) for kind in "nab")) for region in BODY_REGIONS]
        for values in ([whole], regions, parts):
            known = [value for value in values if math.isfinite(value)]
            if known:
                found[time] = float(np.mean(known))
                break
    return found


def earliness(moved: Mapping[str, float], time: str) -> float:
    """ln(d_ES / d_t) by ``moved_mm``: 0 at end-systole, where nothing is known of it, or where the body moved further."""
    now, most = moved[time], moved.get("", 0.0)
    return math.log(most / now) if 0.0 < now < most else 0.0


def scale(name: str, moved: float, where: Resolution) -> float:
    """A feature's scale in its unit: the mean displacement d (mm) for lengths, d L^2 for volumes (mL), d / L for strains; L^3 for
    the volume at end-diastole, which is the image's and does not hang on the motion."""
    key = name.partition("@")[0]
    if key == "edv_ml":
        return where.l_mm**3 / 1000.0
    if key.endswith("_ml"):
        return moved * where.l_mm**2 / 1000.0
    return moved if key.endswith("_mm") else moved / where.l_mm


def model_errors(features: Mapping[str, Any], where: Resolution) -> dict[str, float]:
    """Feature -> error in its unit (a standard deviation), for the features of which the model and the motion at their time are
    known. Zero motion has errors of zero."""
    model = _model()[str(where.order)]
    a, b = where.slopes
    shape = model["size"] * a + model["t"] * b
    moved = moved_mm(features)
    found = {}
    for name in features:
        try:
            constant = model["features"][family(name)]
        except (ValueError, KeyError):
            continue
        time = name.partition("@")[2]
        if time in moved:
            early = model["early"] * earliness(moved, time)
            found[name] = scale(name, moved[time], where) * math.exp(constant + shape + early) * model["factor"]
    return found


@functools.cache
def _model() -> dict[str, Any]:
    return dict(read_json(FILE, error=InputError)["orders"])


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan
