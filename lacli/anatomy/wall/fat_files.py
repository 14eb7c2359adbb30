"""Epicardial fat's blood pool, from a label map or a bundle, and the files that a segmentation leaves."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from lacli.anatomy import pictures
from lacli.anatomy.inputs import extraction, image
from lacli.anatomy.meshing import la_label, naming
from lacli.anatomy.wall import fat
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.geometry.subdivision import straight
from lacli.geometry.surface import Surface, compact


def pool_of(labels: Path | None, la: int | None, anatomy: Bundle | None) -> tuple[Surface, list[str]]:
    """The blood pool's surface (of the label map, else the bundle's cavity), and notes on its image."""
    if labels is not None:
        map_ = image.read_labels(labels)
        with naming(labels):
            label = la_label(labels, image.label_volumes(map_), la)
            blood = extraction.blood_pool(map_, label)
            return extraction.surface_of(blood.mask), [f"{labels}: {note}" for note in blood.notes]
    assert anatomy is not None
    triangles = straight(anatomy.cavity_triangles())[:, ::-1].copy()
    return compact(Surface(anatomy.points, triangles, np.zeros(len(triangles), dtype=np.int64))), []


def save(found: dict[str, Any], folder: Path, ct: Path, reach: float, notes: list[str]) -> dict[str, Any]:
    """The report; fat.vtp, fat.vtu and fat.json are written together. reach: mm. Raises AnatomyError where there is no fat."""
    standard = found["standard"]
    if not standard.mask.array.any():
        raise AnatomyError(f"{ct}: no fat within {reach:g} mm of the blood pool; do CT and blood pool share a frame (LPS mm)?")
    report: dict[str, Any] = {
        "ct": str(ct),
        "within_mm": reach,
        "notes": notes,
        "windows": {
            w: {
                "hu": list(fat.WINDOWS[w]),
                "fat_ml": f.volume_ml,
                "voxels_in_window_ml": f.window_ml,
                "per_region_ml": f.per_region_ml,
            }
            for w, f in found.items()
        },
    }
    points, cells, region = fat.cells(standard)
    surface = pictures.polydata(fat.surface_of(standard))
    voxels = meshio.Mesh(points, [("hexahedron", cells)], cell_data={"region": [region.astype("int32")]})
    report["files"] = ["fat.vtu", "fat.vtp", "fat.json"]
    folder.mkdir(parents=True, exist_ok=True)
    part = {name: folder / f".part-{os.getpid()}-{name}" for name in report["files"]}
    try:  # all of them, then their names
        voxels.write(part["fat.vtu"])
        surface.save(part["fat.vtp"])
        part["fat.json"].write_text(json.dumps(report, indent=2) + "\n")
        for name, temporary in part.items():
            temporary.replace(folder / name)
    finally:
        for temporary in part.values():
            temporary.unlink(missing_ok=True)
    return report
