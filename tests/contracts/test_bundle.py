"""The anatomy bundle: what is written is read, and every way of breaking the contract has its message."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
import pyvista as pv
from hypothesis import given
from hypothesis import strategies as st
from shapes import hollow_cube

from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle, check, load, save
from lacli.contracts.labels import ENDO, OTHER, PLANES
from lacli.geometry.tetrahedra import TET10_EDGES


def curved(bundle: Bundle) -> Bundle:
    """The same with 10-node cells."""
    edges = np.sort(np.concatenate([bundle.tets[:, list(e)] for e in TET10_EDGES]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middles = len(bundle.points) + inverse.reshape(6, -1).T
    numbers = {tuple(edge): len(bundle.points) + i for i, edge in enumerate(unique.tolist())}
    sides = [[numbers[tuple(sorted((t[i], t[j])))] for i, j in ((0, 1), (1, 2), (2, 0))] for t in bundle.triangles.tolist()]
    points = np.vstack([bundle.points, bundle.points[unique].mean(axis=1)])
    return replace(
        bundle,
        points=points,
        tets=np.hstack([bundle.tets, middles]),
        triangles=np.hstack([bundle.triangles, np.array(sides)]),
        transmural=points[:, 0] / 30,
    )


@pytest.mark.parametrize("make", [hollow_cube, lambda: curved(hollow_cube())])
def test_written_is_read(make: Callable[[], Bundle], tmp_path: Path) -> None:
    bundle = make()
    save(bundle, tmp_path)
    again = load(tmp_path)
    for name in ("points", "tets", "region", "triangles", "tags", "fibre", "transmural"):
        np.testing.assert_array_equal(getattr(again, name), getattr(bundle, name), err_msg=name)
    assert again.uac is None
    assert again.info == bundle.info
    assert again.cavity_volume_ml() == pytest.approx(1.0, rel=1e-12)  # (10 mm)^3


@given(st.floats(30.0, 200), st.permutations(range(64)))
def test_volume_and_checks_do_not_depend_on_size_or_numbering(size: float, order: list[int]) -> None:
    bundle = hollow_cube(size)
    new = np.empty(64, dtype=np.int64)
    new[order] = np.arange(64)
    turned = replace(
        bundle,
        points=bundle.points[order],
        tets=new[bundle.tets],
        triangles=new[bundle.triangles],
        transmural=None,
    )
    check(turned, "turned")
    assert turned.cavity_volume_ml() == pytest.approx(size**3 / 27 / 1000, rel=1e-9)


def broken(**changes: object) -> Bundle:
    return replace(hollow_cube(), **changes)  # type: ignore[arg-type]


def nan_point() -> Bundle:
    points = hollow_cube().points.copy()
    points[7, 1] = np.nan
    return broken(points=points)


def inverted_cell() -> Bundle:
    tets = hollow_cube().tets.copy()
    tets[5] = tets[5][[0, 2, 1, 3]]
    return broken(tets=tets)


def two_pieces() -> Bundle:
    one = hollow_cube()
    return replace(
        one,
        points=np.vstack([one.points, one.points + 50]),
        tets=np.vstack([one.tets, one.tets + 64]),
        region=np.tile(one.region, 2),
        triangles=np.vstack([one.triangles, one.triangles + 64]),
        tags=np.tile(one.tags, 2),
        fibre=None,
        transmural=None,
    )


def folded_cell() -> Bundle:
    """10-node cells, straight but for one edge within the wall, whose middle lies beyond a corner of its cell."""
    one = curved(hollow_cube())
    points = one.points.copy()
    cell, edge = np.argwhere(~np.isin(one.tets[:, 4:], one.triangles))[0]
    node, away = one.tets[cell, 4 + edge], next(k for k in range(4) if k not in TET10_EDGES[edge])
    points[node] += 2 * (points[one.tets[cell, away]] - points[node])
    return replace(one, points=points)


def one_value(array: str, value: float) -> Bundle:
    changed = getattr(hollow_cube(), array).copy()
    changed[3] = value
    return broken(**{array: changed})


def untagged_cavity_face() -> Bundle:
    bundle = hollow_cube()
    tags = bundle.tags.copy()
    tags[np.flatnonzero(tags == ENDO)[:1]] = OTHER
    return replace(bundle, tags=tags)


def flipped_triangle() -> Bundle:
    triangles = hollow_cube().triangles.copy()
    triangles[4] = triangles[4][::-1]
    return broken(triangles=triangles)


@pytest.mark.parametrize(
    ("bundle", "message"),
    [
        (nan_point, "point 7 of the wall has a coordinate that is not finite"),
        (inverted_cell, r"1 inverted or flat cells, the worst is 5 \(-167 mm3\)"),
        (folded_cell, r"curved cells are folded by the nodes on their edges, the worst is \d+ \(its Jacobian falls to -"),
        (two_pieces, "falls into 2 unconnected pieces"),
        (lambda: broken(points=np.vstack([hollow_cube().points, [[1.0, 1, 1]]]), transmural=None), "1 points belong to no cell"),
        (lambda: broken(points=hollow_cube().points * 1000), "30000 mm wide; are the lengths micrometres"),
        (lambda: broken(points=hollow_cube().points / 1000), "0.03 mm wide; are the lengths metres"),
        (lambda: one_value("region", 7), "unknown region 7"),
        (lambda: one_value("tags", 99), "unknown tag 99"),
        (lambda: broken(region=hollow_cube().region[:-1]), "does not have one value per cell"),
        (lambda: one_value("fibre", np.nan), "finite unit vectors"),
        (lambda: one_value("fibre", 2.0), "finite unit vectors"),
        (lambda: one_value("transmural", np.nan), "'transmural' needs one finite value"),
        (lambda: one_value("tets", 64), "names a point that does not exist"),
        (untagged_cavity_face, r"open along 3 edges, one of them at \(.*\) mm; a valve plane or a tag is missing"),
        (flipped_triangle, "1 boundary triangles .* no outer faces of the wall, or turned"),
        (lambda: broken(triangles=hollow_cube().triangles[1:], tags=hollow_cube().tags[1:]), "1 outer faces .* no tag"),
    ],
)
def test_broken_bundles_are_named(bundle: Callable[[], Bundle], message: str, tmp_path: Path) -> None:
    with pytest.raises(AnatomyError, match=message):
        check(bundle(), "here")


def test_a_valve_plane_closes_the_cavity() -> None:
    bundle = untagged_cavity_face()
    tags = bundle.tags.copy()
    tags[tags == OTHER] = PLANES["mv"]
    check(replace(bundle, tags=tags), "closed again")


def saved(folder: Path) -> Path:
    save(hollow_cube(), folder)
    return folder


@pytest.mark.parametrize("name", ["wall.vtu", "boundary.vtp", "anatomy.json"])
def test_missing_or_damaged_file_is_named(name: str, tmp_path: Path) -> None:
    folder = saved(tmp_path)
    text = (folder / name).read_bytes()
    (folder / name).write_bytes(text[: len(text) // 2])
    with pytest.raises(AnatomyError, match=f"cannot be read|{name}"):
        load(folder)
    (folder / name).unlink()
    with pytest.raises(AnatomyError, match=f"not an anatomy bundle, {name} is missing"):
        load(folder)


def test_missing_arrays_are_named(tmp_path: Path) -> None:
    folder = saved(tmp_path)
    bundle = hollow_cube()
    meshio.Mesh(bundle.points, [("tetra", bundle.tets)]).write(folder / "wall.vtu")
    with pytest.raises(AnatomyError, match="'region' is missing"):
        load(folder)
    meshio.Mesh(bundle.points, [("triangle", bundle.triangles)]).write(folder / "wall.vtu")
    with pytest.raises(AnatomyError, match="expected one block of tetra or tetra10"):
        load(folder)
    for name, data in (("tag", "cell_data"), ("wall_point", "point_data")):
        surface = pv.read(saved(folder) / "boundary.vtp")
        del getattr(surface, data)[name]
        surface.save(folder / "boundary.vtp")
        with pytest.raises(AnatomyError, match=f"array '{name}' is missing"):
            load(folder)


def test_boundary_of_another_wall_is_refused(tmp_path: Path) -> None:
    folder = saved(tmp_path)
    surface = pv.read(folder / "boundary.vtp")
    surface.point_data["wall_point"] = surface.point_data["wall_point"] + 40
    surface.save(folder / "boundary.vtp")
    with pytest.raises(AnatomyError, match=r"names a point that wall\.vtu does not have"):
        load(folder)
    surface.point_data["wall_point"] = (surface.point_data["wall_point"] - 39) % 64
    surface.save(folder / "boundary.vtp")
    with pytest.raises(AnatomyError, match=r"from its point .* of another bundle"):
        load(folder)
    surface.points = hollow_cube().points[surface.point_data["wall_point"]]
    surface.save(folder / "boundary.vtp")
    with pytest.raises(AnatomyError, match="no outer faces"):
        load(folder)


def test_description_is_json(tmp_path: Path) -> None:
    folder = saved(tmp_path)
    assert json.loads((folder / "anatomy.json").read_text()) == {"provenance": "a cube"}
