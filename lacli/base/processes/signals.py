"""Signals that end lacli: Ctrl-C, SIGTERM, SIGHUP. Each unwinds what is running, says so once, and exits with 128 + n."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from types import FrameType, TracebackType
from typing import Any, NoReturn

CAUGHT = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_WORDS = {
    signal.SIGINT: "interrupted",
    signal.SIGTERM: "ended by SIGTERM",
    signal.SIGHUP: "ended by SIGHUP (the terminal was closed)",
}
_KEPT = "What was finished is kept; run the same command again to go on."
_DEAF_S = 2.0  # a call into a library that runs no Python
_CLEANING_S = 15.0  # ending workers takes up to 5 s, a cluster somewhat longer
_AGAIN_S = 0.02


class Stopped(BaseException):
    """Raised in the main thread by a signal of CAUGHT. No Exception, no KeyboardInterrupt: libraries swallow those."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class _State:
    received: int | None = None
    raised: bool = False
    settled: bool = False
    mute: bool = False
    leaving = threading.Lock()  # held by whoever says why, for good


def catch(numbers: Sequence[signal.Signals] = CAUGHT, mute: bool = False) -> None:
    """From here on, in the main thread, signals raise Stopped; those ignored so far (nohup) stay ignored.

    A Stopped that is lost where Python only prints exceptions (``__del__``, weak references, callbacks from C) is raised
    again; what else fails on the way out, there or in threads, is a consequence and not told. Where none can be raised,
    because a library does not come back, the process ends all the same, after 2 s. mute: nothing is said of it, the process
    ends by the signal itself (by SIGKILL where it is deaf): for processes of ours, which we tell of.
    """
    sys.unraisablehook, sys.excepthook, threading.excepthook = _unraisable, _uncaught, _in_thread
    _State.received, _State.raised, _State.settled, _State.mute = None, False, False, mute
    _State.leaving = threading.Lock()
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reader,), name="signals", daemon=True).start()
    signal.signal(signal.SIGALRM, _on_alarm)
    for number in numbers:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _on_signal)


def stopping() -> bool:
    """Whether a signal has come: what fails from then on is its consequence, and not told."""
    return _State.received is not None


def settle() -> None:
    """The command has ended. If a signal was the reason, say so and leave; from here on a signal ends the process at once."""
    _State.settled = True
    if _State.received is not None:
        _leave(_State.received)


def leave(code: int) -> NoReturn:
    """Exit as ``sys.exit`` does, but for the interpreter's last moments, in which a signal would end it without a word."""
    with contextlib.suppress(Exception):
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Signals of CAUGHT wait until the block has ended, in this thread and in what it starts."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, CAUGHT)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _on_signal(number: int, frame: FrameType | None) -> None:
    if _State.leaving.locked():
        return
    if _State.received is None:
        _State.received = number
        if (logging := sys.modules.get("logging")) is not None:
            logging.raiseExceptions = False  # type: ignore[attr-defined]  # a handler that fails now would print where
    if _State.settled:
        _leave(_State.received)
    _raise(frame)


def _on_alarm(number: int, frame: FrameType | None) -> None:
    if _State.received is not None and not _State.settled and not _State.leaving.locked():
        _raise(frame)


def _raise(frame: FrameType | None) -> None:
    """Raise Stopped, but not amid an import: a compiled module that is left half set up crashes without a word."""
    assert _State.received is not None
    if _importing(frame):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        return
    _State.raised = True
    raise Stopped(_State.received)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _unraisable(lost: Any) -> None:
    if isinstance(lost.exc_value, Stopped):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
    elif _State.received is None:
        sys.__unraisablehook__(lost)


def _in_thread(lost: Any) -> None:
    if _State.received is None:
        threading.__excepthook__(lost)


def _uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if isinstance(error, Stopped):
        settle()
    sys.__excepthook__(kind, error, trace)


def _watch(reader: int) -> None:
    """In a thread: the end of a process whose main thread does not react, or does not get done with cleaning up."""
    while (number := os.read(reader, 1)) and number[0] not in CAUGHT:
        pass
    if not number:
        return
    end = time.monotonic() + _DEAF_S
    while time.monotonic() < end and not _State.raised and not _State.settled:
        time.sleep(0.05)
    if _State.raised:
        end = time.monotonic() + _CLEANING_S
        while time.monotonic() < end:
            time.sleep(0.05)
    _leave(_State.received or number[0])


def _leave(number: int) -> NoReturn:
    """Say why, once, and exit without the interpreter's own ways of ending, which wait for threads."""
    if not _State.leaving.acquire(blocking=False):
        time.sleep(_DEAF_S)  # the other thread says it and ends us both
        os._exit(128 + number)
    if _State.mute:
        _end_by(number)
    with contextlib.suppress(OSError, ValueError, RuntimeError):
        sys.stdout.flush()
    with contextlib.suppress(OSError):  # the terminal may be gone
        cursor = b"\x1b[?25h" if os.isatty(2) else b""  # a live display hides it
        os.write(2, cursor + f"lacli: {_WORDS[signal.Signals(number)]}. {_KEPT}\n".encode())
    os._exit(128 + number)


def _end_by(number: int) -> NoReturn:
    """End as whoever sent the signal expects."""
    try:
        signal.signal(number, signal.SIG_DFL)
    except ValueError:  # not the main thread
        number = signal.SIGKILL
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [number])
    os.kill(os.getpid(), number)
    time.sleep(_DEAF_S)
    os._exit(128 + number)
