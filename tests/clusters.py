"""Clusters of real processes that a test starts for itself: Dask on 127.0.0.1, and a SLURM of a single node."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "sinfo")


def no_slurm() -> str:
    """Why SLURM cannot be started here; '' where it can."""
    if not all(map(shutil.which, PROGRAMS)):
        return "needs SLURM: apt-get install slurm-wlm munge"
    return "" if os.geteuid() == 0 else "starting SLURM needs root"


def wait_for(condition: Callable[[], object], seconds: float = 30) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


class Cluster:
    """A scheduler and workers, each a process of its own with its nanny, on 127.0.0.1; they import from ``modules`` too."""

    def __init__(self, folder: Path, workers: int, modules: Sequence[Path] = ()) -> None:
        self.folder = folder
        paths = [*modules, *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
        self.environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(path) for path in paths if path)}
        self.scheduler = self.start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        wait_for(self.file.is_file, 60)
        self.nannies = [self.start("worker", "--nthreads", "1", "--no-dashboard") for _ in range(workers)]
        self.address = f"tcp://127.0.0.1:{self._port()}"
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=60)

    @property
    def file(self) -> Path:
        return self.folder / "scheduler.json"

    def _port(self) -> int:
        return int(json.loads(self.file.read_text())["address"].rsplit(":", 1)[1])

    def start(self, what: str, *options: str) -> psutil.Popen:
        command = [sys.executable, "-m", "dask", what, "--scheduler-file", str(self.file), *options]
        if what == "worker":
            command += ["--host", "127.0.0.1", "--local-directory", str(self.folder)]
        log = (self.folder / f"{what}.log").open("ab")
        with log:
            return psutil.Popen(command, env=self.environment, stdout=log, stderr=log, start_new_session=True)

    def stop(self) -> None:
        for process in [*self.nannies, self.scheduler]:
            with suppress(psutil.Error):
                for one in [*process.children(recursive=True), process]:
                    with suppress(psutil.Error):
                        one.kill()
            process.wait(10)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def slurm_node(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """One node that is controller and worker at once, on 127.0.0.1, with a key and ports of its own."""
    host = socket.gethostname().split(".")[0]
    for name in ("state", "spool", "munge"):
        (folder / name).mkdir(mode=0o755)
    key, door = folder / "munge" / "key", folder / "munge" / "socket"
    key.write_bytes(os.urandom(128))
    key.chmod(0o400)
    settings = {
        "ClusterName": "test", "SlurmctldHost": f"{host}(127.0.0.1)", "SlurmUser": "root", "SlurmdUser": "root",
        "AuthType": "auth/munge", "AuthInfo": f"socket={door}", "CredType": "cred/munge",
        "ProctrackType": "proctrack/linuxproc", "TaskPlugin": "task/none", "MpiDefault": "none",
        "SelectType": "select/cons_tres", "SelectTypeParameters": "CR_Core", "ReturnToService": "2",
        "StateSaveLocation": folder / "state", "SlurmdSpoolDir": folder / "spool",
        "SlurmctldPidFile": folder / "slurmctld.pid", "SlurmdPidFile": folder / "slurmd.pid",
        "SlurmctldLogFile": folder / "slurmctld.log", "SlurmdLogFile": folder / "slurmd.log",
        "SlurmctldPort": free_port(), "SlurmdPort": free_port(),
    }  # fmt: skip
    lines = [f"{name}={value}" for name, value in settings.items()]
    lines += [f"NodeName={host} NodeAddr=127.0.0.1 CPUs={os.cpu_count()} RealMemory=1000 State=UNKNOWN"]
    lines += ["PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP"]
    (folder / "slurm.conf").write_text("\n".join(lines) + "\n")
    monkeypatch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
    munge = ["munged", "--foreground", "--force", f"--key-file={key}", f"--socket={door}"]
    munge += [f"--{word}-file={folder / 'munge' / word}" for word in ("pid", "log", "seed")]
    daemons: list[subprocess.Popen[bytes]] = []
    try:
        for command in (munge, ["slurmctld", "-D"], ["slurmd", "-D"]):
            with (folder / f"{command[0]}.out").open("wb") as log:
                daemons.append(subprocess.Popen(command, stdout=log, stderr=log))
            time.sleep(0.5)
        end = time.monotonic() + 30
        while not any(word in said(["sinfo", "-h", "-o", "%T"]) for word in ("idle", "mixed", "alloc")):
            assert time.monotonic() < end, "".join(file.read_text() for file in folder.glob("*.log"))
            time.sleep(0.2)
        yield
    finally:
        said(["scancel", "-u", "root"])
        for daemon in reversed(daemons):
            daemon.send_signal(signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                daemon.wait(10)
            daemon.kill()
            daemon.wait()


def said(command: list[str]) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=30).stdout
