"""One at a time: locks between processes that end with their holder, kill -9 included, and leave no file."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lacli.base.errors import MachineError, StorageError
from lacli.base.files import storing
from lacli.base.notes import note
from lacli.base.processes.process import is_wanted

_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL)
_POLL_S = 0.1
MARKER = ".marker"  # after the name of the lock that it stands for


@contextlib.contextmanager
def lock(path: Path, what: str, wait: bool = True) -> Iterator[bool]:
    """Hold the lock file ``path`` (its folder must be there); yields whether it was got, always so with ``wait``.

    Who must wait is told for whom: process, host, since when, and ``what`` it is waited for (as in "to work in OUT").
    On a file system without locks a marker file takes their place, with a note: it is removed at the end, and its holder's
    death on the same host is noticed. Raises StorageError where neither can be had.
    """
    held = _acquire(path, what, wait)
    if held is None:
        yield False
        return
    try:
        if not _is_marker(held):
            with contextlib.suppress(OSError):
                path.write_text(_me(), encoding="utf-8")
        yield True
    finally:
        if not _is_marker(held):
            # before it is released: whoever waits sees that its file has no name any more, and makes a new one
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            held.release()


@contextlib.contextmanager
def working_on(out: Path) -> Iterator[None]:
    """Within the block this process alone fills ``out`` (a table or a folder, its parents made if absent); a second one waits
    before it, and says for whom. The lock lies beside ``out``, as .lock-NAME. Raises StorageError."""
    with storing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        with lock(out.with_name(f".lock-{out.name}"), f"which fills {out}"):
            yield


def holder(path: Path) -> str:
    """Who holds the lock, in words."""
    with contextlib.suppress(OSError, ValueError):
        number, host = path.read_text(encoding="utf-8").split()[:2]
        since = time.strftime("%H:%M:%S", time.localtime(path.stat().st_mtime))
        return f"process {int(number)} on {host}, since {since}"
    return "another process"


def _me() -> str:
    return f"{os.getpid()} {socket.gethostname()}\n"


def _acquire(path: Path, what: str, wait: bool) -> Any:
    import filelock

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they say of a fallback, we say ourselves
        try:
            return _wait_for(filelock.FileLock(path, fallback_to_soft=False), path, what, wait)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            reason = error.strerror
        path.unlink(missing_ok=True)
        marker = path.with_name(path.name + MARKER)
        note(
            f"{path.parent}: the file system has no locks ({reason}); marker files take their place. If a process on "
            "another host is killed there, remove its marker by hand."
        )
        try:
            return _wait_for(filelock.SoftFileLock(marker), marker, what, wait)
        except OSError as error:
            raise StorageError(
                f"{path.parent}: neither locks nor marker files can be had here ({error.strerror}), so that two processes "
                "would write over each other. Choose another folder."
            ) from error


def _wait_for(it: Any, path: Path, what: str, wait: bool) -> Any:
    import filelock

    try:
        it.acquire(blocking=False)
        return it
    except filelock.Timeout:
        if not wait:
            return None
    note(f"waiting for {holder(path)}, {what} ({path})", once=False)
    try:
        it.acquire(poll_interval=_POLL_S, cancel_check=lambda: not is_wanted())
    except filelock.Timeout:
        raise MachineError("cancelled", "The run was cancelled while it waited for another process.") from None
    return it


def _is_marker(held: Any) -> bool:
    import filelock

    return isinstance(held, filelock.SoftFileLock)
