"""Runs, and other tasks, on the workers of a Dask cluster, which see the same folders.

Whoever is lost, nothing is: the run of a lost worker goes to another one; a lost scheduler, or a client that is gone,
ends what runs (FreeFEM on the workers included, within seconds), and the same command goes on from what is finished.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from lacli.base.errors import LacliError, UsageError
from lacli.base.notes import note, slow
from lacli.base.processes.process import while_wanted
from lacli.contracts.scene import Scene
from lacli.mechanics.places.trials import Trials
from lacli.mechanics.places.worker import done, reporter, run_scene_of_lacli

if TYPE_CHECKING:
    from lacli.mechanics.simulation import RunResult

_CONNECT_S = 30
_LOOK_EVERY_S = 1.0
_FAREWELL_S = 2
_PROGRESS_EVERY_S = 1.0
_LOST = (
    "The connection to the Dask scheduler at {} is lost. What was finished is kept; start a scheduler with workers and run "
    "the same command again."
)


# what does a task on a worker: (report, wanted, *arguments) -> ("result", content), ("ended", (kind, message, MB)) or
# ("error", exception)
Body = Callable[..., tuple[str, Any]]


def on_cluster(
    scenes: Sequence[Scene],
    root: Path,
    on_progress: Callable[[int, Any], None] | None,
    scheduler: str,
    task: Callable[..., RunResult] | None,
) -> Iterator[tuple[int, RunResult]]:
    """Run all scenes; yield (index, result) as they finish. Raises UsageError where no scheduler answers."""
    at = root.resolve()
    return tasks_on_cluster(
        _run, [(task, scene, at) for scene in scenes], scheduler, Trials(scenes, at).ended, on_progress, lambda: None
    )


def tasks_on_cluster(
    body: Body,
    tasks: Sequence[tuple[Any, ...]],
    scheduler: str,
    ended: Callable[..., Any],
    on_progress: Callable[[int, Any], None] | None,
    look: Callable[[], None],
) -> Iterator[tuple[int, Any]]:
    """Do ``body`` for the arguments of each task; yield (index, result) as they finish.

    ended(index, kind, message, MB, last): the machine ended a task; gives its result, or None where it shall be tried again.
    look: called about each second while we wait; may raise. Raises UsageError where no scheduler answers, LacliError where it
    is lost; what runs is then ended.
    """
    try:
        import distributed  # noqa: F401  (it sets its loggers' levels)
    except ImportError as error:
        raise UsageError("Dask is not installed: pip install 'lacli[cluster]', here and on the workers.") from error
    with _quiet():
        client = _connect(scheduler)
        try:
            yield from _series(client, body, tasks, ended, on_progress, look, scheduler)
        finally:
            with contextlib.suppress(Exception):
                client.close(timeout=_FAREWELL_S)


def _connect(scheduler: str) -> Any:
    from distributed import Client

    with warnings.catch_warnings(record=True) as said, slow(f"connecting to the Dask scheduler at {scheduler}"):
        warnings.simplefilter("always")
        try:
            client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
            threads = client.nthreads()
        except (OSError, TimeoutError, ValueError) as error:
            raise UsageError(f"no Dask scheduler answers at {scheduler} ({error}).") from error
    if said:
        words = next((line for line in str(said[0].message).splitlines() if line.strip()), "")
        note(f"Dask warns: {words}")
    if threads:
        note(f"Dask at {scheduler}: {len(threads)} workers, {sum(threads.values())} simulations side by side")
    else:
        note(f"Dask at {scheduler}: no worker has joined yet; waiting for one")
    return client


def _series(
    client: Any,
    body: Body,
    tasks: Sequence[tuple[Any, ...]],
    ended: Callable[..., Any],
    on_progress: Callable[[int, Any], None] | None,
    look: Callable[[], None],
    scheduler: str,
) -> Iterator[tuple[int, Any]]:
    events: SimpleQueue[tuple[str, int, Any]] = SimpleQueue()
    topic = f"lacli-{uuid4().hex}"
    running: dict[int, Any] = {}

    def submit(*indices: int) -> None:
        # at once: of many that wait for nothing Dask then keeps those that no thread is free for, instead of giving them out
        which = [tasks[index] for index in indices]
        futures = client.map(partial(_on_worker, body, topic), which, indices, pure=False, batch_size=None)
        for index, future in zip(indices, futures, strict=True):
            future.add_done_callback(lambda settled, index=index: events.put(("done", index, settled)))
            running[index] = future

    client.subscribe_topic(topic, lambda event: events.put(("progress", *_unpacked(event[1]))))
    try:
        submit(*range(len(tasks)))
        looked = time.monotonic()
        while running:
            if time.monotonic() - looked > _LOOK_EVERY_S:
                looked = time.monotonic()
                look()
            try:
                kind, index, content = events.get(timeout=_LOOK_EVERY_S)
            except Empty:
                if client.status != "running":
                    raise LacliError(_LOST.format(scheduler)) from None
                continue
            if kind == "progress":
                if on_progress is not None and index in running:
                    on_progress(index, content)
                continue
            del running[index]
            if client.status != "running":
                raise LacliError(_LOST.format(scheduler))
            word, message = _outcome(content)
            if word == "error":
                raise message
            if word == "result":
                yield index, message
                continue
            given_up = ended(index, *message)
            if given_up is None:
                submit(index)
            else:
                yield index, given_up
    finally:
        with contextlib.suppress(Exception):
            if running and client.status == "running":
                client.cancel(list(running.values()), force=True)


def _outcome(future: Any) -> tuple[str, Any]:
    """Word and content as a worker process sends them."""
    from distributed.scheduler import KilledWorker

    if future.status == "finished":
        try:
            return future.result(timeout=_CONNECT_S)
        except (TimeoutError, asyncio.CancelledError):  # it died between its last word and our question
            future.cancel()
            return "ended", ("lost_worker", "The worker that had done it is gone, and its answer with it.")
    if future.status != "error":
        return "ended", ("cancelled", f"The cluster cancelled it ({future.status}).")
    error = future.exception(timeout=_CONNECT_S)
    if isinstance(error, KilledWorker):
        words = (
            f"{error.allowed_failures + 1} workers died while they did it, the last at {error.last_worker.address}. Their "
            "logs say why; where memory was not enough, start them with more (dask worker --memory-limit) or fewer threads."
        )
        return "ended", ("lost_worker", words, 0.0, True)
    if isinstance(error, ImportError):
        return "error", UsageError(f"the Dask workers cannot do it ({error}): install the same lacli there as here.")
    return "error", error


def _on_worker(body: Body, topic: str, arguments: tuple[Any, ...], index: int) -> tuple[str, Any]:
    """A task, in a thread of a worker; it is told when it is no longer wanted or the worker closes."""
    from distributed import Status, get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def wanted() -> bool:
        state = worker.state.tasks.get(key)
        return worker.status in (Status.running, Status.paused) and state is not None and state.state != "cancelled"

    def send(event: Any) -> None:
        with contextlib.suppress(Exception):  # progress is a courtesy
            worker.log_event(topic, _packed(index, event))

    return body(send, wanted, *arguments)


def _run(
    report: Callable[[Any], None], wanted: Callable[[], bool], task: Callable[..., RunResult] | None, scene: Scene, root: Path
) -> tuple[str, Any]:
    """A run; FreeFEM is ended when it is no longer wanted."""
    with while_wanted(wanted):
        return done(task or run_scene_of_lacli(), scene, root, reporter(report, _PROGRESS_EVERY_S))


def _packed(index: int, event: Any) -> dict[str, Any]:
    """An event as a message that Dask can send: a dict, or the fields of an object."""
    return {"index": index, "fields": event} if isinstance(event, dict) else {"index": index, "object": vars(event)}


def _unpacked(message: dict[str, Any]) -> tuple[int, Any]:
    return message["index"], message["fields"] if "fields" in message else SimpleNamespace(**message["object"])


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """What Dask logs of lost connections is told in one message of ours."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in ("distributed", "tornado", "asyncio")]
    loggers = [logging.getLogger(name) for name in {*names, "distributed", "tornado", "asyncio"}]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
