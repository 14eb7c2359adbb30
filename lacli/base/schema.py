"""Files of named arrays (.npz), read against a schema: shape, type, finiteness and size, each checked in this one place.

A file is a stranger until it is read: its directory and each array's header are looked at before an array is decompressed,
so that no more memory is taken than the file is allowed; no pickle is loaded.

A file that ``write_arrays`` wrote carries a seal, the digest of its arrays: one that was edited since is told from one that is
as it was written. ``array_file`` looks at it when the block ends well; what computes on arrays inside calls ``check_seal`` first.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from lacli.base.errors import InputError
from lacli.base.files import replacing

Kind = Literal["float", "int", "bool", "text"]

# all arrays of a file together, decompressed: 20,000 steps of 4 x 56 walkers in 14 inputs are 0.5 GB
LARGEST_BYTES = 4 << 30
SEAL = "seal"
_MOST_MEMBERS = 20_000
_LONGEST_TEXT = 1 << 20
_WORDS = {"float": "floating point numbers", "int": "whole numbers", "bool": "yes or no", "text": "text"}
# kinds of numpy's types, and the fewest bytes: half precision would lose what was measured
_TYPES = {"float": ("f", 4), "int": ("iu", 1), "bool": ("b", 1), "text": ("U", 0)}
# what a file raises that is cut short, overwritten in the middle, or no such file at all
_DAMAGED = (
    OSError, EOFError, ValueError, TypeError, KeyError, RuntimeError, MemoryError, NotImplementedError, SyntaxError,
    tokenize.TokenError, struct.error, zipfile.BadZipFile, zlib.error, UnicodeError,
)  # fmt: skip


@dataclass(frozen=True)
class Array:
    """What an array must be.

    shape: numbers, and names of dimensions that agree with every other array of the file read so far. Values are finite
    where ``finite``, and from ``least`` to ``most`` (``open_``: the ends excluded). rising: strictly along the first axis.
    distinct: no value twice. one_of: the only values.
    """

    kind: Kind = "float"
    shape: tuple[str | int, ...] = ()
    finite: bool = True
    least: float = -np.inf
    most: float = np.inf
    open_: bool = False
    rising: bool = False
    distinct: bool = False
    one_of: tuple[float, ...] = ()


Schema = Mapping[str, Array]


class ArrayFile:
    """An open file of arrays; ``dims``: sizes of the named dimensions met so far; ``sealed``: it must carry a seal."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, sealed: bool = False) -> None:
        self.path, self.dims, self._sealed, self._checked = path, dict[str, int](), sealed, False
        self._archive = archive
        self._members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arrays in the file."""
        return tuple(self._members)

    def read(self, schema: Schema, optional: Sequence[str] = ()) -> dict[str, Any]:
        """The arrays of the schema, native and of 64 bits; those of ``optional`` only where the file has them.

        Raises _Unfit with the array at fault, in words.
        """
        found = {}
        for name, wanted in schema.items():
            if name not in self._members:
                if name in optional:
                    continue
                raise _Unfit(f"it has no array {name}")
            found[name] = self._array(name, wanted)
        return found

    def everything(self) -> Iterator[tuple[str, NDArray[Any]]]:
        """Every array of the file by name but its seal, as it is, in the order of the names; none of Python's own objects."""
        for name in sorted(self._members):
            if name != SEAL:
                yield name, np.ascontiguousarray(self._value(name, None))

    def check_seal(self) -> None:
        """Raises _Unfit where the arrays are not those that were sealed, or a file that must carry a seal has none."""
        if self._checked:
            return
        if SEAL in self._members:
            seal = self._value(SEAL, Array("text"))
            if str(seal) != _seal(self.everything()):
                raise _Unfit("its arrays are not those that were written: it was edited")
        elif self._sealed:
            raise _Unfit("it carries no digest of its arrays: it was edited, or written by an earlier version")
        self._checked = True

    def _array(self, name: str, wanted: Array) -> NDArray[Any]:
        value = self._value(name, wanted)
        if wanted.kind == "text":
            _check_text(name, wanted, value)
            return value
        if wanted.kind == "int" and value.size and int(value.max()) > np.iinfo(np.int64).max:
            raise _Unfit(f"{name} holds {value.max()}, which is too large")
        native = {"float": np.float64, "int": np.int64, "bool": np.bool_}[wanted.kind]
        value = np.array(value, dtype=native, order="C")
        _check_values(name, wanted, value)
        return value

    def _value(self, name: str, wanted: Array | None) -> NDArray[Any]:
        """The array as the file has it, its form held against ``wanted`` before its content is read."""
        info = self._members[name]
        with self._archive.open(info) as stream:
            shape, fortran, dtype = _header(stream, name)
            if wanted is not None:
                self._check_form(name, wanted, shape, dtype)
            size = math.prod(shape) * dtype.itemsize
            there = info.file_size - stream.tell()
            if there != size:
                raise _Unfit(f"{name} holds {there} bytes where its header promises {size}")
            content = stream.read(size)
            if len(content) != size or stream.read(1):  # the end of the file is where its checksum is compared
                raise _Unfit(f"{name} ends early")
        return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")

    def _check_form(self, name: str, wanted: Array, shape: tuple[int, ...], dtype: np.dtype) -> None:
        kinds, least = _TYPES[wanted.kind]
        if dtype.kind not in kinds or dtype.itemsize < least or dtype.itemsize > 4 * _LONGEST_TEXT:
            raise _Unfit(f"{name} is of type {dtype}, {_WORDS[wanted.kind]} are expected")
        expected = tuple(self.dims.get(d, d) if isinstance(d, str) else d for d in wanted.shape)
        fits = len(shape) == len(expected) and all(isinstance(e, str) or e == s for e, s in zip(expected, shape, strict=True))
        # a name may stand twice in one shape
        named = dict[str, int]()
        for d, s in zip(wanted.shape, shape, strict=False):
            if isinstance(d, str):
                fits = fits and named.setdefault(d, s) == s
        if not fits:
            raise _Unfit(f"{name} is of shape {_shape(shape)}, {_shape(expected)} is expected")
        self.dims |= named


class _Unfit(ValueError):
    """An array is not what the schema wants."""


@contextlib.contextmanager
def array_file(
    path: Path,
    what: str,
    remedy: str,
    *,
    error: type[InputError] = InputError,
    largest: int = LARGEST_BYTES,
    sealed: bool = False,
) -> Iterator[ArrayFile]:
    """Open a file of arrays; whatever is wrong with it, or with what is read inside the block, becomes one ``error``.

    what: "an emulator file", for the message; remedy: what to do, a sentence. largest: bytes of all arrays, decompressed.
    sealed: the file is ours, kept to be used again: without a seal it is not believed. A seal that is there must be right.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream, zipfile.ZipFile(_seekable(stream)) as archive:
            _check_directory(archive, largest)
            file = ArrayFile(path, archive, sealed)
            yield file
            file.check_seal()
    except InputError:
        raise
    except _Unfit as unfit:
        raise error(f"{path}: not {what}, or a damaged one ({unfit}). {remedy}") from unfit
    except _DAMAGED as damage:
        raise error(f"{path}: not {what}, or a damaged one ({_words(damage)}). {remedy}") from damage


def write_arrays(path: Path, arrays: Mapping[str, Any], *, compressed: bool = True) -> None:
    """Write named arrays with their seal to an .npz file, whole or not at all. Raises StorageError."""
    sealed: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    sealed[SEAL] = np.array(_seal((name, np.ascontiguousarray(sealed[name])) for name in sorted(sealed)))
    with replacing(Path(path)) as temporary, temporary.open("wb") as stream:
        (np.savez_compressed if compressed else np.savez)(stream, **sealed)


def _seal(arrays: Iterable[tuple[str, NDArray[Any]]]) -> str:
    """Digest of arrays by name, in the order given: types, shapes and values."""
    total = hashlib.sha256()
    for name, value in arrays:
        total.update(f"\0{name}\0{value.dtype.str}\0{value.shape}\0".encode())
        total.update(value.tobytes())
    return total.hexdigest()


def unfit(reason: str) -> ValueError:
    """What a reader raises inside ``array_file`` where arrays, each as it should be, do not fit together."""
    return _Unfit(reason)


def _seekable(stream: BinaryIO) -> BinaryIO:
    if not stream.seekable():
        raise _Unfit("it is no file that can be read twice")
    return stream


def _check_directory(archive: zipfile.ZipFile, largest: int) -> None:
    infos = archive.infolist()
    if len(infos) > _MOST_MEMBERS:
        raise _Unfit(f"it holds {len(infos):,} arrays; at most {_MOST_MEMBERS:,} are read")
    if len({info.filename for info in infos}) < len(infos):
        raise _Unfit("it holds two arrays of one name")
    if other := [info.filename for info in infos if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)]:
        raise _Unfit(f"{other[0]} is packed in a way that no program of arrays writes")
    size = sum(info.file_size for info in infos)
    if size > largest:
        raise _Unfit(f"it would take {size / 1e9:.3g} GB of memory; at most {largest / 1e9:.3g} GB are read")


def _header(stream: Any, name: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise _Unfit(f"{name} is of format {version[0]}.{version[1]}, which is not read")
    shape, fortran, dtype = readers[version](stream)
    if dtype.hasobject or dtype.names is not None or dtype.subdtype is not None:
        raise _Unfit(f"{name} holds Python objects or records")
    return shape, fortran, dtype


def _check_text(name: str, wanted: Array, value: NDArray[Any]) -> None:
    for text in value.ravel().tolist():
        if not text or not text.replace("\n", " ").isprintable():
            raise _Unfit(f"{name} holds {text!r}, which is no name")
    if wanted.distinct and len(set(value.ravel().tolist())) < value.size:
        raise _Unfit(f"{name} holds one name twice")


def _check_values(name: str, wanted: Array, value: NDArray[Any]) -> None:
    if wanted.finite and (bad := ~np.isfinite(value)).any():
        raise _Unfit(f"{name}{_place(bad)} is {value[bad].flat[0]}, which is no finite number")
    if wanted.kind == "bool":
        return
    with np.errstate(invalid="ignore"):  # not a number, where that is allowed, is in every range
        out = (value <= wanted.least) | (value >= wanted.most) if wanted.open_ else (value < wanted.least) | (value > wanted.most)
    if out.any():
        ends = f"{wanted.least:g} to {wanted.most:g}" + (", both excluded" if wanted.open_ else "")
        raise _Unfit(f"{name}{_place(out)} is {value[out].flat[0]:g}, out of the range {ends}")
    if wanted.one_of and not np.isin(value, wanted.one_of).all():
        raise _Unfit(f"{name} holds other values than {', '.join(f'{v:g}' for v in wanted.one_of)}")
    if wanted.rising and np.any(np.diff(value, axis=0) <= 0):
        raise _Unfit(f"{name} does not rise from value to value")
    if wanted.distinct and len(np.unique(value)) < value.size:
        raise _Unfit(f"{name} holds one value twice")


def _place(mask: NDArray[np.bool_]) -> str:
    if mask.ndim == 0:
        return ""
    return "[" + ", ".join(str(i) for i in np.argwhere(mask)[0]) + "]"


def _shape(shape: Sequence[int | str]) -> str:
    return "(" + ", ".join(str(s) for s in shape) + ")"


def _words(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:200]}" if text else type(error).__name__
