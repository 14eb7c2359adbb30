"""Many scenes: side by side on this machine, or on a Dask cluster. One interface: results as they finish.

``run_scene`` (lacli.mechanics.simulation) does one scene; whatever it stores is found again, so that an interrupted
series, started again, goes on where it was. A simulation that fails is a result. A run that the machine ended (killed, no
memory, a lost worker) is tried again, and given up the third time: its result says so with a kind of the machine
(``lacli.contracts.failures``), and nothing of it is kept. What makes every run fail (FreeFEM missing, disk full, a damaged
bundle) is raised.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.processes.machine import memory_mb
from lacli.contracts.scene import Scene
from lacli.mechanics.places.pool import FIRST_GUESS_MB, side_by_side

if TYPE_CHECKING:
    from lacli.mechanics.simulation import RunResult

# what does a scene: (scene, root, on_progress) -> RunResult
Task = Callable[..., "RunResult"]
OnProgress = Callable[[int, Any], None]


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
        from lacli.mechanics.places.cluster import on_cluster

        return on_cluster(scenes, root, on_progress, scheduler, task)
    return side_by_side(scenes, root, on_progress, workers or default_workers(), task)


def default_workers() -> int:
    """As many simulations side by side as cores and free memory allow, at least one."""
    cores = len(os.sched_getaffinity(0))
    return max(1, min(cores, int(memory_mb()[1] / FIRST_GUESS_MB)))
