"""Efficiency over workers, and what handing out a run costs: asked beside measured.

    python benchmarks/workers.py [--workers 8 64 512] [--seconds 10] [--each 4] [--real 1 2] [--runs 16] [--cell-size-mm 6]
        [--json]

Real: so many simulations (a synthetic atrium, linear cells of --cell-size-mm) on 1 and 2 workers of this machine. Simulated: a
Dask scheduler of its own and workers that are threads of few processes; a run is a stand-in of a known duration that does nothing
but tell its progress once a second, as a real one does. ``lacli`` hands these out by the very code that hands out runs and
patients.

Efficiency is the time that workers spend in runs over their number times the time that all of it takes, from the first run
handed out to the last result; of real runs by their own wall time, so that who else uses the machine does not count. The
overhead of a run is what is left over, per run; beside it the CPU time that scheduler and client spend on a run, which a
crowded machine does not change much: simulated workers, scheduler and client share the cores of this one. Asked: efficiency
at least 0.9. Exit code 1 where it is not.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from lacli.cli.terminal.console import print_json, print_table
from lacli.contracts.bundle import save
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import build_scene
from lacli.mechanics.execute import run_scenes
from lacli.mechanics.places.cluster import tasks_on_cluster
from lacli.synthetic.atrium import synthesize

ASKED = 0.9
PROCESSES = 4  # of simulated workers at most: more would only fill the memory
_PROGRESS_EVERY_S = 1.0
_JOIN_S = 120.0


def row(kind: str, workers: int, runs: int, busy_s: float, wall_s: float) -> dict[str, Any]:
    """Efficiency and the overhead of a run (s), from the time spent in runs and that of all of it."""
    return {
        "kind": kind, "workers": workers, "runs": runs, "run_s": busy_s / runs, "wall_s": wall_s,
        "efficiency": busy_s / (workers * wall_s), "overhead_s": (workers * wall_s - busy_s) / runs,
        "scheduler_cpu_s": None, "client_cpu_s": None,
    }  # fmt: skip


def stand_in(report: Callable[[Any], None], wanted: Callable[[], bool], seconds: float) -> tuple[str, Any]:
    """A run that does nothing, and tells how far it is."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        time.sleep(min(left, _PROGRESS_EVERY_S))
        report({"left_s": left})
    return "result", seconds


def simulated(workers: int, each: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Stand-ins on a cluster of its own."""
    processes = min(workers, PROCESSES)
    file = folder / f"scheduler-{workers}.json"
    common = ["--scheduler-file", str(file), "--host", "127.0.0.1", "--no-dashboard"]
    words = [["scheduler", "--port", "0", *common]]
    threads = [str(workers // processes + (k < workers % processes)) for k in range(processes)]
    words += [["worker", "--no-nanny", "--nthreads", n, "--local-directory", str(folder), *common] for n in threads]
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with_environment = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__WORKER_SATURATION": "1.0"}  # as the README says
    started = [subprocess.Popen([sys.executable, "-m", "dask", *w], env=with_environment, **quiet) for w in words]
    try:
        until = time.monotonic() + _JOIN_S
        while not file.is_file() and time.monotonic() < until:
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        joined(address, workers)
        tasks = [(seconds,)] * (workers * each)
        scheduler = psutil.Process(started[0].pid)
        before, own = sum(scheduler.cpu_times()[:2]), time.process_time()
        begin = time.monotonic()
        done = list(tasks_on_cluster(stand_in, tasks, address, lambda *_: None, lambda *_: None, lambda: None))
        wall = time.monotonic() - begin
        cpu = (sum(scheduler.cpu_times()[:2]) - before, time.process_time() - own)
    finally:
        for process in started:
            process.kill()  # nothing of theirs is wanted any more
        for process in started:
            process.wait()
    if len(done) != len(tasks):
        raise SystemExit(f"{len(done)} of {len(tasks)} stand-ins came back")
    spent = dict(zip(("scheduler_cpu_s", "client_cpu_s"), (s / len(tasks) for s in cpu), strict=True))
    return {**row("simulated", workers, len(tasks), seconds * len(tasks), wall), **spent}


def joined(address: str, workers: int) -> None:
    """Wait until all workers' threads are there."""
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        until = time.monotonic() + _JOIN_S
        while sum(client.nthreads().values()) < workers:
            if time.monotonic() > until:
                raise SystemExit(f"only {client.nthreads()} joined")
            time.sleep(0.05)


def real(workers: int, runs: int, cell_size_mm: float, folder: Path) -> dict[str, Any]:
    """Simulations on this machine's workers."""
    bundle = folder / "bundle"
    if not bundle.is_dir():
        made, motion = synthesize(1, cell_size_mm=cell_size_mm, order=1)
        save(made, bundle)
        save_motion(motion, bundle)
    document = {"anatomy": {"bundle": str(bundle)}, "numerics": {"order": 1}}
    alphas = np.linspace(0.8, 2.4, runs).tolist()
    scenes = [build_scene(document, [f"materials.alpha={a}"], folder=folder, where="workers") for a in alphas]
    begin = time.monotonic()
    found = [result for _, result in run_scenes(scenes, folder / f"runs-{workers}", workers=workers)]
    wall = time.monotonic() - begin
    if failed := [result.message for result in found if result.status != "done"]:
        raise SystemExit(f"{len(failed)} of {runs} runs failed: {failed[0]}")
    return row("real", workers, runs, sum(float(result.manifest["wall_s"]) for result in found), wall)


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="*", default=[8, 64, 512], help="simulated")
    parser.add_argument("--seconds", type=float, default=10.0, help="a stand-in's duration")
    parser.add_argument("--each", type=int, default=4, help="stand-ins a worker")
    parser.add_argument("--real", type=int, nargs="*", default=[1, 2], help="workers of this machine")
    parser.add_argument("--runs", type=int, default=16, help="real simulations")
    parser.add_argument("--cell-size-mm", type=float, default=6.0, help="of the real simulations")
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        rows = [real(count, choice.runs, choice.cell_size_mm, Path(place)) for count in choice.real]
        rows += [simulated(count, choice.each, choice.seconds, Path(place)) for count in choice.workers]
    if choice.json:
        print_json(rows)
    else:
        columns = list(rows[0]) if rows else []
        load = os.getloadavg()[0]
        title = f"efficiency over workers, asked at least {ASKED} (load {load:.1f})"
        print_table(title, columns, [["" if v is None else v for v in r.values()] for r in rows])
    return 0 if all(r["efficiency"] >= ASKED for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
