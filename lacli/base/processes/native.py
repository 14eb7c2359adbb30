"""Small C++ libraries of ours, compiled at first use and kept; whoever asks has a slower way without."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lacli.base.errors import LacliError
from lacli.base.files import write_text
from lacli.base.notes import note, slow
from lacli.base.processes.locks import lock
from lacli.base.processes.process import answer_of, supervise

_FLAGS = ("-shared", "-fPIC", "-O3", "-std=c++17", "-fno-math-errno", "-march=native")
_LIBRARIES = ("-lmvec", "-lm")
_TIMEOUT_S = 300.0
_VERSION_TIMEOUT_S = 20.0
_KILLED = re.compile(r"signal terminated program|internal compiler error: Killed|\(Killed\)", re.IGNORECASE)
_logger = logging.getLogger(__name__)


class CompilerError(Exception):
    """The compiler did not come to an end: killed, or stopped after its time. The message says which."""


@dataclass(frozen=True)
class Compiled:
    """How a compiler ended, and what it said."""

    code: int
    lines: tuple[str, ...]


def cache_folder() -> Path:
    """Where compiled libraries are kept: $XDG_CACHE_HOME/lacli or ~/.cache/lacli. OSError where there is no home."""
    if root := os.environ.get("XDG_CACHE_HOME"):
        return Path(root) / "lacli"
    try:
        home = Path.home()
    except RuntimeError as error:
        raise OSError(f"no folder to keep it in ({error}); set XDG_CACHE_HOME") from error
    if not home.is_dir():  # a home that is not there is not ours to make, even where we may
        raise OSError(f"no folder to keep it in ({home} does not exist); set XDG_CACHE_HOME")
    return home / ".cache" / "lacli"


def processor() -> str:
    """What code for ``-march=native`` depends on: a home may be shared by machines of several kinds."""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        return next((line for line in text.splitlines() if line.startswith(("flags", "Features"))), "")
    return ""


def compiler_version(compiler: str | Path) -> str:
    """What the compiler calls its version; raises OSError where it does not start, SubprocessError where it hangs."""
    return answer_of([str(compiler), "-dumpfullversion"], timeout_s=_VERSION_TIMEOUT_S).stdout.strip()


def compile_with(command: Sequence[str], folder: Path, what: str) -> Compiled:
    """Run a compiler in ``folder``; ``what`` it compiles is told where it takes long. No process of it outlives us.

    A compiler that was killed is asked once more. Raises OSError where it does not start, CompilerError where it is killed
    again or takes longer than 300 s.
    """
    for last in (False, True):
        lines: list[str] = []
        with slow(f"compiling {what} with {command[0]}, once for this machine: up to {_TIMEOUT_S:.0f} s"):
            ended = supervise(
                command,
                cwd=folder,
                env=os.environ,
                log=folder / "compiler.log",
                timeout_s=_TIMEOUT_S,
                on_line=lambda line, lines=lines: lines.append(line) if len(lines) < 1000 else None,  # type: ignore[misc]
                family=True,
            )
        if ended.cut == "timeout":
            raise CompilerError(f"{command[0]} did not come to an end within {_TIMEOUT_S:.0f} s and was stopped")
        if ended.cut is not None:
            raise CompilerError(f"{command[0]} was stopped: {ended.cut.replace('_', ' ')}")
        if ended.exit_code >= 0 and not (ended.exit_code > 0 and any(_KILLED.search(line) for line in lines)):
            break
        if last:
            raise CompilerError(f"{command[0]} was killed from outside, twice (no memory left?)")
        note(f"{command[0]} was killed from outside when it compiled {what}; trying once more", once=False)
    return Compiled(ended.exit_code, tuple(lines))


def kept(cache: Path, parts: tuple[str, ...], name: str, build: Callable[[Path], Path]) -> Path:
    """The file ``name`` kept in ``cache`` under a key of all it depends on; made at first use.

    ``build`` makes it in a temporary folder, from where it is moved into place. Its digest is kept beside it: a file that is
    not what was built is built again. Several processes may ask at once: one builds, the others wait.
    """
    target = cache / hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16] / name
    if _sound(target):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    with lock(cache / f".lock-{target.parent.name}", f"which compiles {name}"):
        if _sound(target):
            return target
        if target.exists():
            note(f"{target}: not what was compiled (damaged, or changed); compiling it again", once=False)
        for old in cache.glob(f".build-{target.parent.name}-*"):  # of a process that was killed: the lock is ours
            shutil.rmtree(old, ignore_errors=True)
        with tempfile.TemporaryDirectory(prefix=f".build-{target.parent.name}-", dir=cache) as folder:
            built = build(Path(folder))
            # on the disk before it has its name: a library cut short by a power failure would end every process that loads it
            with built.open("rb") as stream:
                os.fsync(stream.fileno())
            write_text(_digest_file(target), _digest(built))
            built.replace(target)
    return target


def _digest_file(target: Path) -> Path:
    return target.with_name(target.name + ".sha256")


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _sound(target: Path) -> bool:
    """Whether the kept file is the one that was built."""
    try:
        return _digest_file(target).read_text(encoding="ascii").strip() == _digest(target)
    except (OSError, ValueError):
        return False


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
        answer = compile_with([compiler, *_FLAGS, str(source.resolve()), "-o", str(built), *_LIBRARIES], folder, source.name)
        if answer.code != 0:
            raise CompilerError(" / ".join(answer.lines[:3]))
        ctypes.CDLL(str(built))
        return built

    try:
        text = source.read_text(encoding="utf-8")
        parts = (text, compiler, compiler_version(compiler), processor(), *_FLAGS, *_LIBRARIES)
        file = kept(cache_folder(), parts, f"{source.stem}.so", build)
        try:
            return ctypes.CDLL(str(file))
        except OSError:  # made beside a newer C library: a home may be shared
            file.unlink(missing_ok=True)
            return ctypes.CDLL(str(kept(cache_folder(), parts, f"{source.stem}.so", build)))
    except (OSError, subprocess.SubprocessError, CompilerError, LacliError) as error:
        _logger.info("%s is not compiled: %s", source.name, error)
        return None
