"""Starts a program that ends with the process that wanted it, kill -9 included: launch.py alone|family PARENT PROGRAM ...

Run as a script by a bare interpreter (``python -I -S``), it imports nothing of lacli. ``alone`` becomes the program.
``family`` stays as the leader of its process group and, when its parent ends, kills the whole group: a compiler's own
children do not end with the compiler.
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import sys

_PR_SET_PDEATHSIG = 1
_NOT_FOUND = 127


def end_with(parent: int, how: signal.Signals = signal.SIGKILL) -> None:
    """Ask the kernel for the signal ``how`` when the thread that started this process ends; ``parent`` is its process."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, how, 0, 0, 0)
    if os.getppid() != parent:  # it ended before the call above
        os._exit(_NOT_FOUND)


def _become(command: list[str]) -> None:
    for number in (signal.SIGPIPE, signal.SIGXFSZ):  # which Python ignores, and a program would inherit that
        signal.signal(number, signal.SIG_DFL)
    try:
        os.execvp(command[0], command)
    except OSError as error:
        os.write(2, f"{command[0]}: {error.strerror}\n".encode())
        os._exit(_NOT_FOUND)


def _lead(command: list[str]) -> None:
    leader = os.getpid()
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        end_with(leader)
        _become(command)
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code < 0:  # end as it did
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if -code != signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(leader, -code)
    os._exit(code)


def main() -> None:
    """See the module."""
    way, parent, command = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
    if way == "family":
        signal.signal(signal.SIGTERM, lambda *_: os.killpg(0, signal.SIGKILL))
        end_with(parent, signal.SIGTERM)
        _lead(command)
    end_with(parent)
    _become(command)


if __name__ == "__main__":
    main()
