"""Where runs happen: side by side on this machine, or on a Dask cluster. One interface: results as they finish.

``run_scene`` (lacli.mechanics.simulation) does one scene; whatever it stores is found again, so that an interrupted
series, started again, goes on where it was. A simulation that fails is a result; what makes every run fail (FreeFEM
missing, disk full, a damaged bundle) is raised.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.errors import LacliError, UsageError
from lacli.base.process import die_with_parent, memory_mb
from lacli.contracts.scene import Scene
from lacli.mechanics.store import open_run

if TYPE_CHECKING:
    from lacli.mechanics.simulation import RunResult

# what does a scene: (scene, root, on_progress) -> RunResult
Task = Callable[..., "RunResult"]
OnProgress = Callable[[int, Any], None]

_FIRST_GUESS_MB = 1000.0  # of one simulation, until one has been seen
_PROGRESS_EVERY_S = 0.2
_LAST_WORDS_S = 5.0


def run_scenes(
    scenes: Sequence[Scene],
    root: Path,
    on_progress: OnProgress | None = None,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    task: Task | None = None,
) -> Iterator[tuple[int, RunResult]]:
    """Run all scenes; yield (index of the scene, result) as they finish.

    workers: simulations side by side (default: as many as cores and memory allow). scheduler: address of a Dask
    scheduler whose workers see ``root``; then ``workers`` is Dask's business. on_progress(index, event) gets what the
    simulations report. task: instead of ``run_scene``. Closing the iterator, or Ctrl-C, ends what is running.
    """
    if scheduler is not None:
        return _on_cluster(scenes, root, on_progress, scheduler, task)
    return _side_by_side(scenes, root, on_progress, workers, task)


def default_workers() -> int:
    """As many simulations side by side as cores and free memory allow, at least one."""
    cores = len(os.sched_getaffinity(0))
    return max(1, min(cores, int(memory_mb()[1] / _FIRST_GUESS_MB)))


def _the_task(task: Task | None) -> Task:
    if task is not None:
        return task
    from lacli.mechanics.simulation import run_scene

    return run_scene


# --- this machine -----------------------------------------------------------------------------------------------------


@dataclass
class _Worker:
    process: multiprocessing.process.BaseProcess
    pipe: Connection
    index: int | None = None  # of the scene it does

    def give(self, index: int, scene: Scene, root: Path) -> None:
        self.index = index
        self.pipe.send((index, scene, root))


def _side_by_side(
    scenes: Sequence[Scene], root: Path, on_progress: OnProgress | None, count: int | None, task: Task | None
) -> Iterator[tuple[int, RunResult]]:
    waiting = deque(range(len(scenes)))
    deaths: dict[int, int] = {}
    largest_mb = 0.0
    crew: list[_Worker] = []
    wanted = max(1, min(count or default_workers(), len(scenes)))
    try:
        while waiting or any(worker.index is not None for worker in crew):
            while waiting and _may_start(crew, wanted, largest_mb):
                worker = next((w for w in crew if w.index is None), None) or _hire(crew, task)
                index = waiting.popleft()
                worker.give(index, scenes[index], root)
            for worker in _that_spoke(crew):
                try:
                    kind, index, content = worker.pipe.recv()
                except (EOFError, OSError):
                    crew.remove(worker)
                    lost = _bury(worker)
                    if lost is None:
                        continue
                    deaths[lost] = deaths.get(lost, 0) + 1
                    if deaths[lost] < 2:
                        waiting.appendleft(lost)
                    else:
                        yield lost, _record_death(scenes[lost], root)
                    continue
                if kind == "progress":
                    if on_progress is not None:
                        on_progress(index, content)
                    continue
                worker.index = None
                if kind == "error":
                    raise content
                largest_mb = max(largest_mb, float(content.manifest.get("peak_memory_mb") or 0))
                yield index, content
    finally:
        _dismiss(crew)


def _may_start(crew: list[_Worker], wanted: int, largest_mb: float) -> bool:
    """Whether one more simulation fits: a place is free, and memory for what the largest so far took."""
    running = sum(worker.index is not None for worker in crew)
    return running == 0 or (running < wanted and memory_mb()[1] > 1.2 * (largest_mb or _FIRST_GUESS_MB))


def _that_spoke(crew: list[_Worker]) -> list[_Worker]:
    # the time-out lets memory that others have freed be seen
    ready = wait([worker.pipe for worker in crew], timeout=1.0)
    return [worker for worker in crew if worker.pipe in ready]


def _hire(crew: list[_Worker], task: Task | None) -> _Worker:
    # spawned, not forked: a fork of a process with threads (progress bars, BLAS) may hang
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, os.getpid(), task), daemon=True)
    # a Ctrl-C while the child still imports would be a traceback: it waits until the child is ready for it
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    theirs.close()
    worker = _Worker(process, ours)
    crew.append(worker)
    return worker


def _work(pipe: Connection, parent: int, task: Task | None) -> None:
    """Body of a worker: scenes in, progress and results out, until the pipe closes."""
    die_with_parent(parent)
    os.setpgid(0, 0)  # Ctrl-C reaches the parent alone, which passes it on once
    with contextlib.suppress(EOFError, BrokenPipeError, KeyboardInterrupt):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        do = _the_task(task)
        while True:
            index, scene, root = pipe.recv()
            try:
                pipe.send(("result", index, do(scene, root, on_progress=_reporter(pipe, index))))
            except Exception as error:
                pipe.send(("error", index, _portable(error)))


def _reporter(pipe: Connection, index: int) -> Callable[[Any], None]:
    last = 0.0

    def report(event: Any) -> None:
        nonlocal last
        if time.monotonic() - last > _PROGRESS_EVERY_S:
            last = time.monotonic()
            pipe.send(("progress", index, event))

    return report


def _portable(error: Exception) -> Exception:
    """An error as the parent shall see it; of a bug, with its traceback in the text."""
    if isinstance(error, LacliError):
        kind = type(error)
        return kind(str(error)) if kind.__init__ is Exception.__init__ else LacliError(str(error))
    import traceback

    return RuntimeError("".join(traceback.format_exception(error)))


def _bury(worker: _Worker) -> int | None:
    worker.pipe.close()
    worker.process.join()
    return worker.index


def _record_death(scene: Scene, root: Path) -> RunResult:
    """A scene whose process was killed twice is a failed run."""
    from lacli.mechanics.simulation import RunResult

    message = "The process of this simulation was killed twice (out of memory?). Run fewer side by side (--workers 1)."
    with open_run(root, scene) as run:
        stored = run.stored or run.finish("failed", kind="killed", message=message)
    return RunResult(
        key=stored.key,
        folder=stored.folder,
        status=stored.status,
        kind=stored.kind,
        message=stored.message,
        features=stored.features(),
        manifest=stored.manifest,
    )


def _dismiss(crew: list[_Worker]) -> None:
    """End all workers; those at work get Ctrl-C, so that they end FreeFEM and clean up, and then little patience."""
    for worker in crew:
        if worker.index is not None and worker.process.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.process.pid, signal.SIGINT)
        worker.pipe.close()
    end = time.monotonic() + _LAST_WORDS_S
    for worker in crew:
        worker.process.join(max(0.0, end - time.monotonic()))
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()


# --- a Dask cluster ---------------------------------------------------------------------------------------------------


def _on_cluster(
    scenes: Sequence[Scene], root: Path, on_progress: OnProgress | None, scheduler: str, task: Task | None
) -> Iterator[tuple[int, RunResult]]:
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise UsageError("Dask is not installed: pip install 'lacli[cluster]', here and on the workers.") from error
    do = _the_task(task)
    try:
        client = Client(scheduler, timeout=30)
    except (OSError, TimeoutError, ValueError) as error:
        raise UsageError(f"no Dask scheduler answers at {scheduler} ({error}).") from error
    with client:
        futures = {client.submit(do, scene, root.resolve(), pure=False): index for index, scene in enumerate(scenes)}
        try:
            for future in as_completed(list(futures)):
                index = futures[future]
                if on_progress is not None:
                    on_progress(index, None)
                yield index, future.result()
        finally:
            client.cancel(list(futures))
