"""FreeFEM as an installed program: where it is, what belongs to it, and whether it and its plugins work."""

from __future__ import annotations

import functools
import os
import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lacli.base.errors import MachineError, SolverMissingError
from lacli.base.processes.process import answer_of
from lacli.freefem import blas, memory

INSTALL = "sudo apt-get install -y freefem++ libfreefem++-dev libmumps-seq-dev libopenblas0-pthread g++"
CRASHES = frozenset({signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGBUS, signal.SIGILL})
_BINARIES = ("FreeFem++", "FreeFem++-nw", "freefem++")
_ROOTS = ("/usr", "/usr/local", "/opt/freefem", "/opt/FreeFem", "/usr/local/FreeFem", "/opt/ff++")
_TELLING = re.compile(r"(?:exec|compile|load|syntax)\s+error\s*:|assertion|error line number", re.IGNORECASE)
_IDLE = re.compile(r"@ progress|@ mumps|\s*current line|(?:init|close)\s+MUMPS_SEQ")


@dataclass(frozen=True)
class FreeFem:
    """An installed FreeFEM: binary; version as it calls itself; folder of plugins (.so), of .idp files, of C++ headers
    (None without the development package); C++ compiler (None if there is none)."""

    binary: Path
    version: str
    load_path: Path
    include_path: Path | None
    header_path: Path | None
    compiler: Path | None

    def environment(self, threads: int = 1, includes: Sequence[Path] = ()) -> dict[str, str]:
        """Environment of a run: plugin and include folders (``includes`` first), one BLAS thread on the
        processor's own kernels, freed memory kept, C locale."""
        folders = [*includes, *([self.include_path] if self.include_path else [])]
        count = str(threads)
        return {
            **os.environ,
            **blas.environment(),
            **memory.environment(),
            "FF_LOADPATH": f"{self.load_path};;",
            "FF_INCLUDEPATH": ";".join(f"{folder}" for folder in folders) + ";;",
            "FF_VERBOSITY": "0",
            "OMP_NUM_THREADS": count,
            "OPENBLAS_NUM_THREADS": count,
            "MKL_NUM_THREADS": count,
            "BLIS_NUM_THREADS": count,
            "LC_ALL": "C",
        }

    def command(self, script: Path) -> list[str]:
        """The command that runs a script, quietly and without graphics."""
        return [str(self.binary), "-nw", "-ne", "-v", "0", str(script)]


def find() -> FreeFem:
    """Find FreeFEM and what it needs, and see that it runs.

    Environment: LACLI_FREEFEM names the binary, FF_LOADPATH a folder of plugins, CXX the compiler; none is needed.
    Raises SolverMissingError with the command that installs it, MachineError where it was killed when it was tried.
    """
    return _find(*(os.environ.get(name, "") for name in ("LACLI_FREEFEM", "FF_LOADPATH", "CXX", "PATH")))


@functools.lru_cache(maxsize=8)
def _find(override: str, load_path: str, compiler: str, search: str) -> FreeFem:
    binary = _binary(override, search)
    roots = [binary.resolve().parent.parent, *map(Path, _ROOTS)]
    plugins = _plugins(load_path, roots)
    if plugins is None:
        raise SolverMissingError(f"{binary} is there, but its plugins (msh3.so) are not. Install them: {INSTALL}")
    found = FreeFem(
        binary=binary,
        version="",
        load_path=plugins,
        include_path=_first(roots, "getARGV.idp", "include/freefem++/idp", "lib/ff++/*/idp", "share/FreeFEM/*/idp"),
        header_path=_first(roots, "ff++.hpp", "include/freefem++", "lib/ff++/*/include", "include/FreeFEM"),
        compiler=_compiler(compiler, search),
    )
    answer = _try_script(found, 'load "msh3"\ncout << "@ version " << version << endl;')
    version = re.search(r"^@ version (\S+)", answer, re.MULTILINE)
    if version is None:
        tail = " / ".join(line.strip() for line in answer.splitlines() if line.strip())[-400:]
        raise SolverMissingError(f"{binary} does not run ({tail or 'it printed nothing'}). Install it again: {INSTALL}")
    return FreeFem(**{**found.__dict__, "version": version[1]})


def _binary(override: str, search: str) -> Path:
    if override:
        path = shutil.which(override, path=search)
        if path is None:
            raise SolverMissingError(f"LACLI_FREEFEM={override}: no such program. Unset it, or install FreeFEM: {INSTALL}")
        return Path(path)
    folders = [f"{root}/bin" for root in _ROOTS]
    for name in _BINARIES:
        if path := shutil.which(name, path=search) or shutil.which(name, path=os.pathsep.join(folders)):
            return Path(path)
    raise SolverMissingError(
        f"FreeFEM is not installed (no {_BINARIES[0]} in PATH or {', '.join(folders)}). Install it: {INSTALL}"
    )


def _plugins(load_path: str, roots: list[Path]) -> Path | None:
    """The folder of msh3.so. Debian's package names one that does not exist, so it is looked for."""
    for folder in load_path.split(";"):
        if folder and (Path(folder) / "msh3.so").is_file():
            return Path(folder).resolve()
    patterns = ("lib/freefem++", "lib/*/freefem++", "lib/ff++/*/lib", "lib/ff++/lib", "lib/FreeFEM/*")
    return _first(roots, "msh3.so", *patterns) or _packaged_plugins()


def _packaged_plugins() -> Path | None:
    if shutil.which("dpkg") is None:
        return None
    listing = answer_of(["dpkg", "-L", "libfreefem++"], timeout_s=30)
    files = [Path(line) for line in listing.stdout.splitlines() if line.endswith("/msh3.so") and "/mpi/" not in line]
    return files[0].parent if files and files[0].is_file() else None


def _first(roots: list[Path], name: str, *patterns: str) -> Path | None:
    for root in roots:
        for pattern in patterns:
            for folder in sorted(root.glob(pattern), reverse=True):
                if (folder / name).is_file():
                    return folder
    return None


def _compiler(override: str, search: str) -> Path | None:
    path = shutil.which(override or "g++", path=search)
    return Path(path) if path else None


def _try_script(freefem: FreeFem, text: str) -> str:
    """What a short script prints, or why it could not run. Raises MachineError where FreeFEM was killed."""
    with tempfile.TemporaryDirectory(prefix="lacli-") as folder:
        script = Path(folder) / "try.edp"
        script.write_text(text, encoding="utf-8")
        try:
            answer = answer_of(freefem.command(script), cwd=Path(folder), env=freefem.environment(), timeout_s=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"{error}"
    number = -answer.returncode
    if number > 0 and number not in CRASHES:
        raise MachineError(
            "killed", f"FreeFEM was killed from outside ({signal.Signals(number).name}) when it was tried. Run again."
        )
    return answer.stdout + answer.stderr


def can_load(freefem: FreeFem, plugin: str) -> bool:
    """Whether the plugin ``plugin`` (``MUMPS_seq``, or a path without .so) loads."""
    return load_obstacle(freefem, plugin) is None


def load_obstacle(freefem: FreeFem, plugin: str) -> str | None:
    """Why a plugin does not load, None if it does."""
    lines = _try_script(freefem, f'load "{plugin}"\ncout << "@ loaded" << endl;').splitlines()
    if "@ loaded" in lines:
        return None
    cause = [line.split("dlerror :", 1)[1].strip() for line in lines if "dlerror :" in line]
    return cause[0] if cause else telling(lines)


def telling(lines: Sequence[str]) -> str:
    """The line that names the error with its neighbours, or the last ones."""
    lines = [line.strip() for line in lines if line.strip() and not _IDLE.match(line)]
    first = next((i for i, line in enumerate(lines) if _TELLING.search(line)), None)
    chosen = lines[-3:] if first is None else lines[max(0, first - 1) : first + 2]
    return "It said: " + " / ".join(chosen) if chosen else "It said nothing."
