"""The two sides of a wall of tetrahedra, tagged or not, in whatever file it comes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy.inputs.meshes import anything, solid
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry.prisms import split_prisms

THICK_MM = 2.0


def bowl(noise_mm: float = 0.0) -> tuple[FloatArray, IntArray, int]:
    """A ball of radius 22 with a wall of 2 mm outside it, open above z = 14 and below z = -20: points, tetrahedra, triangles
    of a side."""
    import pyvista as pv

    ball = pv.Icosphere(radius=22.0, nsub=4)
    points, triangles = np.asarray(ball.points, dtype=float), ball.regular_faces
    height = points[triangles].mean(axis=1)[:, 2]
    triangles = triangles[(height < 14.0) & (height > -20.0)]
    used, local = np.unique(triangles, return_inverse=True)
    points, triangles = points[used], local.reshape(-1, 3)
    points = points + noise_mm * np.random.default_rng(1).normal(size=points.shape)
    n = len(points)
    ordered = np.sort(triangles, axis=1)  # each side's diagonal starts at its point of the lower number: both cells agree
    starts = np.tile([True, True, False], (len(triangles), 1))
    tets = split_prisms(ordered, ordered + n, starts)
    out = points / np.linalg.norm(points, axis=1)[:, None]
    return np.vstack([points, points + THICK_MM * out]), tets, len(triangles)


@pytest.mark.parametrize("noise_mm", [0.0, 0.15])
def test_each_face_is_on_its_side_and_each_opening_has_one_rim(noise_mm: float) -> None:
    points, tets, count = bowl(noise_mm)
    tag = np.arange(len(tets))
    inner, tags, outer = solid.shells(points, tets, tag)
    half = len(points) // 2
    # every face is on its own side; of the 252 of the cut (zigzag, so that some look along the wall) few come along
    for side, mine in ((inner, inner < half), (outer, outer >= half)):
        assert mine.all(axis=1).sum() == count
        assert mine.any(axis=1).all() and len(side) - count < 0.01 * count
    assert len(paths.loops(paths.open_edges(inner))) == len(paths.loops(paths.open_edges(outer))) == 2
    assert np.isin(inner, tets[tags]).all()
    assert all(set(face) <= set(tets[t]) for face, t in zip(inner.tolist(), tags.tolist(), strict=True))


def test_a_block_has_no_inside() -> None:
    import pyvista as pv

    block = pv.ImageData(dimensions=(6, 6, 6), spacing=(8.0, 8.0, 8.0)).to_tetrahedra(5)
    tets = block.cells.reshape(-1, 5)[:, 1:]
    with pytest.raises(AnatomyError, match="endocardium as a surface"):
        solid.shells(np.asarray(block.points, dtype=float), tets, np.zeros(len(tets), dtype=np.int64))


@pytest.mark.parametrize("ending", [".vtu", ".vtk"])
@pytest.mark.parametrize("tagged", [True, False])
def test_a_file_of_tetrahedra_is_read_as_its_two_sides(tmp_path: Path, ending: str, tagged: bool) -> None:
    import pyvista as pv

    points, tets, count = bowl()
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: tets}, points)
    if tagged:
        grid.cell_data["elemTag"] = np.full(len(tets), 11)
    grid.save(tmp_path / f"wall{ending}")
    mesh = anything.read(tmp_path / f"wall{ending}")
    assert mesh.outer is not None
    assert len(mesh.triangles) == pytest.approx(count, rel=0.01) and len(mesh.outer) == pytest.approx(count, rel=0.01)
    assert "tetrahedra" in mesh.notes[0]
    assert mesh.tag is not None and set(mesh.tag.tolist()) == {11 if tagged else 0}
