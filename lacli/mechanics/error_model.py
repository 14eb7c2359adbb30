"""Discretisation errors where none were measured: a model of them over anatomies, from element order, cell size and wall.

With h the mean edge of the endocardium's triangles, t the wall's mean thickness, L the square root of the endocardium's area and
s the feature's scale (below), the typical error is s exp(c + p ln(h / L) + q ln(t / h)), c by the feature's family and the
order, p and q by the order. What is stated is so much more that 95 % of the true errors lie within twice the stated, on
anatomies that the fit has not seen. Coefficients and that share: ``error_model.json``, written by benchmarks/errors.py.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.documents import read_json
from lacli.base.errors import InputError
from lacli.contracts.bundle import Bundle
from lacli.contracts.features import parse
from lacli.contracts.labels import ENDO, is_body
from lacli.geometry.tetrahedra import volumes
from lacli.geometry.triangles import areas

FILE = Path(__file__).with_name("error_model.json")


@dataclass(frozen=True)
class Resolution:
    """What the error depends on beside the feature: ``order`` of the cells, mean edge ``h_mm`` and extent ``l_mm`` (square root
    of the area) of the endocardium, mean thickness ``t_mm`` of the wall."""

    order: int
    h_mm: float
    l_mm: float
    t_mm: float


def resolution(bundle: Bundle, order: int) -> Resolution:
    """The resolution of a bundle's mesh with cells of that order."""
    corners = bundle.triangles[bundle.tags == ENDO][:, :3]
    at = bundle.points[corners]
    h = float(np.mean(np.linalg.norm(at - np.roll(at, 1, axis=1), axis=2)))
    area = float(areas(bundle.points, corners).sum())
    wall = float(volumes(bundle.points, bundle.tets[is_body(bundle.region)][:, :4]).sum())
    return Resolution(order, h, math.sqrt(area), wall / area)


def family(name: str) -> str:
    """What features of all regions and times share: ``d_{}_mm`` of ``d_roof_mm@0.25``. ValueError for what is no feature."""
    feature, _ = parse(name)
    key = feature.key if feature.region is None else feature.key.replace(feature.region, "{}")
    return "d_{}_mm" if key == "d_global_mm" else "volume_ml" if key == "esv_ml" else key


def scale(name: str, global_mm: float, where: Resolution) -> float:
    """A feature's scale in its unit: the mean displacement d for lengths, d L^2 for volumes, d / L for strains."""
    if name.partition("@")[0].endswith("_ml"):
        return global_mm * where.l_mm**2 / 1000.0
    return global_mm if name.partition("@")[0].endswith("_mm") else global_mm / where.l_mm


def stated_errors(features: Mapping[str, Any], where: Resolution) -> dict[str, float]:
    """Feature -> error in its unit, for the features that the model knows; empty where nothing moved."""
    model = _model()[str(where.order)]
    moved = float(features.get("d_global_mm", math.nan))
    if not moved > 0.0:
        return {}
    shape = model["h"] * math.log(where.h_mm / where.l_mm) + model["t"] * math.log(where.t_mm / where.h_mm)
    found = {}
    for name in features:
        try:
            constant = model["families"][family(name)]
        except (ValueError, KeyError):
            continue
        found[name] = scale(name, moved, where) * math.exp(constant + shape) * model["factor"]
    return found


@functools.cache
def _model() -> dict[str, Any]:
    return dict(read_json(FILE, error=InputError)["orders"])
