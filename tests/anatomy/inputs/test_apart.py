"""Damaged mesh files: whatever becomes of the library that reads them, lacli says one thing and goes on."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy.inputs.meshes import anything, apart, meshfile, surfacefile
from lacli.base.errors import InputError


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    import pyvista as pv

    pv.Sphere(radius=25.0, theta_resolution=24, phi_resolution=24).save(tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


@pytest.mark.parametrize("place", [-1, -13 * 40 - 1])
def test_a_reader_that_crashes_takes_nothing_along(ball: Path, place: int) -> None:
    """The last byte of a triangle's third point number: VTK's PLY reader ends its process by a signal on it."""
    content = bytearray(ball.read_bytes())
    content[place] ^= 0x7F
    ball.write_bytes(content)
    with pytest.raises(InputError, match=r"ball\.ply: .*[Ee]xport"):
        surfacefile.read(ball)


def test_a_polygon_that_names_no_point_is_told(tmp_path: Path) -> None:
    lines = ["# vtk DataFile Version 3.0", "x", "ASCII", "DATASET POLYDATA", "POINTS 3 float", "0 0 0 50 0 0 0 50 0"]
    for cells in ("POLYGONS 1 4\n3 0 1 3", "POLYGONS 1 4\n3 0 1 -2", "TRIANGLE_STRIPS 1 4\n3 0 1 70000"):
        (tmp_path / "p.vtk").write_text("\n".join([*lines, cells, ""]))
        with pytest.raises(InputError, match=r"p\.vtk: (a cell names a point that does not exist|.*broke down)"):
            anything.read(tmp_path / "p.vtk")


def bomb(points: bytes, blocks: int) -> str:
    """A VTU whose points unpack to ``blocks`` times 64 MB."""
    size = 64 << 20
    packed = zlib.compress(points * (size // len(points)), 9)
    head = struct.pack(f"<{3 + blocks}I", blocks, size, size, *[len(packed)] * blocks)
    text = base64.b64encode(head).decode() + base64.b64encode(packed * blocks).decode()
    count = blocks * size // 24
    array = f'<DataArray type="Float64" NumberOfComponents="3" format="binary">{text}</DataArray>'
    return (
        '<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" compressor="vtkZLibDataCompressor">'
        f'<UnstructuredGrid><Piece NumberOfPoints="{count}" NumberOfCells="0"><Points>{array}</Points>'
        '<Cells><DataArray type="Int32" Name="connectivity" format="ascii"></DataArray>'
        '<DataArray type="Int32" Name="offsets" format="ascii"></DataArray>'
        '<DataArray type="UInt8" Name="types" format="ascii"></DataArray></Cells></Piece></UnstructuredGrid></VTKFile>'
    )


@pytest.mark.parametrize("read", [anything.read, meshfile.read_fibres])
def test_a_file_that_unpacks_without_end_is_not_unpacked_here(tmp_path: Path, read: object) -> None:
    (tmp_path / "b.vtu").write_text(bomb(bytes(1 << 20), 60))  # 4 GB in 5 MB
    with pytest.raises(InputError, match=r"b\.vtu: "):
        read(tmp_path / "b.vtu")  # type: ignore[operator]


def test_a_reader_that_hangs_is_ended(ball: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(apart, "_TIMEOUT_S", 0.05)
    with pytest.raises(InputError, match=r"ball\.ply: reading it takes longer than"):
        surfacefile.read(ball)


def test_tags_and_tetrahedra_come_back(tmp_path: Path) -> None:
    import pyvista as pv

    points = np.array([[0.0, 0, 0], [50, 0, 0], [0, 50, 0], [0, 0, 50], [50, 50, 50]])
    grid = pv.UnstructuredGrid({10: np.array([[0, 1, 2, 3], [1, 2, 3, 4]])}, points)
    grid.cell_data["elemTag"] = np.array([7, 9])
    grid.save(tmp_path / "t.vtu")
    found = apart.content(tmp_path / "t.vtu", "surface")
    assert found["tets"].tolist() == [[0, 1, 2, 3], [1, 2, 3, 4]] and np.array_equal(found["grid_points"], points)
    assert found["cell_names"].tolist() == ["elemTag"] and found["cell_0"].tolist() == [7, 9]
    surface = pv.PolyData(points, np.array([4, 0, 1, 2, 3, 3, 1, 2, 4]))  # a square is cut in two triangles
    surface.save(tmp_path / "s.vtp")
    assert len(anything.read(tmp_path / "s.vtp").triangles) == 3
