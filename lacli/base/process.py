"""A supervised child process: its lines as they come, its limits, and no orphan whatever happens to lacli."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import os
import selectors
import shutil
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_LIBC = ctypes.CDLL(None, use_errno=True)
_PR_SET_PDEATHSIG = 1
_TICK_S = 0.2
_LAST_LINES = 40
_LONGEST_LINE = 1 << 20
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


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


def mortal(command: Sequence[str]) -> dict[str, Any]:
    """Arguments of subprocess.Popen for a child that the kernel kills when the calling thread ends, even by kill -9."""
    if tool := shutil.which("setpriv"):
        return {"args": [tool, "--pdeathsig", "KILL", "--", *command]}
    # code between fork and exec is unsafe beside threads, so only where util-linux is missing
    return {"args": list(command), "preexec_fn": functools.partial(die_with_parent, os.getpid())}


def die_with_parent(parent: int) -> None:
    """Ask the kernel to kill this process when its parent, which must be ``parent``, ends."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before the call above
        os._exit(127)


def supervise(
    command: Sequence[str],
    *,
    cwd: Path,
    env: Mapping[str, str],
    log: Path,
    timeout_s: float,
    on_line: Callable[[str], None] | None = None,
) -> Ended:
    """Run ``command``, append what it prints to ``log`` as it comes, pass each line to ``on_line``.

    The child leads its own session; it and its children are killed on time-out, on a full disk, when the machine's
    memory runs out, and on any exception here (Ctrl-C included). ``cut`` is then ``timeout``, ``disk_full`` or
    ``out_of_memory``. Raises OSError if the command cannot be started.
    """
    own_memory_kb = _status_kb(os.getpid(), "VmHWM")
    start = time.monotonic()
    with log.open("ab", buffering=0) as sink:
        child = subprocess.Popen(
            **mortal(command),
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
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(child.pid, signal.SIGKILL)
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
                    if error.errno in DISK_FULL:
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
        self._next_tick = now + _TICK_S
        self.peak_kb = max(self.peak_kb, _status_kb(self.child.pid, "VmHWM"))
        resident = _status_kb(self.child.pid, "VmRSS")
        total, available = memory_mb()
        self.memory_share = resident / 1024 / total
        # the kernel would kill somebody next; better the greedy one, with its name on it
        if available < 0.01 * total and self.memory_share > 0.2:
            return "out_of_memory"
        return "disk_full" if free_bytes(self.folder) < 1 << 14 else None


def memory_mb() -> tuple[float, float]:
    """Total and available memory of the machine in MB, the smaller of the machine's and the container's."""
    fields = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
    total, available = (float(fields[name].split()[0]) / 1024 for name in ("MemTotal", "MemAvailable"))
    with contextlib.suppress(OSError, ValueError):
        limit = int(Path("/sys/fs/cgroup/memory.max").read_text()) / 2**20
        used = int(Path("/sys/fs/cgroup/memory.current").read_text()) / 2**20
        # cached files count as used there, but give way
        cache = next(
            int(line.split()[1]) / 2**20
            for line in Path("/sys/fs/cgroup/memory.stat").read_text().splitlines()
            if line.startswith("file ")
        )
        total, available = min(total, limit), min(available, limit - used + cache)
    return total, available


def free_bytes(folder: Path) -> int:
    """Bytes that can still be written where ``folder`` is."""
    state = os.statvfs(folder)
    blocks = state.f_bfree if os.geteuid() == 0 else state.f_bavail
    return blocks * state.f_frsize if state.f_blocks else 1 << 40


def disk_is_full(folder: Path) -> bool:
    """Whether 64 kB cannot be written into ``folder`` any more (quotas included)."""
    probe = folder / f".probe-{os.getpid()}"
    try:
        with probe.open("wb", buffering=0) as stream:
            written = stream.write(bytes(1 << 16))
            os.fsync(stream.fileno())
        return written < 1 << 16
    except OSError as error:
        return error.errno in DISK_FULL
    finally:
        probe.unlink(missing_ok=True)


def _status_kb(pid: int, field: str) -> float:
    """A memory figure of /proc/<pid>/status in kB, 0 where there is none (a zombie)."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith(field):
                return float(line.split()[1])
    return 0.0
