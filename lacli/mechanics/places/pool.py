"""Runs side by side on this machine, each in a worker process that ends with lacli."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.errors import LacliError
from lacli.base.notes import note
from lacli.base.processes.machine import family_mb, memory_mb
from lacli.base.processes.process import mortal
from lacli.base.processes.signals import held
from lacli.contracts.scene import Scene
from lacli.mechanics.places.trials import Trials

if TYPE_CHECKING:
    from lacli.mechanics.simulation import RunResult

FIRST_GUESS_MB = 1000.0  # of one simulation, until one has been seen
_LAST_WORDS_S = 10.0
_LOOK_EVERY_S = 1.0


@dataclass
class Worker:
    """A worker process: the scene it does (None: idle), whether it has come up, memory it was seen to take (MB)."""

    process: subprocess.Popen[bytes]
    pipe: Connection
    index: int | None = None
    ready: bool = False
    peak_mb: float = 0.0

    def give(self, index: int, scene: Scene, root: Path) -> None:
        self.index, self.peak_mb = index, 0.0
        with contextlib.suppress(OSError):  # it has died: that is noticed where its answer is waited for
            self.pipe.send((index, scene, root))


def side_by_side(
    scenes: Sequence[Scene],
    root: Path,
    on_progress: Callable[[int, Any], None] | None,
    count: int,
    task: Callable[..., RunResult] | None,
) -> Iterator[tuple[int, RunResult]]:
    """Run all scenes, at most ``count`` beside each other; yield (index, result) as they finish."""
    waiting = deque(range(len(scenes)))
    trials = Trials(scenes, root)
    largest_mb = 0.0
    crew: list[Worker] = []
    wanted = max(1, min(count, len(scenes)))
    try:
        while waiting or any(worker.index is not None for worker in crew):
            while waiting and may_start(crew, wanted, largest_mb, waiting[0], trials.alone):
                worker = next((w for w in crew if w.index is None), None) or _hire(crew, task)
                index = waiting.popleft()
                worker.give(index, scenes[index], root)
            for worker in _that_spoke(crew):
                try:
                    word, index, content = worker.pipe.recv()
                except (EOFError, OSError):
                    crew.remove(worker)
                    word, index, content = _obituary(worker)
                if word == "ready":
                    worker.ready = True
                elif word == "note":
                    note(content)
                elif word == "progress":
                    if on_progress is not None:
                        on_progress(index, content)
                elif word == "error":
                    raise content
                elif word == "result":
                    worker.index = None
                    largest_mb = max(largest_mb, float(content.manifest.get("peak_memory_mb") or 0))
                    yield index, content
                elif word == "ended":
                    worker.index = None
                    given_up = trials.ended(index, *content)
                    if given_up is None:
                        waiting.appendleft(index)
                    else:
                        yield index, given_up
    finally:
        _dismiss(crew)


def may_start(crew: Sequence[Worker], wanted: int, largest_mb: float, index: int, alone: set[int]) -> bool:
    """Whether run ``index`` may begin: a place is free, and memory for what the largest so far took; ``alone``: no others."""
    running = [worker.index for worker in crew if worker.index is not None]
    if not running:
        return True
    if index in alone or alone.intersection(running):
        return False
    return len(running) < wanted and memory_mb()[1] > 1.2 * (largest_mb or FIRST_GUESS_MB)


def _that_spoke(crew: list[Worker]) -> list[Worker]:
    # the time-out lets memory that others have freed be seen
    ready = wait([worker.pipe for worker in crew], timeout=_LOOK_EVERY_S)
    for worker in crew:
        if worker.index is not None:
            worker.peak_mb = max(worker.peak_mb, family_mb(worker.process.pid))
    return [worker for worker in crew if worker.pipe in ready]


def _hire(crew: list[Worker], task: Callable[..., RunResult] | None) -> Worker:
    ours, theirs = Pipe()
    command = [sys.executable, "-m", "lacli.mechanics.places.worker", str(theirs.fileno())]
    # a Ctrl-C while the worker still imports would be a traceback: it inherits that signals wait
    with held():
        process = subprocess.Popen(mortal(command), stdin=subprocess.DEVNULL, pass_fds=(theirs.fileno(),), start_new_session=True)
    theirs.close()
    worker = Worker(process, ours)
    crew.append(worker)
    with contextlib.suppress(OSError):
        ours.send(sys.path)
        ours.send(task)
    return worker


def _obituary(worker: Worker) -> tuple[str, Any, Any]:
    """The message of a worker that cannot send one any more."""
    worker.pipe.close()
    code = worker.process.wait()
    if code >= 0:
        return "error", worker.index, LacliError(f"A worker process ended by itself with code {code}; what it said is above.")
    if worker.index is None:
        return "note", None, f"An idle worker was killed from outside ({signal.Signals(-code).name})."
    message = f"Its process was killed from outside ({signal.Signals(-code).name}; no memory left?)."
    return "ended", worker.index, ("killed", message, worker.peak_mb)


def _dismiss(crew: list[Worker]) -> None:
    """End all workers; those at work get Ctrl-C, so that they end FreeFEM and clean up, and then little patience."""
    for worker in crew:
        # it may have said so since it was last listened to: then it is at work, and has something to clean up
        with contextlib.suppress(EOFError, OSError):
            while not worker.ready and worker.pipe.poll():
                worker.ready = worker.pipe.recv()[0] == "ready"
        if worker.index is not None and worker.ready:
            worker.process.send_signal(signal.SIGINT)
        else:
            worker.process.kill()  # it has nothing to clean up, and an interpreter takes a third of a second to end by itself
        worker.pipe.close()
    end = time.monotonic() + _LAST_WORDS_S
    for worker in crew:
        try:
            worker.process.wait(max(0.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            worker.process.kill()
            worker.process.wait()
