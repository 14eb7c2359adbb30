"""Shots at a Dask cluster of processes while ``lacli design --scheduler`` runs on it; used by robustness.py.

Asked: no run lost, one message, no FreeFEM 5 s after the shot at scheduler or client, the same table when run again.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
import records
from sameness import rows, same
from shots import CLUSTER, LACLI, MARK, Range, Shooter, Shot, is_victim, marked

CASES = (
    ("worker", "SIGKILL"), ("nanny", "SIGKILL"), ("scheduler", "SIGKILL"),
    ("client", "SIGKILL"), ("client", "SIGINT"), ("client", "SIGTERM"), ("client", "SIGHUP"),
)  # fmt: skip


class Cluster:
    """A scheduler and two workers with nannies on 127.0.0.1, each a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.file = folder, folder / f"scheduler-{uuid.uuid4().hex[:8]}.json"
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        while not self.file.is_file():
            time.sleep(0.05)
        self.nannies = [self._start("worker", "--nthreads", "1", "--no-dashboard") for _ in range(2)]
        self.address = json.loads(self.file.read_text())["address"]

    def _start(self, what: str, *options: str) -> psutil.Popen:
        command = [sys.executable, "-m", "dask", what, "--scheduler-file", str(self.file), *options]
        if what == "worker":
            command += ["--host", "127.0.0.1", "--local-directory", str(self.folder)]
        environment = {**os.environ, MARK: str(self.file), "XDG_CACHE_HOME": str(self.folder / "cache")}
        return psutil.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )

    def solvers(self) -> list[psutil.Process]:
        """FreeFEM on the workers."""
        return [process for process in marked(str(self.file)) if is_victim(process, "FreeFEM")]

    def stop(self) -> None:
        for process in marked(str(self.file)):
            with suppress(psutil.Error):
                process.kill()
        for process in (self.scheduler, *self.nannies):
            process.wait(10)


def command(place: Range, at: Path, cluster: Cluster) -> list[str]:
    options = ["-n", "3", "--input", "c_roof_kpa", "--run", "--json", "--scheduler", cluster.address]
    return [*LACLI, "design", str(place.scene), *options, "--store", f"{at}/runs", "--out", f"{at}/design.csv"]


def cluster_shots(place: Range, count: int, seed: int, tell: Callable[[Shot], None], record: Path | None = None) -> list[Shot]:
    """``count`` shots that landed; a cluster of its own for each; those in ``record`` are not shot again."""
    shooter, expected = Shooter(place, seed), []
    landed = [shot for shot in records.read(record, Shot) if shot.target == CLUSTER]
    todo = range(len(landed), count)
    for victim, how in ((None, ""), *(CASES[number % len(CASES)] for number in todo)) if todo else ():
        at = place.folder / f"cluster-{uuid.uuid4().hex[:8]}"
        at.mkdir()
        cluster = Cluster(place.folder)
        if victim is None:
            subprocess.run(command(place, at, cluster), check=True, capture_output=True)
            expected.append(rows(at))
        else:
            after_s, shot = shooter.chance.uniform(0, 1.5), None
            while shot is None:  # FreeFEM was gone before it could be lost: earlier
                shutil.rmtree(at)
                at.mkdir()
                shot = _shoot(place, at, cluster, victim, how, after_s, expected[0])
                after_s /= 2
            landed.append(shot)
            records.add(record, landed[-1])
            tell(landed[-1])
        cluster.stop()
        shutil.rmtree(at)
    return landed


def _shoot(place: Range, at: Path, cluster: Cluster, victim: str, how: str, after_s: float, expected: object) -> Shot | None:
    """One shot; None where the client ended before."""
    shot = Shot(CLUSTER, victim, how, after_s)
    number = signal.Signals[how]
    with subprocess.Popen(
        command(place, at, cluster), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as client:
        hit = False
        while not hit and client.poll() is None:
            if not (prey := cluster.solvers()):
                time.sleep(0.02)
                continue
            time.sleep(after_s)
            with suppress(psutil.Error):
                if cluster.solvers():
                    worker = prey[0].parent()
                    nanny = worker.parent() if worker else None
                    known = {
                        "worker": worker,
                        "nanny": nanny,
                        "scheduler": cluster.scheduler,
                        "client": psutil.Process(client.pid),
                    }
                    known[victim].send_signal(number)
                    hit = True
        if not hit:
            client.communicate()
            return None
        went = time.monotonic()
        if victim in ("scheduler", "client"):
            while cluster.solvers() and time.monotonic() < went + 5:
                time.sleep(0.05)
            if cluster.solvers():
                shot.faults.append("FreeFEM 5 s later")
        _, said = client.communicate(timeout=900)
    shot.exit_code, shot.said = client.returncode, said.strip()[-300:]
    lines = [line for line in said.splitlines() if line.startswith("lacli:")]
    code = {"scheduler": 1, "client": -number if number == signal.SIGKILL else 128 + number}.get(victim, 0)
    if client.returncode != code:
        shot.faults.append(f"exit code {client.returncode}, not {code}")
    if "Traceback" in said or len(lines) != (code > 0):
        shot.faults.append(f"{len(lines)} messages: {said[-300:]}")
    if victim == "scheduler":
        cluster.stop()
        cluster = Cluster(place.folder)
    again = subprocess.run(command(place, at, cluster), check=False, capture_output=True, text=True)
    if again.returncode != 0 or same(rows(at), expected) == "NO":
        shot.faults.append(f"run again: NOT the same ({again.stderr[-200:]})")
    if victim == "scheduler":
        cluster.stop()
    return shot
