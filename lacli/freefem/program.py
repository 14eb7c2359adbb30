"""FreeFEM as an external program: where it is, how a script runs, what the script says, how a plugin is compiled.

A script talks in lines that start with ``@ ``: ``@ progress phase=unload load=0.25 step=0.25 newton=3 residual=1e-4
minj=0.8``, ``@ stop kind=load_step_underflow message=the rest of the line``, ``@ done``. Output into a pipe is
block-buffered, so a script follows each such line by ``cout.flush;``.
"""

from __future__ import annotations

import errno
import functools
import logging
import os
import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lacli.base.errors import MachineError, SolverMissingError
from lacli.base.processes import native as compiled
from lacli.base.processes.machine import disk_is_full, full_words, memory_limit
from lacli.base.processes.process import Ended, answer_of, supervise

INSTALL = "sudo apt-get install -y freefem++ libfreefem++-dev libmumps-seq-dev libopenblas0-pthread g++"
_logger = logging.getLogger(__name__)
_BINARIES = ("FreeFem++", "FreeFem++-nw", "freefem++")
_ROOTS = ("/usr", "/usr/local", "/opt/freefem", "/opt/FreeFem", "/usr/local/FreeFem", "/opt/ff++")
_CRASHES = {signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGBUS, signal.SIGILL}
_NO_MEMORY = re.compile(r"bad_alloc|cannot allocate memory|out of memory|not enough memory", re.IGNORECASE)
_NO_SPACE = re.compile(r"no space left on device|disk quota exceeded|file too large", re.IGNORECASE)
_TELLING = re.compile(r"(?:exec|compile|load|syntax)\s+error\s*:|assertion|error line number", re.IGNORECASE)
_MUMPS_ERROR = re.compile(r"(?:Erreur Mumps seq: number |@ mumps error=)(-\d+)")
_MUMPS_NO_MEMORY = {"-13", "-19", "-20", "-22"}  # an allocation failed, or more than was allowed (MUMPS users' guide, section 8)
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
        """Environment of a run: plugin and include folders (``includes`` first), one BLAS thread, C locale."""
        folders = [*includes, *([self.include_path] if self.include_path else [])]
        count = str(threads)
        return {
            **os.environ,
            "FF_LOADPATH": f"{self.load_path};;",
            "FF_INCLUDEPATH": ";".join(f"{folder}" for folder in folders) + ";;",
            "FF_VERBOSITY": "0",
            "OMP_NUM_THREADS": count,
            "OPENBLAS_NUM_THREADS": count,
            "MKL_NUM_THREADS": count,
            "BLIS_NUM_THREADS": count,
            "LC_ALL": "C",
        }


@dataclass(frozen=True)
class Outcome:
    """How a script ended. ``kind`` is None for success, else the kind of failure: what the script named in ``@ stop``,
    or one of ``lacli.contracts.failures``."""

    exit_code: int
    kind: str | None
    message: str
    cpu_s: float
    wall_s: float
    peak_memory_mb: float
    last_lines: tuple[str, ...]

    @property
    def done(self) -> bool:
        """Whether the script came to its ``@ done``."""
        return self.kind is None


@dataclass(frozen=True)
class Progress:
    """One ``@ progress`` line; a number the script did not give is NaN, other words are in ``extra``."""

    phase: str
    load: float = float("nan")
    step: float = float("nan")
    newton: float = float("nan")
    residual: float = float("nan")
    minj: float = float("nan")
    extra: dict[str, str] = field(default_factory=dict)


def parse_progress(line: str) -> Progress | None:
    """The content of a ``@ progress`` line; None for any other or a malformed line."""
    if not line.startswith("@ progress "):
        return None
    words = dict(word.split("=", 1) for word in line.split()[2:] if "=" in word)
    numbers = {}
    try:
        for name in ("load", "step", "newton", "residual", "minj"):
            if name in words:
                numbers[name] = float(words.pop(name))
    except ValueError:
        return None
    return Progress(phase=words.pop("phase", ""), **numbers, extra=words)


def parse_stop(line: str) -> tuple[str, str] | None:
    """Kind and message of a ``@ stop`` line, None for any other line."""
    found = re.match(r"@ stop kind=([A-Za-z_0-9]+)(?:\s+message=(.*))?$", line)
    return (found[1], (found[2] or "").strip()) if found else None


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
        command = [str(freefem.binary), "-nw", "-ne", "-v", "0", str(script)]
        try:
            answer = answer_of(command, cwd=Path(folder), env=freefem.environment(), timeout_s=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"{error}"
    number = -answer.returncode
    if number > 0 and number not in _CRASHES:
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
    return cause[0] if cause else _telling(lines)


def run(
    freefem: FreeFem,
    script: Path,
    folder: Path,
    timeout_s: float,
    on_line: Callable[[str], None] | None = None,
    threads: int = 1,
    includes: Sequence[Path] = (),
) -> Outcome:
    """Run ``script`` in ``folder``; what it prints goes to ``folder/solver.log`` and, line by line, to ``on_line``.

    Success is exit code 0 *and* a last word of ``@ done``: an error inside FreeFEM can leave earlier output looking
    complete. FreeFEM and its children are killed on time-out, on Ctrl-C and when lacli dies.
    """
    said: list[str] = []

    def listen(line: str) -> None:
        if line.startswith(("@ stop", "@ done")):
            said.append(line)
        if on_line is not None:
            on_line(line)

    command = [str(freefem.binary), "-nw", "-ne", "-v", "0", str(script.resolve())]
    log = folder / "solver.log"
    environment = freefem.environment(threads, includes)
    ended = supervise(command, cwd=folder, env=environment, log=log, timeout_s=timeout_s, on_line=listen)
    kind, message = _judge(ended, said, timeout_s, folder)
    return Outcome(
        exit_code=ended.exit_code,
        kind=kind,
        message=message,
        cpu_s=ended.cpu_s,
        wall_s=ended.wall_s,
        peak_memory_mb=ended.peak_memory_mb,
        last_lines=ended.last_lines,
    )


def _judge(ended: Ended, said: list[str], timeout_s: float, folder: Path) -> tuple[str | None, str]:
    """Kind of failure (None: success) and one sentence about it."""
    text = "\n".join(ended.last_lines)
    if ended.cut == "timeout":
        return "timeout", f"FreeFEM was stopped after {timeout_s:g} s (numerics.timeout_s)."
    if ended.exit_code == -signal.SIGXFSZ:
        return "disk_full", full_words(folder, errno.EFBIG)
    if ended.cut == "disk_full" or _NO_SPACE.search(text) or disk_is_full(folder):
        return "disk_full", full_words(folder, errno.ENOSPC)
    if ended.cut == "cancelled":
        return "cancelled", "The run was cancelled before it had ended."
    memory = (
        f"FreeFEM ran out of memory: it used {ended.peak_memory_mb:.0f} MB and wanted more; {memory_limit()}. "
        "Run fewer side by side (--workers 1), or a coarser mesh."
    )
    found = None if _said_done(said) else _MUMPS_ERROR.search(text)
    if ended.cut == "out_of_memory" or _NO_MEMORY.search(text) or (found and found[1] in _MUMPS_NO_MEMORY):
        return "out_of_memory", memory
    if found:
        return "linear_solver", f"MUMPS could not solve the linear system (error {found[1]})."
    for line in said:
        if stop := parse_stop(line):
            return stop[0], stop[1] or f"The script stopped: {stop[0]}."
    if ended.exit_code < 0:
        name = signal.Signals(-ended.exit_code).name
        if -ended.exit_code in _CRASHES:
            return "freefem_error", f"FreeFEM crashed ({name}). {_telling(ended.last_lines)}"
        if ended.last_memory_share > 0.5:
            return "out_of_memory", memory
        return "killed", f"FreeFEM was killed from outside ({name}). Run again."
    if ended.exit_code > 0:
        return "freefem_error", f"FreeFEM stopped with code {ended.exit_code}. {_telling(ended.last_lines)}"
    if not _said_done(said):
        return "freefem_error", f"FreeFEM ended before the script was done. {_telling(ended.last_lines)}"
    return None, ""


def _said_done(said: list[str]) -> bool:
    return "@ done" in [line.strip() for line in said]


def _telling(lines: Sequence[str]) -> str:
    """The line that names the error with its neighbours, or the last ones."""
    lines = [line.strip() for line in lines if line.strip() and not _IDLE.match(line)]
    first = next((i for i, line in enumerate(lines) if _TELLING.search(line)), None)
    chosen = lines[-3:] if first is None else lines[max(0, first - 1) : first + 2]
    return "It said: " + " / ".join(chosen) if chosen else "It said nothing."


def plugin_obstacle(freefem: FreeFem) -> str | None:
    """Why no plugin can be compiled here, with the command that helps; None if nothing is in the way."""
    if freefem.compiler is None:
        return "there is no C++ compiler: sudo apt-get install -y g++"
    if freefem.header_path is None:
        return "FreeFEM's headers are missing: sudo apt-get install -y libfreefem++-dev"
    return None


def build_plugin(freefem: FreeFem, source: Path, cache_folder: Path | None = None, flags: Sequence[str] = ()) -> Path | None:
    """As ``compile_plugin``, but None, with the reason logged, when the plugin cannot be had."""
    try:
        return compile_plugin(freefem, source, cache_folder, flags)
    except SolverMissingError as error:
        _logger.warning("%s", error)
        return None


def compile_plugin(freefem: FreeFem, source: Path, cache_folder: Path | None = None, flags: Sequence[str] = ()) -> Path:
    """Compile a FreeFEM plugin once per source, FreeFEM and compiler; later calls return the kept one.

    The source's own folder is part of the source (headers beside it); a line ``// link: -lname ...`` in it names
    libraries to link, ``flags`` are for the compiler. It is built in a temporary folder, tried, and moved into place,
    so several processes may ask at once. Raises SolverMissingError when it cannot be built or does not load.
    """
    if obstacle := plugin_obstacle(freefem):
        raise SolverMissingError(f"{source.name} is not compiled: {obstacle}")
    try:
        cache = (cache_folder or compiled.cache_folder()).resolve()
        parts = _plugin_parts(freefem, source, flags)
        return compiled.kept(cache, parts, f"{source.stem}.so", lambda folder: _compile(freefem, source, folder, flags))
    except (OSError, subprocess.SubprocessError, compiled.CompilerError) as error:
        raise SolverMissingError(f"{source.name} is not compiled: {error}") from error


def _compile(freefem: FreeFem, source: Path, folder: Path, flags: Sequence[str]) -> Path:
    built = folder / f"{source.stem}.so"
    # what ff-c++ runs, in one step: these macros must be those FreeFEM itself was compiled with
    macros = ["-DNDEBUG", "-DBAMG_LONG_LONG", "-DNCHECKPTR"]
    command = [str(freefem.compiler), "-shared", "-fPIC", "-O3", "-std=c++14", "-w", *macros, *flags]
    command += [f"-I{freefem.header_path}", str(source.resolve()), "-o", str(built), *_libraries(source)]
    answer = compiled.compile_with(command, folder, source.name)
    if answer.code != 0:
        errors = [line for line in answer.lines if "error:" in line or "cannot find" in line][:3]
        raise SolverMissingError(f"{source.name} does not compile: {' / '.join(errors or answer.lines[-5:])[-800:]}")
    if reason := load_obstacle(freefem, str(built.with_suffix(""))):
        raise SolverMissingError(f"{source.name} compiles, but FreeFEM does not load it: {reason}")
    return built


def _libraries(source: Path) -> list[str]:
    found = re.search(r"^// link:(.*)$", source.read_text(encoding="utf-8"), re.MULTILINE)
    return found[1].split() if found else []


def _plugin_parts(freefem: FreeFem, source: Path, flags: Sequence[str]) -> tuple[str, ...]:
    """What a compiled plugin depends on."""
    state = freefem.binary.resolve().stat()
    texts = [source, *sorted(path for path in source.parent.iterdir() if path.suffix in (".hpp", ".h"))]
    parts = [path.read_text(encoding="utf-8") for path in texts]
    if any("native" in flag for flag in flags):
        parts.append(compiled.processor())
    version = compiled.compiler_version(str(freefem.compiler))
    return (*parts, freefem.version, str(state.st_size), str(state.st_mtime_ns), str(freefem.compiler), version, *flags)
