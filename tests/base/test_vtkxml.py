"""What a VTK file declares is held against its bytes before memory is taken by its word."""

from __future__ import annotations

import base64
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lacli.base.errors import AnatomyError, InputError
from lacli.base.vtkxml import UnfitError, check, read
from lacli.contracts.bundle import load, save
from lacli.synthetic.atrium import synthesize

Change = Callable[[bytes], bytes]


def _written(file: Path, mode: int, compressor: int, encode: int, wide: int) -> Path:
    import vtkmodules.vtkIOXML as writers

    ball = pv.Sphere(theta_resolution=8, phi_resolution=8)
    ball.cell_data["region"] = np.ones(ball.n_cells, np.int32)
    writer = writers.vtkXMLPolyDataWriter()
    writer.SetFileName(str(file))
    writer.SetInputData(ball)
    writer.SetDataMode(mode)
    writer.SetCompressorType(compressor)
    writer.SetEncodeAppendedData(encode)
    writer.SetHeaderType(wide)
    writer.Write()
    return file


@pytest.mark.parametrize("wide", [32, 64])
@pytest.mark.parametrize("encode", [0, 1])
@pytest.mark.parametrize("compressor", [0, 1, 2, 3])
@pytest.mark.parametrize("mode", [0, 1, 2])
def test_every_way_vtk_writes_is_taken(mode: int, compressor: int, encode: int, wide: int, tmp_path: Path) -> None:
    file = _written(tmp_path / "a.vtp", mode, compressor, encode, wide)
    check(file)
    assert read(file).n_points == 50


def _bomb(content: bytes) -> bytes:
    """Points that unpack to 256 MB where the block declares what the true ones hold."""
    packed = zlib.compress(bytes(1 << 28), 9)
    found = re.search(rb'Name="Points"[^>]*>\s*([\w+/=]+)\s*<', content)
    assert found
    header = bytearray(base64.b64decode(found[1][:24])[:16])
    header[12:16] = struct.pack("<I", len(packed))
    return content.replace(found[1], base64.b64encode(bytes(header)) + base64.b64encode(packed))


def _block(content: bytes, word: int, value: int) -> bytes:
    """The first packed array says ``value`` in a word of its header: 0 how many blocks it has, 1 how large they are."""
    found = re.search(rb'format="binary"[^>]*>\s*([\w+/]{16})', content)
    assert found
    header = bytearray(base64.b64decode(found[1]))
    header[4 * word : 4 * word + 4] = struct.pack("<I", value)
    return content[: found.start(1)] + base64.b64encode(bytes(header)) + content[found.end(1) :]


BOMBS: dict[str, Change] = {
    "huge points": lambda b: re.sub(rb'NumberOfPoints="\d+"', b'NumberOfPoints="99999999999"', b),
    "huge cells": lambda b: re.sub(rb'NumberOf(Cells|Polys)="\d+"', rb'NumberOf\1="99999999999"', b),
    "a count of words": lambda b: re.sub(rb'NumberOfPoints="\d+"', b'NumberOfPoints="-1"', b),
    "huge components": lambda b: b.replace(b'NumberOfComponents="3"', b'NumberOfComponents="300000000"'),
    "a packed bomb": _bomb,
    "a huge block": lambda b: _block(b, 1, (1 << 31) - 1),
    "many blocks": lambda b: _block(b, 0, (1 << 24) - 1),
    "cut short": lambda b: b[: len(b) // 2],
    "nested": lambda b: b.replace(b"<Points>", b"<Points>" + b"<a>" * 50),
    "entities": lambda b: b.replace(b"<VTKFile", b'<!DOCTYPE a [<!ENTITY b "b">]><VTKFile', 1),
    "empty": lambda b: b"",
    "no VTK": lambda b: b"\x89PNG\r\n\x1a\n" + bytes(100),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundle")
    save(synthesize(1, cell_size_mm=9.0, order=1)[0], folder)
    return folder


@pytest.mark.parametrize("name", ["wall.vtu", "boundary.vtp"])
@pytest.mark.parametrize("how", BOMBS)
def test_a_bombs_word_is_not_believed(how: str, name: str, good: Path, tmp_path: Path) -> None:
    for file in good.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    content = (good / name).read_bytes()
    damaged = BOMBS[how](content)
    assert damaged != content
    (tmp_path / name).write_bytes(damaged)
    with pytest.raises(UnfitError):
        check(tmp_path / name)
    with pytest.raises(AnatomyError, match=name):
        load(tmp_path)
    with pytest.raises(InputError, match="Write it again"):
        read(tmp_path / name)


def test_appended_values_beyond_the_end_are_missed(tmp_path: Path) -> None:
    file = _written(tmp_path / "a.vtp", 2, 1, 0, 32)
    content = file.read_bytes()
    file.write_bytes(content[: content.index(b"<AppendedData") + 60])
    with pytest.raises(UnfitError):
        check(file)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_whatever_is_damaged_has_one_message_or_none(data: st.DataObject, good: Path, tmp_path: Path) -> None:
    """No other exception leaves the look at a file, wherever a few bytes of it are changed or cut out."""
    content = bytearray((good / data.draw(st.sampled_from(["wall.vtu", "boundary.vtp"]))).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, min(len(content) - 1, 3000)))
        content[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=4))
    (tmp_path / "x.vtu").write_bytes(bytes(content))
    try:
        check(tmp_path / "x.vtu")
    except UnfitError as error:
        assert str(error)
