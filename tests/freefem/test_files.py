"""FreeFEM's own formats: what is written is what was given, to the last bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from shapes import hollow_cube

from lacli.base.errors import InputError
from lacli.freefem.files import FACE_ORDER, write_arrays, write_faces, write_medit


def numbers(file: Path) -> list[str]:
    return file.read_text().split()


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=9), st.lists(st.integers(-9, 9), min_size=1)
)
def test_arrays_are_their_length_twice_and_every_bit(tmp_path: Path, reals: list[float], whole: list[int]) -> None:
    write_arrays(tmp_path / "a.txt", np.array(reals), np.array(whole))
    words = numbers(tmp_path / "a.txt")
    assert words[:2] == [str(len(reals))] * 2
    assert [float(w) for w in words[2 : 2 + len(reals)]] == reals
    rest = words[2 + len(reals) :]
    assert rest == [str(len(whole)), str(len(whole)), *map(str, whole)]


def test_what_is_not_finite_never_reaches_the_simulation(tmp_path: Path) -> None:
    for bad in (np.nan, np.inf):
        with pytest.raises(InputError, match="not finite; check fibres and coordinates"):
            write_arrays(tmp_path / "a.txt", np.array([1.0, bad]))


def test_a_mesh_has_the_corners_alone_and_ids_from_one(tmp_path: Path) -> None:
    bundle = hollow_cube()
    points = np.vstack([bundle.points, [[99.0, 99, 99]]])  # no corner of a cell
    write_medit(tmp_path / "m.mesh", points, bundle.tets, bundle.region, bundle.triangles, bundle.tags)
    lines = (tmp_path / "m.mesh").read_text().splitlines()
    at = lines.index("Vertices")
    assert lines[at + 1] == str(len(bundle.points)) and "99" not in lines[at + 2 + len(bundle.points) - 1]
    read = np.array([line.split()[:3] for line in lines[at + 2 : at + 2 + len(bundle.points)]], float)
    assert (read == bundle.points).all()
    at = lines.index("Tetrahedra")
    cells = np.array([line.split() for line in lines[at + 2 : at + 2 + len(bundle.tets)]], int)
    assert (cells[:, :4] == bundle.tets + 1).all() and (cells[:, 4] == bundle.region).all()
    assert lines[-1] == "End"


def test_faces_are_in_freefem_s_order_with_their_weights(tmp_path: Path) -> None:
    write_faces(tmp_path / "f.txt", np.array([[10, 11, 12, 13, 14, 15]]))
    words = numbers(tmp_path / "f.txt")
    assert words[:8] == ["6", "6", *(str(10 + i) for i in FACE_ORDER)]
    assert words[8:10] == ["7", "7"] and [float(w) for w in words[10:]] == [1.0] * 7
    write_faces(tmp_path / "f.txt", np.array([[0, 1, 2]]), np.arange(7.0)[None])
    assert [float(w) for w in numbers(tmp_path / "f.txt")[7:]] == list(np.arange(7.0))
