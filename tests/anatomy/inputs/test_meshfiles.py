"""Mesh files of other tools: white space of any kind, Gmsh's groups, images given as surfaces, damage in a bundle."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import gmsh
import meshio
import numpy as np
import pytest
import pyvista as pv
from shapes import cut_ball

from lacli.anatomy.inputs.meshes import carp, meshfile
from lacli.anatomy.wall.shell import mesh_shell
from lacli.base.errors import AnatomyError, InputError, UsageError
from lacli.contracts import bundle as contract
from lacli.contracts.bundle import Bundle

PTS, ELEM, LON = "3\n0 0 0\n1000 0 0\n0 2500 0\n", "1\nTr 0 1 2 11\n", "1\n1 0 0\n"


@pytest.fixture(scope="module", params=[1, 2])
def ball(request: pytest.FixtureRequest) -> Bundle:
    return mesh_shell(cut_ball(), 2.0, 9.0, order=request.param)


@pytest.mark.parametrize("blank", [" ", "\t", "  \t ", "\x0b"])
@pytest.mark.parametrize("end", ["\n", "\r\n", " \t\n", "\n\n", "\n# a comment\n"])
@pytest.mark.parametrize("packed", [False, True])
def test_carp_takes_any_white_space(tmp_path: Path, blank: str, end: str, packed: bool) -> None:
    for ending, text in ((".pts", PTS), (".elem", ELEM), (".lon", LON)):
        content = text.replace(" ", blank).replace("\n", end).encode()
        (tmp_path / f"a{ending}{'.gz' if packed else ''}").write_bytes(gzip.compress(content) if packed else content)
    mesh = carp.read(tmp_path / "a.elem")
    assert mesh.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 2.5, 0]]
    assert (mesh.kind, mesh.cells.tolist(), mesh.tag.tolist()) == ("Tr", [[0, 1, 2]], [11])
    assert mesh.fibre is not None
    assert mesh.fibre.tolist() == [[1, 0, 0]]


@pytest.mark.parametrize(
    ("ending", "text", "words"),
    [
        (".pts", "three\n0 0 0\n", "first line must be the number"),
        (".pts", "3\n", "may be truncated"),
        (".pts", "3\n0 0 0\n1 0 0\n1e308 0 0\n", "point 2 lies at"),
        (".pts", "3\n0 0 0 0\n1 0 0 0\n0 1 0 0\n", "expected 3 numbers a line, found 4"),
        (".elem", "1\nTr 0 1 -2 1\n", "names point -2"),
        (".elem", "1\nTr 0 1 1.5 1\n", "whole numbers"),
        (".elem", "1\nTr 0 1 1e300 1\n", "whole numbers"),
        (".elem", "1\n0 1 2 1\n", "expected only Tt"),
        (".elem", "2\nTr 0 1 2 1\n", "promises 2 lines"),
        (".lon", "2\n1 0 0\n", "expected 6 numbers a line, found 3"),
        (".lon", "3\n1 0 0\n", "number of directions"),
        (".lon", "1\n1 0 0\n1 0 0\n", "a line for each of 1 elements, found 2"),
    ],
)
def test_carp_damage_is_named(tmp_path: Path, ending: str, text: str, words: str) -> None:
    for name, whole in ((".pts", PTS), (".elem", ELEM), (".lon", LON)):
        (tmp_path / f"a{name}").write_text(text if name == ending else whole)
    with pytest.raises(InputError, match=words):
        carp.read(tmp_path / "a")


def test_a_compressed_text_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(carp, "MOST_BYTES", 1 << 20)
    (tmp_path / "a.pts.gz").write_bytes(gzip.compress(b"0 0 0\n" * 300_000))
    with pytest.raises(InputError, match="more than 1 MB of text"):
        carp.read(tmp_path / "a")


def test_msh_is_gmshs_with_its_groups(ball: Bundle, tmp_path: Path) -> None:
    meshfile.write(ball, tmp_path / "w.msh")
    assert (tmp_path / "w.msh").read_bytes().startswith(b"$MeshFormat\n2.2 ")
    back = meshio.gmsh.read(tmp_path / "w.msh")
    assert np.array_equal(back.cells[0].data, ball.tets)
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.open(str(tmp_path / "w.msh"))
        for dim, values in ((3, ball.region), (2, ball.tags)):
            groups = {tag: gmsh.model.getPhysicalName(d, tag) for d, tag in gmsh.model.getPhysicalGroups(dim)}
            assert set(groups) == set(values.tolist())
            assert all(groups.values())
            for tag in groups:
                found = sum(
                    len(ids)
                    for e in gmsh.model.getEntitiesForPhysicalGroup(dim, tag)
                    for ids in gmsh.model.mesh.getElements(dim, e)[1]
                )
                assert found == int((values == tag).sum())
        assert gmsh.model.getPhysicalName(2, 1) == "endocardium"
    finally:
        gmsh.finalize()


@pytest.mark.parametrize("ending", [".stl", ".ply", ".obj", ".off", ".svg"])
def test_formats_without_tetrahedra_are_refused(ending: str) -> None:
    with pytest.raises(UsageError, match="no format of tetrahedra"):
        meshfile.check_ending(Path(f"w{ending}"))


@pytest.mark.parametrize("ending", ["vtk", "vti"])
@pytest.mark.parametrize("binary", [True, False])
def test_an_image_is_no_surface(tmp_path: Path, ending: str, binary: bool) -> None:
    grid = pv.ImageData(dimensions=(4, 5, 6))
    grid["labels"] = np.zeros(120, dtype=np.uint8)
    grid.save(tmp_path / f"x.{ending}", binary=binary)
    with pytest.raises(InputError, match="holds an image"):
        meshfile.check_surface(tmp_path / f"x.{ending}")
    pv.Sphere().save(tmp_path / "s.vtk")
    meshfile.check_surface(tmp_path / "s.vtk")


@pytest.mark.parametrize("columns", [1, 2, 4])
def test_fibres_need_three_components(ball: Bundle, tmp_path: Path, columns: int) -> None:
    kind = "tetra" if ball.order == 1 else "tetra10"
    data = np.ones((len(ball.tets), columns)).squeeze()
    meshio.Mesh(ball.points, [(kind, ball.tets)], cell_data={"fibre": [data]}).write(tmp_path / "f.vtu")
    with pytest.raises(InputError, match="three components"):
        meshfile.read_fibres(tmp_path / "f.vtu")


@pytest.mark.parametrize(
    ("factor", "unit"), [(0.1, "centimetres"), (0.01, "metres|decimetres"), (1e-3, "metres"), (1e3, "micrometres")]
)
def test_a_bundle_in_another_unit_is_refused(ball: Bundle, factor: float, unit: str) -> None:
    grown = replace(ball, points=ball.points * 1.9)  # 33 mL -> 220 mL or so
    contract.check(grown, "here")
    with pytest.raises(AnatomyError, match=rf"are the lengths .*({unit})"):
        contract.check(replace(grown, points=grown.points * factor), "here")


@pytest.mark.parametrize("shift", [0.1, 1e308, float("nan")])
def test_boundary_points_are_held_against_the_wall(
    ball: Bundle, tmp_path: Path, shift: float, capfd: pytest.CaptureFixture[str]
) -> None:
    contract.save(ball, tmp_path)
    contract.load(tmp_path)
    surface = pv.read(tmp_path / "boundary.vtp")
    surface.points[3, 1] += shift
    surface.save(tmp_path / "boundary.vtp")
    with pytest.raises(AnatomyError, match=r"boundary\.vtp: point 3 lies .* of wall\.vtu; 1 points differ"):
        contract.load(tmp_path)
    assert capfd.readouterr() == ("", "")


def test_damaged_arrays_of_a_bundle_are_named(ball: Bundle) -> None:
    for changes, words in (
        ({"fibre": np.ones(len(ball.tets))}, "three components"),
        ({"uac": np.zeros((len(ball.points), 3))}, "'uac' needs"),
        ({"points": np.where(np.arange(len(ball.points))[:, None] == 5, 1e308, ball.points)}, "further away"),
    ):
        with pytest.raises(AnatomyError, match=words):
            contract.check(replace(ball, **changes), "here")
