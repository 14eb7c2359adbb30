"""Files of arrays: whatever differs from the schema is one message; nothing is read that is not as it should be."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.base.errors import InputError
from lacli.base.schema import SEAL, Array, array_file, write_arrays

SCHEMA = {
    "t": Array(shape=("f",), rising=True),
    "index": Array("int", ("n",), least=0, distinct=True),
    "x": Array(shape=("f", "n", 3)),
    "flag": Array("bool", (2,)),
    "names": Array("text", ("n",), distinct=True),
    "share": Array(least=0.0, most=1.0, open_=True),
}


def good() -> dict[str, np.ndarray]:
    return {
        "t": np.array([0.0, 0.25, 0.5]), "index": np.array([4, 2]), "x": np.arange(18.0).reshape(3, 2, 3),
        "flag": np.array([True, False]), "names": np.array(["a", "b"]), "share": np.array(0.5),
    }  # fmt: skip


def read(path: Path) -> dict[str, np.ndarray]:
    with array_file(path, "a thing", "Make it again.") as file:
        return file.read(SCHEMA)


def write(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    with path.open("wb") as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return path


def test_a_good_file_comes_back(tmp_path: Path) -> None:
    back = read(write(tmp_path / "a.npz", good()))
    assert all(np.array_equal(back[k], v) for k, v in good().items())


NUMBERS = ("t", "x", "share")
SPOILS = {
    "missing": lambda a, k: None,
    "transposed or longer": lambda a, k: np.stack([a, a]),
    "nan": lambda a, k: np.where(np.ones_like(a, bool), np.nan, 0) if k in NUMBERS else np.zeros(a.shape, complex),
    "inf": lambda a, k: np.full(a.shape, np.inf) if k in NUMBERS else a.astype("S4"),
    "int8": lambda a, k: a.astype(np.int8) if k in NUMBERS else np.zeros(a.shape, "datetime64[s]"),
    "half precision": lambda a, k: a.astype(np.float16) if k in NUMBERS else np.zeros(a.shape, "c16"),
    "record": lambda a, k: np.zeros(a.shape, [("p", float)]),
    "flat": lambda a, k: a.reshape(-1)[:0],
}


@pytest.mark.parametrize("name", sorted(SCHEMA))
@pytest.mark.parametrize("how", sorted(SPOILS))
def test_every_array_spoilt_every_way_is_refused(name: str, how: str, tmp_path: Path) -> None:
    arrays = good()
    spoilt = SPOILS[how](arrays.pop(name), name)
    if spoilt is not None:
        arrays[name] = spoilt
    # a dimension of another length is told where it first disagrees
    told = "" if how == "flat" else name
    with pytest.raises(InputError, match=rf"a\.npz: not a thing, or a damaged one \(.*{told}.*\)\. Make it again\."):
        read(write(tmp_path / "a.npz", arrays))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("t", [0.0, 0.5, 0.5]),
        ("index", [-1, 2]),
        ("index", [3, 3]),
        ("names", ["a", "a"]),
        ("share", 1.0),
        ("names", ["a", "\a"]),
    ],
)
def test_values_out_of_their_rules_are_refused(name: str, value: object, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=name):
        read(write(tmp_path / "a.npz", good() | {name: np.array(value)}))


@settings(max_examples=150)
@given(st.data())
def test_a_file_damaged_anywhere_is_refused_or_unharmed(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = write(tmp_path_factory.mktemp("d") / "a.npz", good())
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content = content[:at]
    else:
        content[at : at + data.draw(st.integers(1, 40))] = data.draw(st.binary(min_size=1, max_size=40))
    path.write_bytes(content)
    try:
        back = read(path)
    except InputError:
        return
    assert all(np.array_equal(back[k], v) for k, v in good().items())


def test_bombs_pickles_and_lies_of_headers_take_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("t.npy", "w", force_zip64=True) as member:
        for _ in range(64):
            member.write(bytes(1 << 20))
    with pytest.raises(InputError, match="GB of memory"), array_file(path, "a thing", "Make it again.", largest=1 << 20):
        pass
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**13,)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("t.npy", header.getvalue() + bytes(24))
    with pytest.raises(InputError, match="its header promises"):
        read(path)
    np.savez(path, t=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="Python objects"):
        read(path)


# --- the seal of what is kept -----------------------------------------------------------------------------------------

EDITS = {
    "reversed": lambda a: a[::-1] if a.ndim else a,
    "its first zero": lambda a: np.where(np.arange(a.size).reshape(a.shape), a, a * 0) if a.dtype.kind in "fi" else a,
    "smaller by one bit": lambda a: np.nextafter(a, -np.inf) if a.dtype.kind == "f" else a,
    "another type": lambda a: a.astype(np.float32) if a.dtype.kind == "f" else a.astype(a.dtype.newbyteorder()),
    "as one line": lambda a: a.reshape(1, *a.shape),
}


@given(name=st.sampled_from(sorted(good())), edit=st.sampled_from(sorted(EDITS)))
@settings(max_examples=80, deadline=None)
def test_an_array_that_was_edited_breaks_the_seal(tmp_path_factory: pytest.TempPathFactory, name: str, edit: str) -> None:
    path = tmp_path_factory.mktemp("s") / "a.npz"
    write_arrays(path, good())
    with np.load(path) as stored:
        arrays = dict(stored)
    before = arrays[name]
    arrays[name] = EDITS[edit](before)
    same = arrays[name].dtype == before.dtype and arrays[name].shape == before.shape and np.array_equal(arrays[name], before)
    write(path, arrays)
    if same:
        assert set(read(path)) == set(good())
        return
    with pytest.raises(InputError, match="Make it again"):
        read(path)


@pytest.mark.parametrize("how", ["an array more", "two exchanged", "no seal", "the seal of another"])
def test_a_kept_file_is_believed_only_as_it_was_written(tmp_path: Path, how: str) -> None:
    path, other = tmp_path / "a.npz", tmp_path / "b.npz"
    write_arrays(path, {"x": np.arange(3.0), "y": np.arange(3.0) + 1})
    write_arrays(other, {"x": np.arange(3.0), "y": np.zeros(3)})
    with np.load(path) as stored, np.load(other) as foreign:
        arrays, seal = dict(stored), foreign[SEAL]
    arrays |= {
        "an array more": {"z": np.zeros(1)}, "two exchanged": {"x": arrays["y"], "y": arrays["x"]}, "no seal": {},
        "the seal of another": {SEAL: seal},
    }[how]  # fmt: skip
    if how == "no seal":
        del arrays[SEAL]
    write(path, arrays)
    with (
        pytest.raises(InputError, match=r"a\.npz: not a thing.*edited.*Make it again"),
        array_file(path, "a thing", "Make it again.", sealed=True) as file,
    ):
        file.read({"x": Array(shape=("n",))})
