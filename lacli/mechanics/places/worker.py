"""The process of a worker on this machine: scenes in, results out, until nothing more comes.

``python -m lacli.mechanics.places.worker FILE_DESCRIPTOR``; messages are (word, index of the scene, content): ``ready``,
``note``, ``progress``, ``result``, ``ended`` (by the machine: kind and message) and ``error``.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from lacli.base.errors import MachineError
from lacli.base.processes import signals
from lacli.contracts.failures import of_the_machine
from lacli.mechanics.places.trials import portable

_PROGRESS_EVERY_S = 0.2


class Wire:
    """The connection to lacli; threads may send beside each other."""

    def __init__(self, pipe: Connection) -> None:
        self.pipe, self._sending = pipe, threading.Lock()

    def send(self, word: str, index: int | None, content: Any) -> None:
        with self._sending:
            self.pipe.send((word, index, content))


class _Notes(logging.Handler):
    """What the library tells goes to lacli, which tells it once for all workers."""

    def __init__(self, wire: Wire) -> None:
        super().__init__(logging.WARNING)
        self.wire = wire

    def emit(self, record: logging.LogRecord) -> None:
        with contextlib.suppress(OSError):
            self.wire.send("note", None, record.getMessage())


def done(do: Callable[..., Any], scene: Any, root: Any, report: Callable[[Any], None]) -> tuple[str, Any]:
    """Do one scene: the word of the message to send, and its content."""
    try:
        result = do(scene, root, on_progress=report)
    except MachineError as error:
        return "ended", (error.kind, str(error), 0.0)
    except Exception as error:
        return "error", portable(error)
    if of_the_machine(result.kind):
        return "ended", (result.kind, result.message, float(result.manifest.get("peak_memory_mb") or 0))
    return "result", result


def reporter(send: Callable[[Any], None], every_s: float) -> Callable[[Any], None]:
    """``send``, but no oftener than every so many seconds."""
    last = 0.0

    def report(event: Any) -> None:
        nonlocal last
        if time.monotonic() - last > every_s:
            last = time.monotonic()
            send(event)

    return report


def main() -> None:
    """See the module."""
    try:
        _serve()
    finally:
        # after Ctrl-C it has cleaned up: now it ends as whoever sent the signal expects, so that lacli can tell of it
        signals.settle()


def _serve() -> None:
    wire = Wire(Connection(int(sys.argv[1])))
    logging.getLogger("lacli").addHandler(_Notes(wire))
    logging.getLogger("lacli").propagate = False
    with contextlib.suppress(EOFError, OSError):
        sys.path[:] = wire.pipe.recv()
        do = wire.pipe.recv() or run_scene_of_lacli()
        # Ctrl-C comes from lacli alone, by name, and waits until here
        signals.catch([signal.SIGINT], mute=True)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals.CAUGHT)
        wire.send("ready", None, None)
        while True:
            index, scene, root = wire.pipe.recv()
            report = reporter(functools.partial(wire.send, "progress", index), _PROGRESS_EVERY_S)
            word, content = done(do, scene, root, report)
            wire.send(word, index, content)


def run_scene_of_lacli() -> Callable[..., Any]:
    """The task of a series that names none; imported late, it is heavy."""
    from lacli.mechanics.simulation import run_scene

    return run_scene


if __name__ == "__main__":
    main()
