"""Runs on disk: content keys, one writer per key, a temporary name until finished, manifests; and atomic files.

A run is the folder ``<root>/<key>``. It is written as ``<root>/.tmp-<key>-<pid>`` under a lock that dies with its
process, and renamed when it has ended, well or badly. It is complete when its manifest says ``done`` and every product
the manifest lists is there in its full size. A failed run stays, with its kind, and counts.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import functools
import hashlib
import json
import logging
import os
import platform
import shutil
import struct
import tempfile
import time
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

import numpy as np

from lacli import __version__
from lacli.errors import AnatomyError, StorageError
from lacli.resources import folder as resource_folder
from lacli.scene import Scene, content_hash, dump_scene

_logger = logging.getLogger(__name__)
# what numpy raises on an .npz file that is cut short, overwritten in the middle, or no such file at all
DAMAGED = (
    OSError, EOFError, KeyError, IndexError, ValueError, TypeError, RuntimeError, MemoryError,
    struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
_FULL = (errno.ENOSPC, errno.EDQUOT)
_IN_THE_WAY = "{}: a folder of that name is in the way. Choose another name."
# failures of the machine, not of the scene: asked again, they run again
TRANSIENT_KINDS = frozenset({"killed", "disk_full", "out_of_memory"})


# --- atomic files -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in ``path``'s folder; when the block ends well it becomes ``path``, else it is removed.

    The folder is made if absent. Raises StorageError if the disk is full or the place is not writable.
    """
    with _storage(path):
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


def check_folder(folder: Path) -> None:
    """Before the work: whether the folder is one, or can be made. Raises StorageError; leaves nothing."""
    there = next(p for p in (folder, *folder.absolute().parents) if p.exists() or p.is_symlink())
    if not there.is_dir():
        what = "a file" if there.exists() else "a link that leads nowhere"
        raise StorageError(f"{folder}: cannot be written, {there} is {what}; choose another --out.")
    try:  # permissions do not tell of file systems that are read-only, or none
        with tempfile.TemporaryDirectory(prefix=".part-", dir=there):
            pass
    except OSError as error:
        raise StorageError(
            f"{folder}: cannot be written, nothing can be made in {there} ({error.strerror}); choose another --out."
        ) from None


def check_file(path: Path) -> None:
    """Before the work: whether a file can be put there, its folder made if absent. Raises StorageError; leaves nothing."""
    if path.is_dir():
        raise StorageError(_IN_THE_WAY.format(path))
    check_folder(path.parent)


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
def _storage(path: Path) -> Iterator[None]:
    """Errors of writing ``path`` become StorageError."""
    try:
        with _room(path):
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
def _room(path: Path) -> Iterator[None]:
    """A full disk becomes StorageError."""
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL:
            raise
        text = f"{error.filename or path}: the disk is full. Free some space and run again; what was finished is kept."
        raise StorageError(text) from error


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


# --- keys -------------------------------------------------------------------------------------------------------------


def run_key(scene: Scene) -> str:
    """Key of a run's content: scene, the bundle's files (not their path), deck and libraries, version of lacli.

    Raises AnatomyError if the bundle is not there.
    """
    return content_hash(
        {
            "scene": scene.content(),
            "bundle": bundle_digest(scene.anatomy.bundle),
            "solver": solver_digest(),
            "version": __version__,
        }
    )


def bundle_digest(folder: Path) -> str:
    """Digest of a bundle's ``wall.vtu``, ``boundary.vtp`` and the arrays of ``motion.npz`` (where there is one)."""
    states = []
    for name in ("wall.vtu", "boundary.vtp", "motion.npz"):
        file = folder / name
        if file.is_file():
            state = file.stat()
            states.append((file, state.st_size, state.st_mtime_ns))
        elif name != "motion.npz":
            raise AnatomyError(
                f"{folder}: not an anatomy bundle, {name} is missing. `lacli synthesize` or `lacli mesh` writes one."
            )
    return _digest(tuple(states))


@functools.lru_cache(maxsize=32)
def _digest(states: tuple[tuple[Path, int, int], ...]) -> str:
    total = hashlib.sha256()
    for file, _, _ in states:
        total.update(f"\0{file.name}\0".encode())
        if file.suffix == ".npz":
            _update_arrays(total, file)
        else:
            total.update(file.read_bytes())
    return total.hexdigest()


def _update_arrays(total: Any, file: Path) -> None:
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            for name in sorted(arrays.files):
                value = np.ascontiguousarray(arrays[name])
                total.update(f"\0{name}\0{value.dtype.str}\0{value.shape}\0".encode())
                total.update(value.tobytes())
    except DAMAGED as error:
        raise AnatomyError(f"{file}: cannot be read ({error}). Write the bundle again.") from error


@functools.lru_cache(maxsize=1)
def solver_digest() -> str:
    """Digest of every file of ``templates/`` and ``solvers/`` but the emulators' kernel, which takes no part in a run."""
    total = hashlib.sha256()
    for name in ("templates", "solvers"):
        root = resource_folder(name)
        for file in sorted(
            path for path in root.rglob("*") if path.is_file() and path.suffix in (".j2", ".edp", ".idp", ".cpp", ".hpp")
        ):
            if file.is_relative_to(root / "emulator"):
                continue
            total.update(f"\0{name}/{file.relative_to(root)}\0".encode())
            total.update(file.read_bytes())
    return total.hexdigest()


# --- runs -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoredRun:
    """A run that has ended: its key, folder and manifest."""

    key: str
    folder: Path
    manifest: dict[str, Any]

    @property
    def status(self) -> str:
        return str(self.manifest["status"])

    @property
    def kind(self) -> str | None:
        return self.manifest.get("kind")

    @property
    def message(self) -> str:
        return str(self.manifest.get("message") or "")

    def features(self) -> dict[str, float]:
        """Content of ``features.json``; empty where there is none."""
        file = self.folder / "features.json"
        return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


@dataclass
class OpenRun:
    """A run being written into ``folder``; ``stored`` is set if it had ended before (then there is nothing to do)."""

    key: str
    root: Path
    folder: Path
    stored: StoredRun | None = None
    started: float = field(default_factory=time.time)

    def finish(
        self,
        status: str = "done",
        *,
        products: list[str] | None = None,
        kind: str | None = None,
        message: str = "",
        **fields: Any,
    ) -> StoredRun:
        """Write the manifest and move the folder to its name.

        status: ``done`` or ``failed`` (then with ``kind``). products: the files that make the run complete, relative to
        the folder; by default all that are there. fields: more of the manifest (cpu_s, peak_memory_mb, seeds, versions).
        Raises StorageError; the folder is then removed when the block of ``open_run`` ends.
        """
        if status not in ("done", "failed") or (status == "failed") == (kind is None):
            raise ValueError("a run is done, or failed with a kind")
        names = products if products is not None else _files(self.folder)
        missing = [name for name in names if not (self.folder / name).is_file()]
        if missing and status == "done":
            raise StorageError(f"{self.folder}: {missing[0]} was not written; the run is not complete.")
        versions = {"lacli": __version__, "python": platform.python_version(), "numpy": np.__version__}
        manifest = {
            "key": self.key,
            "status": status,
            "kind": kind,
            "message": message,
            "started": _iso(self.started),
            "finished": _iso(time.time()),
            "wall_s": round(time.time() - self.started, 3),
            "machine": {"system": platform.platform(), "processors": os.cpu_count()},
            "products": {name: (self.folder / name).stat().st_size for name in names if name not in missing},
            **fields,
            "versions": {**versions, **fields.get("versions", {})},
        }
        write_json(self.folder / "manifest.json", manifest)
        final = self.root / self.key
        with _storage(final):
            _make_way(final)
            self.folder.rename(final)
        self.folder = final
        self.stored = StoredRun(self.key, final, json.loads((final / "manifest.json").read_text(encoding="utf-8")))
        return self.stored


@contextlib.contextmanager
def open_run(root: Path, scene: Scene, *, retry_failed: bool = False) -> Iterator[OpenRun]:
    """Lock the scene's key below ``root`` and give a folder to write into, ``scene.toml`` already in it.

    If the run has ended before, ``stored`` is set and nothing is to be done. Failed runs count as ended, but for those
    of TRANSIENT_KINDS, or all of them with ``retry_failed``. A second process waits here until the first has finished.
    A block that ends without ``finish`` (an error, Ctrl-C) leaves nothing; a full disk becomes StorageError.
    """
    key = run_key(scene)
    with _storage(root):
        (root / ".locks").mkdir(parents=True, exist_ok=True)
    with _room(root / key), _lock(root, key):
        _sweep(root, key)
        stored = find_run(root, key)
        if stored is not None and (stored.status == "done" or not (retry_failed or stored.kind in TRANSIENT_KINDS)):
            yield OpenRun(key, root, stored.folder, stored)
            return
        run = OpenRun(key, root, root / f".tmp-{key}-{os.getpid()}")
        with _storage(run.folder):
            run.folder.mkdir()
        try:
            write_text(run.folder / "scene.toml", dump_scene(scene))
            yield run
        finally:
            if run.stored is None:
                shutil.rmtree(run.folder, ignore_errors=True)


def find_run(root: Path, key: str) -> StoredRun | None:
    """The run of that key if it has ended (done and complete, or failed), else None."""
    folder = root / key
    try:
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
        if manifest["key"] != key or manifest["status"] not in ("done", "failed"):
            return None
        if manifest["status"] == "done":
            for name, size in manifest["products"].items():
                if (folder / name).stat().st_size != size:
                    return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return StoredRun(key, folder, manifest)


def list_runs(root: Path) -> list[StoredRun]:
    """All runs below ``root`` that have ended, by key."""
    if not root.is_dir():
        return []
    names = sorted(path.name for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
    return [run for name in names if (run := find_run(root, name)) is not None]


def _files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def _iso(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def _make_way(final: Path) -> None:
    """A failed or damaged run gives its name to the new one."""
    if final.exists():
        old = final.parent / f".tmp-{final.name}-old-{os.getpid()}"
        final.rename(old)
        shutil.rmtree(old, ignore_errors=True)


@contextlib.contextmanager
def _lock(root: Path, key: str, wait: bool = True) -> Iterator[bool]:
    """An exclusive lock on a key that the system releases if the process dies. Yields whether it was got."""
    path = root / ".locks" / key
    stream = _locked(path, wait)
    if stream is None:
        yield False
        return
    try:
        yield True
    finally:
        path.unlink(missing_ok=True)
        stream.close()


def _locked(path: Path, wait: bool) -> IO[bytes] | None:
    while True:
        stream = path.open("ab")
        try:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if not wait:
                    raise
                _logger.warning("Another process does run %s at this moment; waiting for it.", path.name)
                fcntl.flock(stream, fcntl.LOCK_EX)
            # the one before us removed the file when it left: then ours is not the file others see
            if path.exists() and os.fstat(stream.fileno()).st_ino == path.stat().st_ino:
                return stream
        except BlockingIOError:
            stream.close()
            return None
        except FileNotFoundError:
            pass
        except BaseException:
            stream.close()
            raise
        stream.close()


def _sweep(root: Path, held: str) -> None:
    """Remove temporaries nobody writes any more: whoever holds a key's lock is the only writer of that key."""
    for folder in root.glob(".tmp-*"):
        key = folder.name.split("-")[1]
        if key == held:
            shutil.rmtree(folder, ignore_errors=True)
            continue
        with _lock(root, key, wait=False) as got:
            if got:
                shutil.rmtree(folder, ignore_errors=True)
