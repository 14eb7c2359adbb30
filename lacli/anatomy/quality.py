"""What a person checks before trusting a mesh: numbers as text and JSON, and pictures."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy import opening_pictures, pictures
from lacli.anatomy.bundle_folder import PICTURES
from lacli.anatomy.wall.thickness import Thickness, of_bundle
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import REGIONS, RINGS
from lacli.geometry.tetrahedra import curved_jacobian, scaled_jacobian
from lacli.geometry.tetrahedra import volumes as cell_volumes


def measure(bundle: Bundle) -> tuple[dict[str, Any], Thickness]:
    """Cells, volumes, cell quality, thickness per region (two ways), coordinate folds."""
    corner = bundle.tets[:, :4]
    quality = scaled_jacobian(bundle.points, corner)
    volume = cell_volumes(bundle.points, corner)
    curved = curved_jacobian(bundle.points, bundle.tets)
    thick = of_bundle(bundle)
    edges = bundle.points[corner[:, [0, 0, 0, 1, 1, 2]]] - bundle.points[corner[:, [1, 2, 3, 2, 3, 3]]]
    names = {**REGIONS, **{f"{n} ring": v for n, v in RINGS.items()}}
    report: dict[str, Any] = {
        "cells": len(bundle.tets),
        "points": len(bundle.points),
        "order": bundle.order,
        "mean_edge_mm": float(np.linalg.norm(edges, axis=2).mean()),
        "scaled_jacobian_min": float(quality.min()),
        "scaled_jacobian_share_below_0.2": float((quality < 0.2).mean()),
        "inverted_cells": int(((volume <= 0) | (curved <= 0)).sum()),
        "cavity_volume_ml": bundle.cavity_volume_ml(),
        "wall_volume_ml": bundle.wall_volume_ml(),
        "region_volume_ml": {
            n: float(volume[bundle.region == v].sum() / 1000.0) for n, v in names.items() if (bundle.region == v).any()
        },
        "thickness_mm": {n: {"eikonal": e, "laplace": p} for n, (e, p) in thick.per_region.items()},
        "thickness_median_difference_mm": thick.median_difference_mm,
    }
    if bundle.order == 2:
        report["curved_jacobian_min"] = float(curved.min())
    if bundle.uac is not None:
        report["folded_coordinate_share"] = folded_share(bundle)
    return report, thick


def folded_share(bundle: Bundle) -> float:
    """Share of endocardial triangles that are turned over in the coordinate square (jumps across the side lines left out)."""
    from lacli.anatomy.coordinates.describe import ENDO, layer_of

    assert bundle.uac is not None
    corner = bundle.uac[layer_of(bundle, ENDO).triangles]
    corner = corner[np.ptp(corner, axis=1).max(axis=1) < 0.25]
    e, f = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]
    return float((area * np.sign(np.median(area)) < 0).mean())


def text(report: dict[str, Any]) -> str:
    """The report for people."""
    lines = ["Quality of the anatomy", ""]

    def add(table: dict[str, Any], indent: str) -> None:
        for key, value in table.items():
            if isinstance(value, dict):
                lines.append(f"{indent}{key}")
                add(value, indent + "    ")
            elif isinstance(value, list):
                lines.append(f"{indent}{key}")
                lines.extend(f"{indent}    {item}" for item in value)
            else:
                shown = f"{value:.4g}" if isinstance(value, float) else str(value)
                lines.append(f"{indent}{key:<36} {shown}")

    add(report, "")
    return "\n".join(lines) + "\n"


def write(report: dict[str, Any], folder: Path) -> None:
    """``quality.json`` and ``quality.txt``."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (("quality.json", json.dumps(report, indent=2) + "\n"), ("quality.txt", text(report))):
        temporary = folder / f".part-{os.getpid()}-{name}"
        temporary.write_text(content)
        temporary.replace(folder / name)


def draw(folder: Path) -> Iterator[str]:
    """Draw the pictures of the bundle in ``folder`` into it, and name each when it is there."""
    from lacli.contracts.bundle import load

    bundle = load(folder)
    thick = of_bundle(bundle)
    drawings: dict[str, Callable[[Path], None]] = {
        "openings.png": lambda file: opening_pictures.bundle_picture(bundle, file),
        "uac.png": lambda file: pictures.square(bundle, file),
        "regions.png": lambda file: pictures.regions(bundle, file),
        "fibres.png": lambda file: pictures.fibres(bundle, file),
        "thickness.png": lambda file: pictures.thickness(bundle, thick.ids, thick.eikonal, file),
        "cuts.png": lambda file: pictures.cuts(bundle, file),
    }
    for name in PICTURES:
        drawings[name](folder / name)
        yield name


if __name__ == "__main__":
    for drawn in draw(Path(sys.argv[1])):
        print(drawn, flush=True)
