"""One synthetic atrium in every form of file that people have, meshed by the command: right, warned, wrong, refused.

Run: python benchmarks/forms.py [--seed 3] [--only WORD] [--record FILE.jsonl] [--keep FOLDER]

Surfaces open at the valve and four veins (the appendage as it is), surfaces with flat caps and labels, shells of endocardium and
epicardium, tetrahedra of the wall with and without tags, label maps; lengths in micrometres to metres. Judged as in atria.py.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import atria
import numpy as np
import pyvista as pv
import SimpleITK as sitk

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.inputs.meshes import carp
from lacli.base.arrays import IntArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, EPI, PLANES, is_plane, is_ring
from lacli.geometry.surface import Surface, compact
from lacli.synthetic.atrium import cavity, sized, synthesize
from lacli.synthetic.image import LA, LV, images
from lacli.synthetic.variants import make

Writer = Callable[[Path], dict[str, Any]]  # writes the file; options of the command
TURN_DEG = 20.0  # of the oblique map


class Forms:
    """The atrium of a seed: surface, wall and images, and the writers of its files by name."""

    def __init__(self, seed: int) -> None:
        self.points, self.triangles, self.openings = make(seed, "open")
        self.seed = seed
        self._bundle: Bundle | None = None
        self._maps: dict[tuple[float, float, float], Image] = {}

    def wall(self) -> Bundle:
        """The atrium's wall, straight cells of 3.5 mm."""
        if self._bundle is None:
            self._bundle = synthesize(self.seed, cell_size_mm=3.5, order=1)[0]
        return self._bundle

    def open_wall(self) -> IntArray:
        """Which of the wall's cells are tissue: those of the planes close its openings."""
        return np.flatnonzero(~is_plane(self.wall().region))

    def label_map(self, spacing: tuple[float, float, float]) -> Image:
        """Blood and ventricle."""
        if spacing not in self._maps:
            self._maps[spacing] = images(self.seed, spacing_mm=spacing).labels
        return self._maps[spacing]

    def writers(self) -> dict[str, tuple[Writer, str]]:
        """How each file is written, and its unit."""
        found: dict[str, tuple[Writer, str]] = {}
        for name in ("open.vtp", "open-ascii.vtk", "open-binary.vtk", "open.stl", "open-ascii.stl", "open.ply", "open.obj"):
            found[name] = (lambda file: self.surface(file, 1.0), "mm")
        found["open-4.2.vtk"] = (self.old_legacy, "mm")
        found["open.elem"] = (lambda file: self.carp_surface(file, 1e3), "um")
        for unit, factor in (("um", 1e3), ("cm", 0.1), ("m", 1e-3)):
            found[f"open-{unit}.stl"] = (lambda file, factor=factor: self.surface(file, factor), unit)  # type: ignore[misc]
        found["capped.vtp"] = (self.capped, "mm")
        found["bilayer.vtp"] = (self.bilayer, "mm")
        for tags in (True, False):
            word = "tagged" if tags else "plain"
            for ending in (".vtu", ".vtk", "-closed.vtu"):
                found[f"tets-{word}{ending}"] = (lambda file, tags=tags: self.tetrahedra(file, tags), "mm")  # type: ignore[misc]
            found[f"tets-{word}.elem"] = (lambda file, tags=tags: self.carp_tetrahedra(file, tags), "um")  # type: ignore[misc]
        for name in ("map.nii.gz", "map.nrrd", "map.mha", "map-float.nii.gz", "map-oblique.nii.gz", "map-oblique.nrrd"):
            found[name] = (lambda file: self.voxels(file, (0.8, 0.8, 0.8)), "mm")
        found["map-anisotropic.nrrd"] = (lambda file: self.voxels(file, (0.5, 0.5, 1.5)), "mm")
        found["map-coarse.nii.gz"] = (lambda file: self.voxels(file, (1.2, 1.2, 1.2)), "mm")
        return found

    def surface(self, file: Path, factor: float) -> dict[str, Any]:
        """The open surface."""
        mesh = pv.PolyData.from_regular_faces(factor * self.points, self.triangles)
        mesh.save(file, binary="ascii" not in file.name)
        return {}

    def old_legacy(self, file: Path) -> dict[str, Any]:
        """VTK's legacy format as before version 9: polygons as one list."""
        lines = ["# vtk DataFile Version 4.2", "left atrium", "ASCII", "DATASET POLYDATA", f"POINTS {len(self.points)} float"]
        lines += [" ".join(f"{x:.5f}" for x in p) for p in self.points]
        lines += [f"POLYGONS {len(self.triangles)} {4 * len(self.triangles)}", *(f"3 {a} {b} {c}" for a, b, c in self.triangles)]
        file.write_text("\n".join(lines) + "\n")
        return {}

    def carp_surface(self, file: Path, factor: float) -> dict[str, Any]:
        """Triangles as openCARP has them."""
        file.with_suffix(".pts").write_text(
            f"{len(self.points)}\n" + "".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in factor * self.points)
        )
        file.write_text(f"{len(self.triangles)}\n" + "".join(f"Tr {a} {b} {c} 1\n" for a, b, c in self.triangles))
        return {}

    def capped(self, file: Path) -> dict[str, Any]:
        """Closed by flat caps with labels, as programs for electro-anatomical maps write it."""
        whole = cavity(sized(self.seed))
        mesh = pv.PolyData.from_regular_faces(whole.points, whole.triangles)
        mesh.cell_data["label"] = whole.label.astype(np.int32)
        mesh.save(file)
        self.openings |= {name: self._middle(whole, value) for name, value in PLANES.items()}
        return {}

    @staticmethod
    def _middle(surface: Surface, value: int) -> np.ndarray:
        return np.asarray(surface.points[np.unique(surface.triangles[surface.label == value])].mean(axis=0))

    def bilayer(self, file: Path) -> dict[str, Any]:
        """Endocardium and epicardium in one file, not joined."""
        wall = self.wall()
        parts = []
        for side in (wall.tags == ENDO, (wall.tags == EPI) | is_ring(wall.tags)):
            piece = compact(Surface(wall.points, wall.triangles[side][:, :3], np.zeros(int(side.sum()), dtype=np.int64)))
            parts.append(pv.PolyData.from_regular_faces(piece.points, piece.triangles))
        both = pv.merge(parts, merge_points=False)
        both.save(file)
        return {}

    def tetrahedra(self, file: Path, tags: bool) -> dict[str, Any]:
        """The wall's cells by VTK."""
        wall = self.wall()
        cells = slice(None) if "closed" in file.name else self.open_wall()
        grid = pv.UnstructuredGrid({pv.CellType.TETRA: wall.tets[cells, :4]}, wall.points)
        if tags:
            grid.cell_data["elemTag"] = wall.region[cells].astype(np.int32)
        grid.save(file)
        return {}

    def carp_tetrahedra(self, file: Path, tags: bool) -> dict[str, Any]:
        """The wall's cells as openCARP has them, with fibres where they have tags."""
        wall = self.wall()
        cells = self.open_wall()
        tag = wall.region[cells] if tags else np.ones_like(cells)
        fibre = wall.fibre[cells] if tags else None
        carp.write(carp.CarpMesh(wall.points, "Tt", wall.tets[cells, :4], tag, fibre), file.with_suffix(""))
        return {}

    def voxels(self, file: Path, spacing: tuple[float, float, float]) -> dict[str, Any]:
        """A label map of the blood: by its name of floating-point labels, or of turned axes."""
        image = self.label_map(spacing)
        array = image.array.astype(np.float32 if "float" in file.name else np.uint8)
        if "oblique" in file.name:
            a = np.radians(TURN_DEG)
            turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
            turn = turn @ np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
            # the heart as it lies, seen through a turned stack of slices
            turned = replace(image, direction=turn, origin=turn @ image.origin)
            array = self._resampled(image, turned).astype(array.dtype)
            image = turned
        out = sitk.GetImageFromArray(array)
        out.SetSpacing([float(x) for x in image.spacing])
        out.SetOrigin([float(x) for x in image.origin])
        out.SetDirection([float(x) for x in image.direction.ravel()])
        sitk.WriteImage(out, str(file))
        return {"la": LA, "lv": LV}

    @staticmethod
    def _resampled(image: Image, onto: Image) -> np.ndarray:
        nk, nj, ni = image.array.shape
        index = np.stack(np.meshgrid(np.arange(ni), np.arange(nj), np.arange(nk), indexing="ij"), axis=-1).reshape(-1, 3)
        at = np.rint(image.to_index(onto.to_world(index))).astype(int)
        inside = ((at >= 0) & (at < [ni, nj, nk])).all(axis=1)
        out = np.zeros(image.array.shape, dtype=image.array.dtype)
        i, j, k = index[inside].T
        x, y, z = at[inside].T
        out[k, j, i] = image.array[z, y, x]
        return out


def main() -> None:
    """Write, mesh, judge, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--only", default="", help="files whose name holds this word")
    parser.add_argument("--record", type=Path, help="file of rows, to go on with")
    parser.add_argument("--keep", type=Path, help="folder for the files")
    asked = parser.parse_args()
    rows = [] if asked.record is None or not asked.record.is_file() else atria.read_rows(asked.record)
    done = {row["file"] for row in rows}
    forms = Forms(asked.seed)
    with tempfile.TemporaryDirectory() as made:
        folder = asked.keep or Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        for name, (write, unit) in forms.writers().items():
            if asked.only not in name or name in done:
                continue
            options = write(folder / name)
            scale = 1.0 / atria.SCALE[unit]
            truth = {
                "file": name, "args": options, "units": unit, "tol_mm": 10, "expect": "right", "appendage": "open",
                "openings": {n: (scale * np.asarray(c)).tolist() for n, c in forms.openings.items()},
            }  # fmt: skip
            got = {"file": name, **atria.one(folder / name, truth, False)}
            rows.append(got)
            if asked.record is not None:
                with asked.record.open("a") as stream:
                    stream.write(json.dumps(got) + "\n")
            atria.show(got)
    atria.summary(rows)


if __name__ == "__main__":
    main()
