"""Runs on disk: one writer per key, a temporary name until finished, manifests.

A run is the folder ``<root>/<key>``. It is written as ``<root>/.tmp-<key>-<pid>`` under a lock that dies with its
process, and renamed when it has ended, well or badly. It is complete when its manifest says ``done`` and every product
the manifest lists is there as it was written: of small files (features, transients, scene, deck) the content is compared
whenever the run is found, of fields the size, and their content when they are used (``check_products``). A failed run stays,
with its kind, and counts; one that the machine ended (``lacli.contracts.failures``) leaves nothing and runs again.
"""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import shutil
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.documents import read_json
from lacli.base.errors import InputError, StorageError
from lacli.base.files import room, storing, write_json
from lacli.base.processes.locks import MARKER, lock
from lacli.base.version import __version__
from lacli.contracts.failures import of_the_machine
from lacli.contracts.identity import content_hash, file_digest

_logger = logging.getLogger(__name__)
_SEAL = "digest"  # of the manifest's own content
_ALWAYS_READ = 1 << 18  # bytes; a smaller product's content is compared whenever its run is found (0.2 ms)


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
        return read_json(file) if file.is_file() else {}


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
        A run that the machine ended is told, but nothing of it is kept: ``stored.folder`` is where it would have been.
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
            "sha256": {name: file_digest(self.folder / name) for name in names if name not in missing},
            **fields,
            "versions": {**versions, **fields.get("versions", {})},
        }
        final = self.root / self.key
        if of_the_machine(kind):
            shutil.rmtree(self.folder, ignore_errors=True)
            self.stored = StoredRun(self.key, final, manifest)
            return self.stored
        manifest = read_json(_written(self.folder / "manifest.json", manifest))
        write_json(self.folder / "manifest.json", {**manifest, _SEAL: content_hash(manifest)})
        with storing(final):
            _make_way(final)
            self.folder.rename(final)
        self.folder = final
        self.stored = StoredRun(self.key, final, manifest)
        return self.stored


@contextlib.contextmanager
def open_run(root: Path, key: str, *, retry_failed: bool = False, solver: str | None = None) -> Iterator[OpenRun]:
    """Lock the key (``lacli.contracts.identity.run_key``) below ``root`` and give an empty folder to write into.

    If the run has ended before, ``stored`` is set and nothing is to be done. Failed runs count as ended, or none of them
    with ``retry_failed``. solver: FreeFEM's version; a run of another is made again, with a word (None: whichever made it).
    A second process waits here until the first has finished.
    A block that ends without ``finish`` (an error, Ctrl-C) leaves nothing; a full disk becomes StorageError.
    """
    with storing(root):
        (root / ".locks").mkdir(parents=True, exist_ok=True)
    with room(root / key), lock(root / ".locks" / key, "which does the same simulation"):
        _sweep(root, key)
        stored, trouble = _examine(root, key)
        if stored is not None and (other := _of_another(stored, solver)):
            stored, trouble = None, other
        if trouble:
            _logger.warning("%s: %s; the run is made again.", root / key, trouble)
        if stored is not None and (stored.status == "done" or not retry_failed):
            yield OpenRun(key, root, stored.folder, stored)
            return
        run = OpenRun(key, root, root / f".tmp-{key}-{os.getpid()}")
        with storing(run.folder):
            run.folder.mkdir()
        try:
            yield run
        finally:
            if run.stored is None:
                shutil.rmtree(run.folder, ignore_errors=True)


def find_run(root: Path, key: str) -> StoredRun | None:
    """The run of that key if it has ended (done and complete, or failed), else None."""
    return _examine(root, key)[0]


def check_products(run: StoredRun, names: Iterable[str]) -> None:
    """Before products are used: whether they are as the run wrote them. Raises StorageError that names the one that is not."""
    for name in names:
        if trouble := _trouble(run.folder, run.manifest, name, whole=True):
            raise StorageError(f"{run.folder}: {trouble}. Remove this folder and run the scene again.")


def _examine(root: Path, key: str) -> tuple[StoredRun | None, str]:
    """The run of that key if it has ended; else None, and what is wrong with what is there ('' where nothing is)."""
    folder = root / key
    try:
        manifest = read_json(folder / "manifest.json") if folder.is_dir() else None
        if manifest is None:
            return None, ""
        seal = manifest.pop(_SEAL, None)  # runs of earlier versions have none
        if seal is not None and seal != content_hash(manifest):
            return None, "manifest.json was changed since it was written"
        if manifest["key"] != key or manifest["status"] not in ("done", "failed") or of_the_machine(manifest["kind"]):
            return None, "it was ended by the machine" if of_the_machine(manifest["kind"]) else "manifest.json is not this run's"
        if manifest["status"] == "done":
            for name, size in manifest["products"].items():
                if trouble := _trouble(folder, manifest, name, whole=size <= _ALWAYS_READ):
                    return None, trouble
        return StoredRun(key, folder, manifest), ""
    except InputError as error:
        return None, str(error).removeprefix(f"{folder}/").rstrip(".")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        return None, f"manifest.json cannot be read ({error})"


def _of_another(run: StoredRun, solver: str | None) -> str:
    """Which other FreeFEM made the run, in words; '' where this one did, or it is not known."""
    versions = run.manifest.get("versions")
    made = versions.get("freefem") if isinstance(versions, dict) else None
    return f"it was made with FreeFEM {made}, this is {solver}" if solver and made and made != solver else ""


def _written(file: Path, manifest: dict[str, Any]) -> Path:
    write_json(file, manifest)
    return file


def _trouble(folder: Path, manifest: dict[str, Any], name: str, whole: bool) -> str:
    """What is wrong with a product, '' if nothing. whole: compare its content, not just its size."""
    file = folder / name
    if not file.is_file():
        return f"{name} is missing"
    if file.stat().st_size != manifest["products"][name]:
        return f"{name} has another size than it was written in"
    # runs of earlier versions know sizes alone
    known = manifest.get("sha256", {}).get(name)
    if whole and known is not None and file_digest(file) != known:
        return f"{name} was changed since it was written"
    return ""


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


def _sweep(root: Path, held: str) -> None:
    """Remove what killed processes left: whoever holds a key's lock is the only writer of that key."""
    left = {path.name.split("-")[1] for path in root.glob(".tmp-*")}
    left |= {path.name.removesuffix(MARKER) for path in (root / ".locks").iterdir()}
    for key in left - {held}:
        with lock(root / ".locks" / key, "", wait=False) as got:
            if got:
                _remove_temporaries(root, key)
    _remove_temporaries(root, held)


def _remove_temporaries(root: Path, key: str) -> None:
    for folder in root.glob(f".tmp-{key}-*"):
        shutil.rmtree(folder, ignore_errors=True)
