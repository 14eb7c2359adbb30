"""A study on SLURM: workers of a Dask cluster as jobs, or a plain array for sites that forbid long-lived schedulers.

Either way a patient is a task, and gets the cores and the memory that the settings say.
"""

from __future__ import annotations

import contextlib
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lacli.base.errors import UsageError
from lacli.cohort.steps import Settings

_DEFAULTS = {"time": "48:00:00", "memory": "8G", "cpus": 4}


def array_script(program: str, call: Sequence[str], identifiers: Sequence[str], settings: Settings, logs: Path) -> str:
    """The batch script. program: Python with lacli in it; call: the arguments of ``lacli cohort`` without --only.

    identifiers and settings were checked: they hold nothing that a shell takes for its own.
    """
    chosen = {**_DEFAULTS, **settings.slurm}
    limit = f"%{chosen['limit']}" if "limit" in chosen else ""
    lines = [
        "#!/bin/bash",
        "#SBATCH --job-name=lacli-cohort",
        f"#SBATCH --array=0-{len(identifiers) - 1}{limit}",
        f"#SBATCH --time={chosen['time']}",
        f"#SBATCH --mem={chosen['memory']}",
        f"#SBATCH --cpus-per-task={chosen['cpus']}",
        f"#SBATCH --output={logs}/%A_%a.out",
    ]
    lines += [f"#SBATCH --{name}={chosen[name]}" for name in ("account", "partition") if name in chosen]
    lines += ["set -euo pipefail"]
    lines += _module_lines(chosen)
    lines += [
        f"patients=({' '.join(identifiers)})",
        f'{shlex.join([program, "-m", "lacli", *call])} --only "${{patients[$SLURM_ARRAY_TASK_ID]}}"',
    ]
    return "\n".join(lines) + "\n"


@contextlib.contextmanager
def workers(settings: Settings, logs: Path) -> Iterator[tuple[str, Callable[[int], None]]]:
    """A Dask scheduler in this process, and jobs that are its workers: its address, and ``keep(n)``, which asks for n jobs.

    A job that is gone is asked for again at the next ``keep``; one that has nothing to do is ended where fewer are wanted; all
    are ended with the block. logs: folder of what the jobs say. Raises UsageError where SLURM or dask-jobqueue is not there.
    """
    if shutil.which("sbatch") is None:
        raise UsageError("--slurm: there is no sbatch here; call it where SLURM's commands are, or write a script elsewhere.")
    try:
        import dask
        from dask_jobqueue import SLURMCluster
    except ImportError as error:
        raise UsageError("--slurm needs dask-jobqueue: pip install 'lacli[cluster]'.") from error
    chosen = {**_DEFAULTS, **settings.slurm}
    interface = {"interface": chosen["interface"]} if "interface" in chosen else {}
    # a worker that has a task has enough: one that waits behind a long one would idle another worker
    with dask.config.set({"distributed.scheduler.worker-saturation": 1.0}):
        cluster = SLURMCluster(
            cores=1,  # a patient at a time in a job
            processes=1,
            job_cpu=int(chosen["cpus"]),
            memory=str(chosen["memory"]),
            walltime=str(chosen["time"]),
            account=chosen.get("account"),
            queue=chosen.get("partition"),
            job_name="lacli-cohort",
            python=sys.executable,
            log_directory=str(logs),
            local_directory=str(logs),
            job_script_prologue=_module_lines(chosen),
            scheduler_options={"dashboard": False, "dashboard_address": ":0", **interface},
            **interface,
        )
    with cluster:

        def keep(count: int) -> None:
            cluster.scale(jobs=min(count, int(chosen.get("limit", count))))

        yield cluster.scheduler_address, keep


def _module_lines(chosen: dict[str, Any]) -> list[str]:
    modules = chosen.get("modules", [])
    return [f"module load {shlex.quote(str(m))}" for m in (modules if isinstance(modules, list) else [modules])]
