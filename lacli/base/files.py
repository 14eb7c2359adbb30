"""Files written whole or not at all, and what goes wrong with a disk, in words."""

from __future__ import annotations

import contextlib
import errno
import functools
import json
import os
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lacli.base.errors import StorageError
from lacli.base.processes.machine import FULL, full_words

# what numpy raises on an .npz file that is cut short, overwritten in the middle, or no such file at all
DAMAGED = (
    OSError, EOFError, KeyError, IndexError, ValueError, TypeError, RuntimeError, MemoryError,
    struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
_IN_THE_WAY = "{}: a folder of that name is in the way. Choose another name."


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in ``path``'s folder; when the block ends well it becomes ``path``, else it is removed.

    The folder is made if absent. Raises StorageError if the disk is full or the place is not writable.
    """
    with storing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        # the suffix stays, because writers choose the format by it
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            temporary.chmod(0o666 & ~_umask())
            yield temporary
            _sync(temporary)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def check_folder(folder: Path, option: str = "--out") -> None:
    """Before the work: whether the folder is one, or can be made. Raises StorageError, which names ``option``; leaves nothing."""
    there = next(p for p in (folder, *folder.absolute().parents) if p.exists() or p.is_symlink())
    if not there.is_dir():
        what = "a file" if there.exists() else "a link that leads nowhere"
        raise StorageError(f"{folder}: cannot be written, {there} is {what}; choose another {option}.")
    try:  # permissions do not tell of file systems that are read-only, or none
        with tempfile.TemporaryDirectory(prefix=".part-", dir=there):
            pass
    except OSError as error:
        raise StorageError(
            f"{folder}: cannot be written, nothing can be made in {there} ({error.strerror}); choose another {option}."
        ) from None


def check_file(path: Path, *inputs: Path | None, begins: bytes = b"") -> None:
    """Before the work: whether a file can be put there, its folder made if absent. Raises StorageError; leaves nothing.

    inputs: files that are read, one of which it must not be; begins: with what a file begins that may be written over.
    """
    if path.is_dir():
        raise StorageError(_IN_THE_WAY.format(path))
    if path.exists() and any(other is not None and other.exists() and path.samefile(other) for other in inputs):
        raise StorageError(f"{path}: is an input, and would be written over; choose another --out.")
    if begins and path.is_file():
        with storing(path), path.open("rb") as stream:
            start = stream.read(len(begins))
        if start != begins:
            raise StorageError(f"{path}: is there and is another kind of file; choose another --out, or remove it.")
    check_folder(path.parent)


def superseded(folder: Path, *names: str) -> None:
    """Remove what an earlier call left in the folder and this one does not write: it would show another result."""
    for name in names:
        (folder / name).unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically (UTF-8). Raises StorageError."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, document: Any) -> None:
    """Write JSON atomically; a number that is not finite is refused with ValueError. Raises StorageError."""
    write_text(path, json.dumps(document, indent=2, allow_nan=False, default=_jsonable) + "\n")


def _jsonable(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no place in JSON")


@contextlib.contextmanager
def storing(path: Path) -> Iterator[None]:
    """Errors of writing ``path`` become StorageError."""
    try:
        with room(path):
            yield
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
            raise StorageError(f"{path}: no permission to write here. Choose another folder.") from error
        if error.errno in (errno.ENOTDIR, errno.EEXIST):
            raise StorageError(f"{path}: a file is in the way ({error.filename}). Choose another folder.") from error
        if error.errno == errno.EISDIR:
            raise StorageError(_IN_THE_WAY.format(path)) from error
        raise


@contextlib.contextmanager
def room(path: Path) -> Iterator[None]:
    """A full disk, or a file larger than allowed, becomes StorageError."""
    try:
        yield
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise StorageError(full_words(error.filename or path, error.errno)) from error


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@functools.lru_cache(maxsize=1)
def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
