"""Small C++ libraries of ours, compiled at first use and kept; whoever asks has a slower way without."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

_FLAGS = ("-shared", "-fPIC", "-O3", "-std=c++17", "-fno-math-errno", "-march=native")
_LIBRARIES = ("-lmvec", "-lm")
_TIMEOUT_S = 120.0
_logger = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Where compiled libraries are kept: $XDG_CACHE_HOME/lacli or ~/.cache/lacli."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "lacli"


def processor() -> str:
    """What code for ``-march=native`` depends on: a home may be shared by machines of several kinds."""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        return next((line for line in text.splitlines() if line.startswith(("flags", "Features"))), "")
    return ""


@functools.cache
def library(source: Path) -> ctypes.CDLL | None:
    """The library of one C++ file, compiled once per source, compiler and processor; None, logged, where it cannot be had.

    LACLI_COMPILED=0 does without. Built in a temporary folder, loaded, and moved into place, so several processes may ask
    at once.
    """
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None or os.environ.get("LACLI_COMPILED") == "0":
        _logger.info("%s is not compiled: no compiler, or LACLI_COMPILED=0", source.name)
        return None
    try:
        version = subprocess.run(
            [compiler, "-dumpfullversion"], capture_output=True, text=True, check=False, timeout=_TIMEOUT_S
        ).stdout.strip()
        parts = (source.read_text(encoding="utf-8"), compiler, version, processor(), *_FLAGS, *_LIBRARIES)
        key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
        target = cache_folder() / key / f"{source.stem}.so"
        if not target.is_file():
            _build(compiler, source, target)
        return ctypes.CDLL(str(target))
    except (OSError, subprocess.SubprocessError) as error:
        _logger.info("%s is not compiled: %s", source.name, getattr(error, "stderr", None) or error)
        return None


def _build(compiler: str, source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".build-", dir=target.parent) as folder:
        built = Path(folder) / target.name
        command = [compiler, *_FLAGS, str(source.resolve()), "-o", str(built), *_LIBRARIES]
        subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True, timeout=_TIMEOUT_S)
        ctypes.CDLL(str(built))
        built.replace(target)
