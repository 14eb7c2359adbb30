"""Small C++ libraries of ours, compiled at first use and kept; whoever asks has a slower way without."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from lacli.base.process import mortal

_FLAGS = ("-shared", "-fPIC", "-O3", "-std=c++17", "-fno-math-errno", "-march=native")
_LIBRARIES = ("-lmvec", "-lm")
_TIMEOUT_S = 300.0
_logger = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Where compiled libraries are kept: $XDG_CACHE_HOME/lacli or ~/.cache/lacli. OSError where there is no home."""
    root = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(root) if root else Path.home() / ".cache") / "lacli"
    except RuntimeError as error:
        raise OSError(f"no folder to keep it in ({error}); set XDG_CACHE_HOME") from error


def processor() -> str:
    """What code for ``-march=native`` depends on: a home may be shared by machines of several kinds."""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        return next((line for line in text.splitlines() if line.startswith(("flags", "Features"))), "")
    return ""


def compiler_version(compiler: str | Path) -> str:
    """What the compiler calls its version; raises OSError where it does not start, SubprocessError where it hangs."""
    command = [str(compiler), "-dumpfullversion"]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=_TIMEOUT_S).stdout.strip()


def compile_with(command: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a compiler in ``folder``. On a time-out, or any exception here, it and what it started are killed.

    Raises OSError where it does not start, SubprocessError where it takes longer than _TIMEOUT_S.
    """
    with subprocess.Popen(
        **mortal(command),
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as child:
        try:
            out, err = child.communicate(timeout=_TIMEOUT_S)
        except BaseException:
            # the driver's own children (cc1plus, ld) do not end with it
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            raise
    return subprocess.CompletedProcess(list(command), child.returncode, out, err)


def kept(cache: Path, parts: tuple[str, ...], name: str, build: Callable[[Path], Path]) -> Path:
    """The file ``name`` kept in ``cache`` under a key of all it depends on; made at first use.

    ``build`` makes it in a temporary folder, from where it is moved into place, so several processes may ask at once.
    """
    target = cache / hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16] / name
    if not target.is_file():
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".build-", dir=cache) as folder:
            built = build(Path(folder))
            # on the disk before it has its name: a library cut short by a power failure would end every process that loads it
            with built.open("rb") as stream:
                os.fsync(stream.fileno())
            built.replace(target)
    return target


@functools.cache
def library(source: Path) -> ctypes.CDLL | None:
    """The library of one C++ file, compiled once per source, compiler and processor; None, logged, where it cannot be had.

    LACLI_COMPILED=0 does without.
    """
    compiler = shutil.which(os.environ.get("CXX", "g++"))
    if compiler is None or os.environ.get("LACLI_COMPILED") == "0":
        _logger.info("%s is not compiled: no compiler, or LACLI_COMPILED=0", source.name)
        return None

    def build(folder: Path) -> Path:
        built = folder / f"{source.stem}.so"
        command = [compiler, *_FLAGS, str(source.resolve()), "-o", str(built), *_LIBRARIES]
        compile_with(command, folder).check_returncode()
        ctypes.CDLL(str(built))
        return built

    try:
        text = source.read_text(encoding="utf-8")
        parts = (text, compiler, compiler_version(compiler), processor(), *_FLAGS, *_LIBRARIES)
        file = kept(cache_folder(), parts, f"{source.stem}.so", build)
        try:
            return ctypes.CDLL(str(file))
        except OSError:  # damaged, or made beside a newer C library: a home may be shared
            file.unlink(missing_ok=True)
            return ctypes.CDLL(str(kept(cache_folder(), parts, f"{source.stem}.so", build)))
    except (OSError, subprocess.SubprocessError) as error:
        _logger.info("%s is not compiled: %s", source.name, getattr(error, "stderr", None) or error)
        return None
