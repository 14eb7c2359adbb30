"""CARP text meshes: nothing is lost on the way out and in, and damage is named."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lacli.anatomy.inputs.meshes import carp
from lacli.base.errors import InputError

lengths = st.floats(-200, 200, allow_nan=False)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    points=st.lists(st.tuples(lengths, lengths, lengths), min_size=4, max_size=9),
    tags=st.lists(st.integers(0, 99), min_size=1, max_size=5),
    data=st.data(),
)
def test_round_trip(tmp_path: Path, points: list[tuple[float, float, float]], tags: list[int], data: st.DataObject) -> None:
    cells = np.array([data.draw(st.permutations(range(len(points))))[:4] for _ in tags])
    fibre = np.tile([0.6, 0.0, 0.8], (len(tags), 1))
    carp.write(carp.CarpMesh(np.array(points, dtype=float), "Tt", cells, np.array(tags), fibre), tmp_path / "mesh")
    back = carp.read(tmp_path / "mesh.elem")
    # micrometres and back: two roundings
    assert back.points == pytest.approx(np.array(points), rel=1e-15, abs=1e-300)
    assert np.array_equal(back.cells, cells)
    assert np.array_equal(back.tag, tags)
    assert np.array_equal(back.fibre, fibre)


def test_units_gzip_and_missing_direction_count(tmp_path: Path) -> None:
    (tmp_path / "a.pts.gz").write_bytes(gzip.compress(b"3\n0 0 0\n1000 0 0\n0 2500 0\n"))
    (tmp_path / "a.elem").write_text("1\nTr 0 1 2 11\n")
    (tmp_path / "a.lon").write_text("1 0 0\n")
    mesh = carp.read(tmp_path / "a")
    assert mesh.points[2, 1] == 2.5  # micrometres to mm
    assert mesh.kind == "Tr"
    assert mesh.tag.tolist() == [11]
    assert mesh.fibre is not None


@pytest.mark.parametrize(
    ("pts", "elem", "words"),
    [
        ("3\n0 0 0\n1 0 0\n", "1\nTr 0 1 2 1\n", "promises 3 lines"),
        ("2\n0 0 0\n1 0\n", "1\nTr 0 1 2 1\n", "truncated"),
        ("3\n0 0 0\n1 0 0\nnan 0 0\n", "1\nTr 0 1 2 1\n", "not finite"),
        ("3\n0 0 0\n1 0 0\n0 1 0\n", "1\nTr 0 1 3 1\n", "names point 3"),
        ("3\n0 0 0\n1 0 0\n0 1 0\n", "2\nTr 0 1 2 1\nLn 0 1 1\n", "expected only"),
    ],
)
def test_damage_is_named(tmp_path: Path, pts: str, elem: str, words: str) -> None:
    (tmp_path / "m.pts").write_text(pts)
    (tmp_path / "m.elem").write_text(elem)
    with pytest.raises(InputError, match=words):
        carp.read(tmp_path / "m")
