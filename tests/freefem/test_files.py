"""Files and scripts as FreeFEM reads them: exact numbers, its own order of nodes, nothing that is not finite."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lacli.base.errors import InputError
from lacli.freefem import template
from lacli.freefem.files import (
    CELL_ORDER,
    FACE_ORDER,
    read_history,
    read_rows,
    read_state,
    write_arrays,
    write_faces,
    write_medit,
)
from lacli.freefem.template import render_template


@given(arrays.arrays(np.float64, st.integers(1, 20), elements=st.floats(allow_nan=False, allow_infinity=False)))
def test_numbers_come_back_bit_for_bit(tmp_path_factory: pytest.TempPathFactory, values: np.ndarray) -> None:
    file = tmp_path_factory.mktemp("arrays") / "a.txt"
    write_arrays(file, values, np.arange(3))
    lines = file.read_text().split()
    n = len(values)
    assert lines[:2] == [str(n), str(n)] and lines[2 + n :] == ["3", "3", "0", "1", "2"]
    assert np.array([float(x) for x in lines[2 : 2 + n]]).tobytes() == values.tobytes()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(bad: float, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not finite; check fibres and coordinates"):
        write_arrays(tmp_path / "a.txt", np.array([1.0, bad]))


def test_a_mesh_numbers_its_corners_from_one_and_leaves_the_middles_out(tmp_path: Path) -> None:
    points = np.array([[9.0, 9, 9], [0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1 / 3], [0.5, 0, 0]])  # 0 and 5 are no corners
    write_medit(tmp_path / "m.mesh", points, np.array([[1, 2, 3, 4]]), np.array([7]), np.array([[1, 3, 2]]), np.array([5]))
    words = (tmp_path / "m.mesh").read_text().split()
    assert words[: words.index("Tetrahedra")][5:6] == ["4"]
    at = words.index("Tetrahedra")
    assert words[at : at + 7] == ["Tetrahedra", "1", "1", "2", "3", "4", "7"]
    assert words[at + 7 :] == ["Triangles", "1", "1", "3", "2", "5", "End"]
    vertices = np.array(words[words.index("Vertices") + 2 : at], dtype=float).reshape(4, 4)
    assert (vertices[:, :3] == points[1:5]).all() and (vertices[:, 3] == 0).all()


def middles(corners: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
    return np.vstack([corners, [(corners[a] + corners[b]) / 2 for a, b in pairs]])


def test_the_orders_take_vtk_s_middles_to_freefem_s() -> None:
    corners = np.vstack([np.zeros(3), np.eye(3)])
    vtk = middles(corners, [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)])
    assert (vtk[CELL_ORDER] == middles(corners, [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])).all()
    face = middles(corners[1:], [(0, 1), (1, 2), (2, 0)])
    assert (face[FACE_ORDER] == middles(corners[1:], [(1, 2), (2, 0), (0, 1)])).all()


def test_faces_without_weights_weigh_one_at_each_of_seven_points(tmp_path: Path) -> None:
    write_faces(tmp_path / "f.txt", np.array([[4, 5, 6, 7, 8, 9]]))
    words = (tmp_path / "f.txt").read_text().split()
    assert words == ["6", "6", "4", "5", "6", "8", "9", "7", "7", "7", *["1"] * 7]
    write_faces(tmp_path / "f.txt", np.array([[4, 5, 6]]), np.linspace(0, 1, 7)[None])
    assert [float(x) for x in (tmp_path / "f.txt").read_text().split()[7:]] == np.linspace(0, 1, 7).tolist()


@pytest.fixture
def templates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(template.resources, "folder", lambda name: tmp_path)
    return tmp_path


def test_numbers_of_a_script_are_whole_and_finite(templates: Path) -> None:
    (templates / "t.edp").write_text("real c = {{ c }}; // {{ n }} {{ plugin }}\n{% if flag %}\nyes\n{% endif %}\n")
    made = render_template("t.edp", Path("/x/engine.so"), c=0.1 + 0.2, n=3, flag=True)
    assert made == "real c = 0.30000000000000004; // 3 /x/engine\nyes\n"
    assert render_template("t.edp", None, c=np.float64(1e-300), n=3, flag=False).startswith("real c = 1e-300;")
    with pytest.raises(ValueError, match="not finite"):
        render_template("t.edp", None, c=float("nan"), n=3, flag=True)


def test_a_name_that_is_missing_and_a_path_that_ends_a_string_are_refused(templates: Path) -> None:
    from jinja2 import UndefinedError

    (templates / "t.edp").write_text("{{ plugin }} {{ missing }}")
    with pytest.raises(UndefinedError, match="missing"):
        render_template("t.edp", None)
    with pytest.raises(ValueError, match="characters that a FreeFEM string cannot hold"):
        render_template("t.edp", Path('/x/"; exec("rm");//.so'))


def test_a_history_s_numbers_are_found_by_name(tmp_path: Path) -> None:
    file = tmp_path / "history.txt"
    file.write_text("counts unknowns=12 newton=3\nstate_es min_j=0.5 pressure_kpa=2.6\nend\nstate_unloaded min_j=0.")
    assert read_history(file) == {
        "counts": {"newton": 3.0, "unknowns": 12.0}, "state_es": {"pressure_kpa": 2.6, "min_j": 0.5}, "end": {},
    }  # fmt: skip
    file.write_text("counts 12 3\n")
    with pytest.raises(ValueError):
        read_history(file)


def test_a_state_s_columns_are_found_by_name(tmp_path: Path) -> None:
    file = tmp_path / "es.txt"
    x, reference = np.random.default_rng(2).random((2, 5, 3))
    for names, columns in (("x y z X Y Z", (x, reference)), ("X Y Z x y z", (reference, x))):
        np.savetxt(file, np.hstack(columns), header=names, comments="", fmt="%.17g")
        again, rest = read_state(file, 5)
        assert (again == x).all() and (rest == reference).all()
    with pytest.raises(ValueError, match=r"es\.txt is incomplete"):
        read_state(file, 6)
    np.savetxt(file, np.hstack([x, reference]), header="x y z X Y W", comments="")
    with pytest.raises(ValueError, match=r"es\.txt has no Z"):
        read_state(file, 5)


def test_rows_stand_under_their_names(tmp_path: Path) -> None:
    file = tmp_path / "rows.txt"
    file.write_text("energy 1.5\nforce 1 2 3\nenergy -2\nforce 4 5 6\n")
    rows = read_rows(file)
    assert rows["energy"].tolist() == [[1.5], [-2.0]] and rows["force"].tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("text", ["a 1 2\na 1\n", "a 1 2", "a\n", "a one\n", "a 1 nan\n"])
def test_rows_that_are_cut_short_or_no_numbers_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "rows.txt").write_text(text)
    with pytest.raises(ValueError, match=r"."):
        read_rows(tmp_path / "rows.txt")
