"""Plugins of FreeFEM: compiled once for a source, a FreeFEM and a compiler, and kept."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

from lacli.base.errors import SolverMissingError
from lacli.base.processes import native as compiled
from lacli.freefem.program import FreeFem, load_obstacle


def plugin_obstacle(freefem: FreeFem) -> str | None:
    """Why no plugin can be compiled here, with the command that helps; None if nothing is in the way."""
    if freefem.compiler is None:
        return "there is no C++ compiler: sudo apt-get install -y g++"
    if freefem.header_path is None:
        return "FreeFEM's headers are missing: sudo apt-get install -y libfreefem++-dev"
    return None


def compile_plugin(freefem: FreeFem, source: Path, cache_folder: Path | None = None, flags: Sequence[str] = ()) -> Path:
    """Compile a FreeFEM plugin once per source, FreeFEM and compiler; later calls return the kept one.

    The headers in the source's own folder and below are part of the source, and found from there; a line
    ``// link: -lname ...`` in it names libraries to link, ``flags`` are for the compiler. It is built in a temporary folder,
    tried, and moved into place, so several processes may ask at once. Raises SolverMissingError when it cannot be built or does
    not load.
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
    command += [
        f"-I{source.parent.resolve()}",
        f"-I{freefem.header_path}",
        str(source.resolve()),
        "-o",
        str(built),
        *_libraries(source),
    ]
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
    texts = [source, *sorted(path for path in source.parent.rglob("*") if path.suffix in (".hpp", ".h"))]
    parts = [path.read_text(encoding="utf-8") for path in texts]
    if any("native" in flag for flag in flags):
        parts.append(compiled.processor())
    version = compiled.compiler_version(str(freefem.compiler))
    return (*parts, freefem.version, str(state.st_size), str(state.st_mtime_ns), str(freefem.compiler), version, *flags)
