"""VTK's XML files (.vtu, .vtp), looked at before a reader sees them: what they declare must be there, and be no bomb.

VTK and meshio take memory by a file's word: the counts of points and cells, the sizes of blocks, whatever a packed block
swells to. ``check(path)`` holds each of them against the file's own bytes, without keeping what it unpacks. It does not say that
a file is right, only that reading it takes no more memory than its content.
"""

from __future__ import annotations

import base64
import binascii
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from lacli.base.errors import InputError, LacliError
from lacli.base.quiet import quiet, reason

MOST_BYTES = 1 << 30  # packed, and unpacked: some 5 million 10-node cells
_MOST_ARRAYS, _DEEPEST, _MOST_BLOCKS = 2_000, 12, 1 << 20
_MOST_COMPONENTS = 1_000
_SIZES = {b: n for n, names in {1: "8", 2: "16", 4: "32", 8: "64"}.items() for b in (f"Int{names}", f"UInt{names}")}
_SIZES |= {"Float32": 4, "Float64": 8, "String": 1}
_CHUNK = 1 << 20


class UnfitError(ValueError):
    """What is wrong with the file, in words."""


@dataclass
class _Array:
    """An element DataArray: its attributes and, where its values stand inside it, these as text."""

    attributes: dict[str, str]
    text: list[str] = field(default_factory=list)


@dataclass
class _Head:
    """What a file says before its values."""

    attributes: dict[str, str] = field(default_factory=dict)
    counts: list[int] = field(default_factory=list)
    arrays: list[_Array] = field(default_factory=list)


def check(path: Path) -> None:
    """Raises UnfitError where the file is larger than 1 GB, packed or not, or declares what it does not hold; OSError."""
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise UnfitError(f"{size / 1e9:.3g} GB; at most {MOST_BYTES / 1e9:.3g} GB are read")
    content = path.read_bytes()
    head, values, encoding = _parted(content)
    found = _read_head(head)
    largest = total = 0
    for array in found.arrays:
        here = _unpacked(array, found.attributes, values, encoding, MOST_BYTES - total)
        largest, total = max(largest, here), total + here
    if beyond := [n for n in found.counts if n > max(largest, 0)]:
        raise UnfitError(f"it declares {max(beyond):,} points or cells and holds no array as long as that")


def read(path: Path, *, error: type[LacliError] = InputError, remedy: str = "Write it again.") -> Any:
    """The data set of pyvista's in the file. Raises ``error``, one message, whatever is wrong with it."""
    import pyvista as pv

    try:
        check(path)
        with quiet():
            data = pv.read(path)
        if not is_whole(data):
            raise UnfitError("a cell names a point that does not exist")
    except UnfitError as words:
        raise error(f"{path}: cannot be read: {words}. {remedy}") from None
    except Exception as trouble:  # readers raise all sorts of things on damaged files
        raise error(f"{path}: cannot be read ({reason(trouble)}). {remedy}") from trouble
    return data


def is_whole(data: Any) -> bool:
    """Whether every cell of a data set that lists its cells' points names points that there are."""
    import pyvista as pv
    from vtkmodules.util.numpy_support import vtk_to_numpy

    if isinstance(data, pv.PolyData):
        cells = [data.GetVerts(), data.GetLines(), data.GetPolys(), data.GetStrips()]
    elif isinstance(data, pv.UnstructuredGrid):
        cells = [data.GetCells()]
    else:
        return True
    lists = [vtk_to_numpy(c.GetConnectivityArray()) for c in cells if c is not None and c.GetNumberOfCells()]
    return all(len(points) == 0 or (points.min() >= 0 and points.max() < data.n_points) for points in lists)


def _parted(content: bytes) -> tuple[bytes, bytes, str]:
    """The XML before the appended values, these, and how they are written ("" for none)."""
    start = content.find(b"<AppendedData")
    if start < 0:
        return content, b"", ""
    end = content.find(b">", start, start + 400)
    mark = content.find(b"_", end, end + 400)
    said = re.search(rb'encoding="(\w+)"', content[start:end]) if end > 0 else None
    if end < 0 or mark < 0 or said is None or said[1] not in (b"raw", b"base64"):
        raise UnfitError("its appended values do not say how they are written")
    return content[:start] + b"</VTKFile>", content[mark + 1 :], said[1].decode()


def _read_head(text: bytes) -> _Head:
    head, open_ = _Head(), list[str]()

    def start(name: str, attributes: dict[str, str]) -> None:
        if len(open_) >= _DEEPEST or len(head.arrays) > _MOST_ARRAYS:
            raise UnfitError("it is nested deeper, or holds more arrays, than such a file does")
        open_.append(name)
        if name == "VTKFile":
            head.attributes = attributes
        elif name == "DataArray":
            head.arrays.append(_Array(attributes))
        counts = [attributes[key] for key in attributes if key.startswith("NumberOf")]
        for word in counts:
            if not re.fullmatch(r"\s*\d{1,18}\s*", word):
                raise UnfitError(f"a count in it is {word[:40]!r}")
        if name == "Piece":
            head.counts += [int(word) for word in counts]

    def characters(words: str) -> None:
        if open_ and open_[-1] == "DataArray":
            head.arrays[-1].text.append(words)

    def forbidden(*_: object) -> None:
        raise UnfitError("it declares entities or a document type, which such a file does not")

    parser = expat.ParserCreate()
    parser.buffer_text, parser.buffer_size = True, 1 << 20
    parser.StartElementHandler, parser.CharacterDataHandler = start, characters
    parser.EndElementHandler = lambda name: open_.pop() and None
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = forbidden
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise UnfitError(f"it is cut short or no XML ({error})") from None
    if not head.attributes or not head.arrays:
        raise UnfitError("it is no file of VTK's XML format with arrays")
    return head


def _unpacked(array: _Array, file: dict[str, str], values: bytes, encoding: str, most: int) -> int:
    """Bytes of the array once it is read, at most. Raises UnfitError where that is more than ``most``, or not there."""
    told, name = array.attributes, str(array.attributes.get("Name", "an array"))[:60]
    for key in ("NumberOfComponents", "NumberOfTuples"):
        limit = _MOST_COMPONENTS if key == "NumberOfComponents" else most
        if int(told.get(key) or 0) > limit:
            raise UnfitError(f"{name} declares {told[key].strip()} {key[8:].lower()}")
    if told.get("type") not in _SIZES:
        raise UnfitError(f"{name} is of type {str(told.get('type'))[:40]!r}")
    form = told.get("format", "ascii")
    if form == "ascii":
        words = sum(len(text) for text in array.text)
        return max(8 * (words // 2 + 1), words)
    if form not in ("binary", "appended"):
        raise UnfitError(f"{name} is written in a format {form[:40]!r}")
    if form == "appended":
        offset = told.get("offset", "")
        if not re.fullmatch(r"\s*\d{1,15}\s*", offset) or int(offset) >= len(values):
            raise UnfitError(f"{name} lies beyond the end of the file")
        source, raw = memoryview(values)[int(offset) :], encoding == "raw"
    else:
        source, raw = memoryview("".join(array.text).strip().encode("ascii", "replace")), False
    size = _inflated(source, raw, file, name, most)
    components = int(told.get("NumberOfComponents") or 1)
    if int(told.get("NumberOfTuples") or 0) * max(components, 1) > 8 * max(size, 1):
        raise UnfitError(f"{name} declares more values than it holds")
    return size


def _inflated(source: memoryview, raw: bool, file: dict[str, str], name: str, most: int) -> int:
    header = {"UInt32": 4, "UInt64": 8}.get(file.get("header_type", "UInt32"))
    if header is None:
        raise UnfitError(f"its header type is {file['header_type'][:40]!r}")
    order = ">" if file.get("byte_order") == "BigEndian" else "<"
    reader = _Bytes(source, raw, name)

    def numbers(count: int) -> tuple[int, ...]:
        return struct.unpack(f"{order}{count}{'I' if header == 4 else 'Q'}", reader.take(count * header))

    compressor = file.get("compressor", "")
    if not compressor:
        (size,) = numbers(1)
        if size > most:
            raise UnfitError(f"{name} would take {size / 1e9:.3g} GB of memory")
        reader.skip(size)
        return size
    blocks, block, last = numbers(3)
    total = blocks * block
    if blocks > _MOST_BLOCKS or total > most or last > max(block, 1):
        raise UnfitError(f"{name} would take {total / 1e9:.3g} GB of memory in {blocks:,} blocks")
    packed = numbers(blocks)
    reader.settle()
    for number, size in enumerate(packed):
        wanted = last if last and number == blocks - 1 else block
        if compressor == "vtkZLibDataCompressor":
            _check_block(reader.pieces(size), wanted, name)
        else:
            reader.skip(size)
    return total


def _check_block(pieces: Iterator[bytes], wanted: int, name: str) -> None:
    """Raises UnfitError where a packed block holds another number of bytes than it declares."""
    unpacker, found = zlib.decompressobj(), 0
    try:
        for piece in pieces:
            while piece and found <= wanted:
                found += len(unpacker.decompress(piece, _CHUNK))
                piece = unpacker.unconsumed_tail
    except zlib.error as error:
        raise UnfitError(f"{name} is damaged ({error})") from None
    if found != wanted or not unpacker.eof:
        raise UnfitError(
            f"a block of {name} unpacks to {'more' if found > wanted else 'less'} than the {wanted:,} bytes it declares"
        )


class _Bytes:
    """Bytes one after the other, raw or in base64; a header and what follows it are encoded apart."""

    def __init__(self, source: memoryview, raw: bool, name: str) -> None:
        self.source, self.raw, self.name, self.at = source, raw, name, 0
        self.left = b""

    def take(self, count: int) -> bytes:
        """The next bytes of the header."""
        if self.raw:
            found = bytes(self.source[self.at : self.at + count])
            self.at += count
        else:
            self._fill(count)
            found, self.left = self.left[:count], self.left[count:]
        if len(found) < count:
            raise self._short()
        return found

    def settle(self) -> None:
        """The header of packed blocks ends here, and its base64 with it."""
        self.left = b""

    def skip(self, count: int) -> None:
        for _ in self.pieces(count):
            pass

    def pieces(self, count: int) -> Iterator[bytes]:
        """The next bytes, some at a time."""
        while count > 0:
            piece = self.take(min(count, _CHUNK))
            count -= len(piece)
            yield piece

    def _fill(self, count: int) -> None:
        """Decode until ``count`` bytes are at hand; a padded group ends what is encoded together."""
        while len(self.left) < count:
            need = 4 * -(-(count - len(self.left)) // 3)
            text = bytes(self.source[self.at : self.at + need])
            if (end := text.find(b"=")) >= 0:
                text = text[: 4 * (end // 4 + 1)]
            if not text or len(text) % 4:
                return
            self.at += len(text)
            try:
                self.left += base64.b64decode(text, validate=True)
            except binascii.Error:
                raise UnfitError(f"{self.name} is damaged (it is no base64)") from None

    def _short(self) -> UnfitError:
        return UnfitError(f"{self.name} ends early")
