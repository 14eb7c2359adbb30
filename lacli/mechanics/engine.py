"""What assembles and solves inside FreeFEM: a compiled plugin, or FreeFEM's own language where nothing can be compiled.

Both answer the same verbs (``engine_plugin.idp``, ``engine_script.idp``) and give the same numbers.
"""

from __future__ import annotations

import functools
import logging
from pathlib import Path

from lacli.base import resources
from lacli.base.errors import SceneError, SolverMissingError
from lacli.contracts.laws import LAWS, Law
from lacli.freefem.plugins import compile_plugin, plugin_obstacle
from lacli.freefem.program import find

# the plugin calls MUMPS itself, to keep its analysis between factorisations
PLUGIN_FLAGS = (
    *("-Wl,--no-as-needed", "-march=native", "-ldmumps_seq", "-lmpiseq_seq"),
    # the laws that plugin/law.hpp chooses from
    *(word for name in LAWS for word in ("-include", f"laws/{name}.hpp")),
    "-DLACLI_LAWS=" + " ".join(f"X({name})" for name in LAWS),
)
SLOWER = {1: 2.6, 2: 3.0}  # CPU seconds of the script over the plugin's, by order: benchmarks/terms.py, benchmarks/engines.py
SLOWER_WORDS = f"{min(SLOWER.values()):g} to {max(SLOWER.values()):g} times the time"
_logger = logging.getLogger(__name__)


def plugin() -> Path:
    """The compiled engine, built at first use. Raises SolverMissingError with the command that installs what it needs."""
    found = find()
    source = resources.folder("solvers") / "freefem" / "plugin" / "lacli.cpp"
    try:
        return compile_plugin(found, source, flags=PLUGIN_FLAGS)
    except SolverMissingError as error:
        obstacle = plugin_obstacle(found) or (f"{error}. If MUMPS' headers are missing: sudo apt-get install -y libmumps-seq-dev")
        raise SolverMissingError(f"{obstacle}. `lacli doctor` says more.") from error


def choose(engine: str, law: Law) -> Path | None:
    """The compiled engine's file, or None for the script; ``engine``, as ``numerics.engine``, decides.

    "auto" falls back on the script with one line of warning a process. Raises SolverMissingError where FreeFEM is missing, or
    where the plugin cannot be built and is asked for, or alone has the law; SceneError where the script is asked for such
    a law.
    """
    if engine == "script":
        if not law.script:
            raise SceneError(f"only the compiled engine has materials.law {law.name!r}: set numerics.engine to 'plugin'.")
        return None
    find()
    try:
        return plugin()
    except SolverMissingError as error:
        if engine == "plugin" or not law.script:
            raise
        _warn(str(error))
        return None


def obstacle(engine: str) -> str:
    """What keeps runs from the compiled engine, in words; '' where nothing does. Without FreeFEM the first run says so."""
    if engine == "script":
        return 'numerics.engine is "script"'
    try:
        return (plugin_obstacle(find()) or "") if engine == "auto" else ""
    except SolverMissingError:
        return ""


def name(chosen: Path | None) -> str:
    """``plugin`` or ``script``."""
    return "plugin" if chosen else "script"


@functools.lru_cache(maxsize=8)
def _warn(obstacle: str) -> None:
    _logger.warning("Simulating without the compiled engine: the same numbers in %s. Why: %s", SLOWER_WORDS, obstacle)
