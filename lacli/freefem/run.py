"""A run of FreeFEM: how a script runs as a supervised child, what it says on the way, and how it ended.

A script talks in lines that start with ``@ ``: ``@ progress phase=unload load=0.25 step=0.25 newton=3 residual=1e-4
minj=0.8``, ``@ stop kind=load_step_underflow message=the rest of the line``, ``@ done``. Output into a pipe is
block-buffered, so a script follows each such line by ``cout.flush;``.
"""

from __future__ import annotations

import errno
import re
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lacli.base.processes.machine import disk_is_full, full_words, memory_limit
from lacli.base.processes.process import Ended, supervise
from lacli.contracts.failures import out_of_time
from lacli.freefem.program import CRASHES, FreeFem, telling

_NO_MEMORY = re.compile(r"bad_alloc|cannot allocate memory|out of memory|not enough memory", re.IGNORECASE)
_NO_SPACE = re.compile(r"no space left on device|disk quota exceeded|file too large", re.IGNORECASE)
_MUMPS_ERROR = re.compile(r"(?:Erreur Mumps seq: number |@ mumps error=)(-\d+)")
_MUMPS_NO_MEMORY = {"-13", "-19", "-20", "-22"}  # an allocation failed, or more than was allowed (MUMPS users' guide, section 8)


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

    log = folder / "solver.log"
    environment = freefem.environment(threads, includes)
    command = freefem.command(script.resolve())
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
        return out_of_time(ended.cpu_s, timeout_s)
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
        if -ended.exit_code in CRASHES:
            return "freefem_error", f"FreeFEM crashed ({name}). {telling(ended.last_lines)}"
        if ended.last_memory_share > 0.5:
            return "out_of_memory", memory
        return "killed", f"FreeFEM was killed from outside ({name}). Run again."
    if ended.exit_code > 0:
        return "freefem_error", f"FreeFEM stopped with code {ended.exit_code}. {telling(ended.last_lines)}"
    if not _said_done(said):
        return "freefem_error", f"FreeFEM ended before the script was done. {telling(ended.last_lines)}"
    return None, ""


def _said_done(said: list[str]) -> bool:
    return "@ done" in [line.strip() for line in said]
