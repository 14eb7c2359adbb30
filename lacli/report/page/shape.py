"""An atrium as the page's viewer draws it: outer surface, displacement to end-systole, fields by point."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base import vtkxml
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import InputError
from lacli.contracts.labels import BODY_REGIONS, PLANE_COLOUR, REGION_COLOURS, REGIONS, RING_COLOUR, is_plane, is_ring

NAMES = ("", *BODY_REGIONS, "rings", "valve planes")
MOST_TRIANGLES = 300_000
_NOTHING = -1e30
_SAME_MM = 2.0  # the simulated end-diastole and the bundle's image are nearer than this


class OtherAnatomyError(InputError):
    """The thickness is that of another anatomy than the run's."""


def atrium(
    es_file: Path, thickness: tuple[FloatArray, FloatArray] | None, regional: Mapping[str, tuple[str, Mapping[str, float]]]
) -> dict[str, Any] | None:
    """The viewer's data of a run's end-systolic state; None where its surface has more than 300,000 triangles.

    es_file: points (mm, deformed), cell array ``region``, point array ``displacement`` from end-diastole (mm). thickness:
    points (k, 3) of the end-diastolic endocardium and their thickness (k,) mm. regional: title -> unit and value by region.
    Raises InputError on a damaged file, OtherAnatomyError.
    """
    mesh = vtkxml.read(es_file, remedy="Run the scene again.")
    try:
        label = np.asarray(mesh.cell_data["region"])
        surface = mesh.extract_surface(nonlinear_subdivision=0, algorithm="dataset_surface", pass_cellid=True).triangulate()
        u = np.asarray(surface.point_data["displacement"], dtype=float)
        triangles = np.asarray(surface.faces).reshape(-1, 4)[:, 1:]
        kind = _kinds(np.asarray(label)[np.asarray(surface.cell_data["vtkOriginalCellIds"])])
    except Exception as error:  # readers raise all sorts of things on damaged files
        raise InputError(f"{es_file}: cannot be drawn ({error}).") from error
    if len(triangles) > MOST_TRIANGLES:
        return None
    # a point at the border of two regions stands once for each: colours do not run into each other
    corner = np.stack([triangles.ravel(), np.repeat(kind, 3)], axis=1)
    unique, index = np.unique(corner, axis=0, return_inverse=True)
    points, region = np.asarray(surface.points, dtype=float)[unique[:, 0]], unique[:, 1]
    moved = u[unique[:, 0]]
    ed = points - moved
    fields: list[dict[str, Any]] = [{"title": "region", "unit": "", "values": None}]
    fields.append(_field("displacement from ED to ES", "mm", np.linalg.norm(moved, axis=1), region))
    if thickness is not None:
        from scipy.spatial import cKDTree

        body = region <= len(BODY_REGIONS)
        values = np.full(len(ed), np.nan)
        far = float(np.percentile(cKDTree(ed).query(thickness[0])[0], 95))
        if far > _SAME_MM:
            raise OtherAnatomyError(f"Wall thickness is not shown: the bundle has changed since this run ({far:.1f} mm apart).")
        values[body] = thickness[1][cKDTree(thickness[0]).query(ed[body])[1]]
        fields.append(_field("wall thickness", "mm", values, region))
    for title, (unit, by_region) in regional.items():
        values = np.full(len(ed), np.nan)
        for i, name in enumerate(BODY_REGIONS):
            values[region == i + 1] = by_region.get(name, np.nan)
        fields.append(_field(title, unit, values, region))
    return {
        "points": _encoded(ed, np.float32),
        "displacement": _encoded(moved, np.float32),
        "region": _encoded(region, np.uint8),
        "triangles": _encoded(index, np.uint32),
        "regions": list(NAMES),
        "palette": _palette(),
        "fields": fields,
        "view": _view(ed, region).T.ravel().tolist(),
    }


def _kinds(label: IntArray) -> IntArray:
    kinds = np.full(len(label), len(NAMES) - 1)
    for i, name in enumerate(BODY_REGIONS):
        kinds[label == REGIONS[name]] = i + 1
    kinds[is_ring(label)] = len(NAMES) - 2
    kinds[is_plane(label)] = len(NAMES) - 1
    return kinds


def _field(title: str, unit: str, values: FloatArray, region: IntArray) -> dict[str, Any]:
    finite = values[np.isfinite(values)]
    means = {
        name: float(values[region == i].mean())
        for i, name in enumerate(NAMES)
        if i and (region == i).any() and np.isfinite(values[region == i]).all()
    }
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    filled = np.where(np.isfinite(values), values, _NOTHING)
    return {"title": title, "unit": unit, "values": _encoded(filled, np.float32), "low": low, "high": high, "means": means}


def _encoded(values: Any, kind: Any) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=np.dtype(kind).newbyteorder("<")).tobytes()).decode()


def _palette() -> list[tuple[float, ...]]:
    from matplotlib.colors import to_rgb

    return [to_rgb(c) for c in ("#BBBBBB", *(REGION_COLOURS[n] for n in BODY_REGIONS), RING_COLOUR, PLANE_COLOUR)]


def _view(points: FloatArray, region: IntArray) -> FloatArray:
    """Rows: right, up, towards the viewer; anterior in front and the roof up, where there are such."""
    middle = points.mean(axis=0)

    def towards(name: str, otherwise: tuple[float, float, float]) -> FloatArray:
        found = region == BODY_REGIONS.index(name) + 1
        return points[found].mean(axis=0) - middle if found.any() else np.array(otherwise)

    front = towards("anterior", (0.0, -1.0, 0.0))
    front = front / (np.linalg.norm(front) or 1.0)
    up = towards("roof", (0.0, 0.0, 1.0))
    up = up - (up @ front) * front
    if not np.linalg.norm(up) > 1e-9:
        up = np.cross(front, [1.0, 0.0, 0.0] if abs(front[0]) < 0.9 else [0.0, 1.0, 0.0])
    up = up / np.linalg.norm(up)
    return np.stack([np.cross(up, front), up, front])
