"""What makes two things the same: digests of everything that determines a result."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lacli import __version__
from lacli.base.errors import AnatomyError
from lacli.base.files import DAMAGED
from lacli.base.resources import folder as resource_folder
from lacli.contracts.scene import Scene


def content_hash(parts: Mapping[str, Any]) -> str:
    """A short, stable key of plain JSON-able content."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


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
