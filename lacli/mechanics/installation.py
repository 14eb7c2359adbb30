"""What ``lacli`` needs on this machine, whether it is there, and the command that installs what is not."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from lacli.base.errors import SolverMissingError
from lacli.base.processes import native as compiled
from lacli.base.processes.machine import free_bytes, memory_mb
from lacli.base.processes.process import answer_of
from lacli.base.resources import folder as resource_folder
from lacli.base.version import __version__
from lacli.freefem import plugins
from lacli.freefem import program as ff
from lacli.freefem.program import FreeFem
from lacli.mechanics.engine import PLUGIN_FLAGS, SLOWER_WORDS

# shared library -> the Debian package that has it (gmsh's and VTK's wheels expect these from the system)
_PACKAGES = {
    "libGLU.so": "libglu1-mesa",
    "libGL.so": "libgl1",
    "libEGL.so": "libegl1",
    "libXrender.so": "libxrender1",
    "libXcursor.so": "libxcursor1",
    "libXfixes.so": "libxfixes3",
    "libXft.so": "libxft2",
    "libXinerama.so": "libxinerama1",
    "libX11.so": "libx11-6",
    "libXext.so": "libxext6",
    "libfontconfig.so": "libfontconfig1",
    "libgomp.so": "libgomp1",
}
_PICTURE = """
import vtkmodules.vtkRenderingOpenGL2, pyvista
plot = pyvista.Plotter(off_screen=True, window_size=(64, 64))
plot.add_mesh(pyvista.Sphere(), color="red")
picture = plot.screenshot(return_img=True)
assert picture.std() > 1, "the picture is empty"
print("@", plot.render_window.GetClassName())
"""


@dataclass(frozen=True)
class Check:
    """One thing looked for. ``needed``: without it simulations do not run. ``fix``: the command that helps."""

    name: str
    ok: bool
    found: str
    needed: bool = True
    fix: str = ""

    @property
    def state(self) -> str:
        """``ok``, ``missing`` (needed) or ``advice`` (goes without it, but slower or with less)."""
        return "ok" if self.ok else "missing" if self.needed else "advice"


def inspect() -> list[Check]:
    """All checks, FreeFEM first."""
    checks = []
    try:
        freefem = ff.find()
    except SolverMissingError as error:
        checks.append(Check("FreeFEM", False, str(error), fix=ff.INSTALL))
    else:
        checks += [_freefem(freefem), *_plugins(freefem), _blas(freefem), _compiler(freefem)]
    return [*checks, _gmsh(), _pictures(), *_python(), _machine(), _cluster()]


def _freefem(freefem: FreeFem) -> Check:
    package = _package_version("freefem++")
    text = f"{freefem.version}" + (f" (package {package})" if package else "")
    return Check("FreeFEM", True, f"{text}, {freefem.binary}, plugins in {freefem.load_path}")


def _package_version(name: str) -> str:
    if shutil.which("dpkg-query") is None:
        return ""
    answer = answer_of(["dpkg-query", "-W", "-f", "${Version}", name], timeout_s=30)
    return answer.stdout.strip() if answer.returncode == 0 else ""


def needed_plugins() -> list[str]:
    """Names of the FreeFEM plugins that the deck and the libraries load."""
    names = {"msh3", "MUMPS_seq", "Element_QF"}
    for root in (resource_folder("templates"), resource_folder("solvers")):
        for file in sorted(root.rglob("*")):
            if file.suffix in (".idp", ".edp", ".j2"):
                found = re.findall(r'^\s*load\s+"([A-Za-z0-9_-]+)"', file.read_text(encoding="utf-8"), re.MULTILINE)
                names.update(found)
    return sorted(names)


def _plugins(freefem: FreeFem) -> list[Check]:
    names = needed_plugins()
    absent = [name for name in names if not ff.can_load(freefem, name)]
    fix = "sudo apt-get install --reinstall -y libfreefem++ libfreefem++-dev" if absent else ""
    text = f"do not load: {', '.join(absent)}" if absent else ", ".join(names)
    return [Check("FreeFEM's plugins", not absent, text, fix=fix)]


def blas_library(binary: Path) -> Path | None:
    """The file that a program's libblas.so.3 really is (Debian chooses it by alternatives)."""
    answer = answer_of(["ldd", str(binary)], timeout_s=30)
    found = re.search(r"libblas\.so\S*\s+=>\s+(\S+)", answer.stdout)
    return Path(found[1]).resolve() if found else None


def _blas(freefem: FreeFem) -> Check:
    library = blas_library(freefem.binary.resolve())
    if library is None:
        return Check("BLAS", True, "built into FreeFEM", needed=False)
    fast = any(word in str(library).lower() for word in ("openblas", "blis", "mkl", "atlas"))
    if fast:
        return Check("BLAS", True, str(library), needed=False)
    text = f"{library} is the reference BLAS: the linear solver is many times slower"
    return Check("BLAS", False, text, needed=False, fix="sudo apt-get install -y libopenblas0-pthread")


_WITHOUT = f"optional: simulations run without, with the same numbers in {SLOWER_WORDS}; `lacli verify` needs it"


def _compiler(freefem: FreeFem) -> Check:
    name = "compiled kernels"
    if obstacle := plugins.plugin_obstacle(freefem):
        text, _, fix = obstacle.partition(": ")
        return Check(name, False, f"{text}; {_WITHOUT}", needed=False, fix=fix)
    try:
        for source in sorted((resource_folder("solvers") / "freefem").rglob("*.cpp")):
            plugins.compile_plugin(freefem, source, flags=PLUGIN_FLAGS)
    except SolverMissingError as error:
        return Check(name, False, f"{error}; {_WITHOUT}", needed=False, fix=ff.INSTALL)
    return Check(name, True, f"{freefem.compiler}, kept in {compiled.cache_folder()}")


def _run_python(code: str) -> tuple[bool, str]:
    """In a process of its own, because a graphics library may end the whole process."""
    try:
        command = [sys.executable, "-c", code]
        answer = answer_of(command, timeout_s=120)
    except subprocess.TimeoutExpired:
        return False, "no answer within 120 s"
    if answer.returncode == 0 and "@ " in answer.stdout:
        return True, answer.stdout.split("@ ", 1)[1].strip()
    lines = re.sub(r"\x1b\[[0-9;]*m", "", answer.stderr).strip().splitlines()
    return False, ": ".join([f"code {answer.returncode}", *lines[-1:]])


def _package_of(message: str) -> str:
    return next((package for library, package in _PACKAGES.items() if library in message), "")


def _gmsh() -> Check:
    ok, text = _run_python("import gmsh; gmsh.initialize(); gmsh.finalize(); print('@', gmsh.__version__)")
    package = _package_of(text)
    fix = f"sudo apt-get install -y {package}" if package else f"{sys.executable} -m pip install gmsh"
    return Check("gmsh", ok, text, fix="" if ok else fix)


def _pictures() -> Check:
    ok, text = _run_python(_PICTURE)
    text = f"VTK draws off screen ({text})" if ok else f"VTK cannot draw here: {text}"
    package = _package_of(text) or "libegl1 libgl1 libxrender1"
    return Check("pictures", ok, text, needed=False, fix="" if ok else f"sudo apt-get install -y {package}")


def _python() -> list[Check]:
    checks = [Check("lacli", True, f"{__version__}, Python {platform.python_version()}, {platform.platform()}")]
    absent, present = [], []
    for line in importlib.metadata.requires("lacli") or []:
        if "extra ==" in line:
            continue
        name = re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0]
        try:
            present.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            absent.append(name)
    fix = f"{sys.executable} -m pip install {' '.join(absent)}" if absent else ""
    text = f"missing: {', '.join(absent)}" if absent else ", ".join(sorted(present, key=str.lower))
    return [*checks, Check("Python packages", not absent, text, fix=fix)]


def _machine() -> Check:
    total, available = memory_mb()
    cores = len(os.sched_getaffinity(0))
    room = free_bytes(Path.cwd()) / 2**30
    text = f"{cores} cores, {available / 1024:.1f} of {total / 1024:.1f} GB memory free, {room:.1f} GB disk free here"
    enough = available > 1024 and room > 0.5
    fix = "" if enough else "free some memory or disk space: one simulation wants about 1 GB and 20 MB"
    return Check("machine", enough, text, needed=False, fix=fix)


def _cluster() -> Check:
    present = importlib.util.find_spec("distributed") is not None
    text = "Dask is there" if present else "not installed; only for runs on a Dask cluster"
    return Check("cluster (optional)", True, text, needed=False)
