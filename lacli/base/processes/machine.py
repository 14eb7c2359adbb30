"""What the machine gives: memory and room on the disk, with the limits of container and shell, in numbers and words."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
from collections.abc import Iterable
from pathlib import Path

# what writing says when not all of it fits: no room, no quota, a file larger than `ulimit -f` or the file system lets it be
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def memory_mb() -> tuple[float, float]:
    """Total and available memory of the machine in MB, the smaller of the machine's and the container's."""
    total, available = _machine_mb()
    with contextlib.suppress(OSError, ValueError, StopIteration):
        limit, used = _container_mb()
        total, available = min(total, limit), min(available, limit - used)
    return total, available


def _machine_mb() -> tuple[float, float]:
    fields = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
    total, available = (float(fields[name].split()[0]) / 1024 for name in ("MemTotal", "MemAvailable"))
    return total, available


def _container_mb() -> tuple[float, float]:
    """Limit and use of the control group; OSError or ValueError where there is none."""
    limit = int(Path("/sys/fs/cgroup/memory.max").read_text()) / 2**20
    used = int(Path("/sys/fs/cgroup/memory.current").read_text()) / 2**20
    # cached files count as used there, but give way
    cache = next(
        int(line.split()[1]) / 2**20
        for line in Path("/sys/fs/cgroup/memory.stat").read_text().splitlines()
        if line.startswith("file ")
    )
    return limit, used - cache


def memory_limit() -> str:
    """The narrowest limit of memory that one process meets here, in words."""
    total, available = _machine_mb()
    limits = [(total, f"this machine has {total:.0f} MB, {available:.0f} MB of them free")]
    with contextlib.suppress(OSError, ValueError, StopIteration):
        limit, _ = _container_mb()
        limits.append((limit, f"this container or job may use {limit:.0f} MB"))
    for name, option in ((resource.RLIMIT_AS, "-v"), (resource.RLIMIT_DATA, "-d")):
        soft, _ = resource.getrlimit(name)
        if soft != resource.RLIM_INFINITY:
            limits.append((soft / 2**20, f"ulimit {option} allows {soft / 2**20:.0f} MB"))
    return min(limits)[1]


def free_bytes(folder: Path) -> int:
    """Bytes that can still be written where ``folder`` is."""
    state = os.statvfs(folder)
    blocks = state.f_bfree if os.geteuid() == 0 else state.f_bavail
    return blocks * state.f_frsize if state.f_blocks else 1 << 40


def disk_is_full(folder: Path) -> bool:
    """Whether 64 kB cannot be written into ``folder`` any more (quotas and ``ulimit -f`` included)."""
    probe = folder / f".probe-{os.getpid()}"
    try:
        with probe.open("wb", buffering=0) as stream:
            written = stream.write(bytes(1 << 16))
            os.fsync(stream.fileno())
        return written < 1 << 16
    except OSError as error:
        return error.errno in FULL
    finally:
        with contextlib.suppress(OSError):
            probe.unlink(missing_ok=True)


def full_words(place: str | Path, number: int | None) -> str:
    """One message for an error of FULL at ``place``: what, where, what to do."""
    if number == errno.EFBIG:
        soft, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        limit = "what the file system takes" if soft == resource.RLIM_INFINITY else f"ulimit -f, {soft >> 10} kB"
        return (
            f"{place}: a file would be larger than allowed ({limit}). Raise the limit and run again; what was finished is kept."
        )
    return f"{place}: the disk is full. Free some space and run again; what was finished is kept."


def full_place(candidates: Iterable[Path]) -> Path | None:
    """The first of the places, or the folder that holds it, where nothing more can be written."""
    for place in candidates:
        folder = next((p for p in (place.absolute(), *place.absolute().parents) if p.is_dir()), None)
        if folder is not None and disk_is_full(folder):
            return folder
    return None


def status_kb(pid: int, field: str) -> float:
    """A memory figure of /proc/<pid>/status in kB, 0 where there is none (a zombie)."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith(field):
                return float(line.split()[1])
    return 0.0


def family_mb(pid: int) -> float:
    """Resident memory of a process and all that descend from it, MB."""
    total = status_kb(pid, "VmRSS") / 1024
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):
                total += sum(family_mb(int(child)) for child in (thread / "children").read_text().split())
    return total
