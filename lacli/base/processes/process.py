"""A supervised child process: its lines as they come, its limits, and no orphan whatever happens to lacli."""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from lacli.base.processes import launch
from lacli.base.processes.machine import FULL, free_bytes, memory_mb, status_kb

_TICK_S = 0.2
_LAST_LINES = 40
_LONGEST_LINE = 1 << 20
_wanted: ContextVar[Callable[[], bool] | None] = ContextVar("wanted", default=None)


@dataclass(frozen=True)
class Ended:
    """How a child ended: ``exit_code`` (negative: minus the signal), ``cut`` why we stopped it, if we did.

    cpu_s: user and system seconds of the child and the children it waited for; peak_memory_mb: largest resident
    set; last_memory_share: its part of the machine's memory when last seen.
    """

    exit_code: int
    cut: str | None
    cpu_s: float
    wall_s: float
    peak_memory_mb: float
    last_memory_share: float
    last_lines: tuple[str, ...]


def mortal(command: Sequence[str], family: bool = False) -> list[str]:
    """A command that the kernel kills when the thread that starts it ends, even by kill -9.

    family: with all that it starts, for programs whose children do not end with them; it must lead a session of its own
    (``start_new_session``). Raises FileNotFoundError where there is no such program.
    """
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(errno.ENOENT, "no such program", command[0])
    way = "family" if family else "alone"
    return [sys.executable, "-I", "-S", launch.__file__, way, str(os.getpid()), *command]


@contextlib.contextmanager
def while_wanted(wanted: Callable[[], bool]) -> Iterator[None]:
    """Within the block, what ``supervise`` runs in this thread is ended when ``wanted`` says no (``cut`` is ``cancelled``)."""
    token = _wanted.set(wanted)
    try:
        yield
    finally:
        _wanted.reset(token)


def is_wanted() -> bool:
    """Whether this thread shall go on; always outside ``while_wanted``."""
    wanted = _wanted.get()
    return wanted is None or wanted()


def answer_of(
    command: Sequence[str], *, timeout_s: float, cwd: Path | None = None, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """What a short command prints; as ``subprocess.run`` with captured text, but neither it nor its children outlive us.

    Raises OSError where it does not start, TimeoutExpired where it takes longer.
    """
    with subprocess.Popen(
        mortal(command, family=True),
        cwd=cwd,
        env=None if env is None else dict(env),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as child:
        try:
            out, err = child.communicate(timeout=timeout_s)
        finally:
            if child.returncode is None:
                _kill_group(child)
    return subprocess.CompletedProcess(list(command), child.returncode, out, err)


def supervise(
    command: Sequence[str],
    *,
    cwd: Path,
    env: Mapping[str, str],
    log: Path,
    timeout_s: float,
    on_line: Callable[[str], None] | None = None,
    family: bool = False,
) -> Ended:
    """Run ``command``, append what it prints to ``log`` as it comes, pass each line to ``on_line``.

    The child leads its own session; it and its children are killed on time-out, on a full disk, when the machine's
    memory runs out, when it is no longer wanted, and on any exception here (Ctrl-C included). ``cut`` is then
    ``timeout``, ``disk_full``, ``out_of_memory`` or ``cancelled``. family: also when kill -9 ends us, at the cost of a
    process more. Raises OSError if the command cannot be started.
    """
    own_memory_kb = status_kb(os.getpid(), "VmHWM")
    start = time.monotonic()
    with log.open("ab", buffering=0) as sink:
        child = subprocess.Popen(
            mortal(command, family),
            cwd=cwd,
            env=dict(env),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        watch = _Watch(child, sink.write, on_line, cwd, start + timeout_s)
        try:
            cut = watch.until_exit()
        finally:
            # the child is not reaped yet, so its group's number cannot belong to anybody else
            _kill_group(child)
            _, status, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
            watch.close()
    # ru_maxrss starts at the parent's size (fork copies it), so below that the polled value is the true one
    peak_kb = usage.ru_maxrss if usage.ru_maxrss > own_memory_kb * 1.02 or not watch.peak_kb else watch.peak_kb
    return Ended(
        exit_code=child.returncode,
        cut=cut,
        cpu_s=usage.ru_utime + usage.ru_stime,
        wall_s=time.monotonic() - start,
        peak_memory_mb=peak_kb / 1024,
        last_memory_share=watch.memory_share,
        last_lines=tuple(watch.last),
    )


def _kill_group(child: subprocess.Popen[bytes] | subprocess.Popen[str]) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child.pid, signal.SIGKILL)


class _Watch:
    """Reads a child's output and looks after time, disk and memory until it exits."""

    def __init__(
        self,
        child: subprocess.Popen[bytes],
        write: Callable[[bytes], object],
        on_line: Callable[[str], None] | None,
        folder: Path,
        deadline: float,
    ) -> None:
        assert child.stdout is not None
        self.child, self.stdout, self.write, self.on_line = child, child.stdout, write, on_line
        self.folder, self.deadline = folder, deadline
        self.last: deque[str] = deque(maxlen=_LAST_LINES)
        self.peak_kb, self.memory_share = 0.0, 0.0
        self._rest = b""
        self._next_tick = 0.0
        self._exit = os.pidfd_open(child.pid)
        os.set_blocking(self.stdout.fileno(), False)

    def until_exit(self) -> str | None:
        """Wait; returns None when the child ended by itself, else why it must be killed."""
        with selectors.DefaultSelector() as ready:
            ready.register(self.stdout, selectors.EVENT_READ)
            ready.register(self._exit, selectors.EVENT_READ)
            while True:
                events = [key.fileobj for key, _ in ready.select(_TICK_S)]
                try:
                    if self.stdout in events and not self._read():
                        ready.unregister(self.stdout)  # closed; the exit follows
                    if self._exit in events:
                        while self._read():
                            pass
                        self._flush()
                        return None
                except OSError as error:
                    if error.errno in FULL:
                        return "disk_full"
                    raise
                if cut := self._over_limit():
                    return cut

    def close(self) -> None:
        os.close(self._exit)
        self.stdout.close()

    def _read(self) -> bool:
        """Take what is there; False when there is nothing or the other end is closed."""
        data = self.stdout.read(1 << 16)
        if not data:
            return False
        self.write(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._line(line)
        if len(self._rest) > _LONGEST_LINE:
            self._flush()
        return True

    def _flush(self) -> None:
        if self._rest:
            rest, self._rest = self._rest, b""
            self._line(rest)

    def _line(self, raw: bytes) -> None:
        text = raw.decode("utf-8", errors="replace").rstrip("\r")
        self.last.append(text)
        if self.on_line is not None:
            self.on_line(text)

    def _over_limit(self) -> str | None:
        now = time.monotonic()
        if now >= self.deadline:
            return "timeout"
        if now < self._next_tick:
            return None
        if not is_wanted():
            return "cancelled"
        self._next_tick = now + _TICK_S
        self.peak_kb = max(self.peak_kb, status_kb(self.child.pid, "VmHWM"))
        resident = status_kb(self.child.pid, "VmRSS")
        total, available = memory_mb()
        self.memory_share = resident / 1024 / total
        # the kernel would kill somebody next; better the greedy one, with its name on it
        if available < 0.01 * total and self.memory_share > 0.2:
            return "out_of_memory"
        return "disk_full" if free_bytes(self.folder) < 1 << 14 else None
