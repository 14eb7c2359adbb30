"""Runs on SLURM: a single-node cluster of this test's own, its workers started by dask-jobqueue."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from test_cluster import busy, scenes

from lacli.contracts.scene import Scene
from lacli.mechanics.execute import run_scenes

SceneOf = Callable[..., Scene]
HERE = Path(__file__).parent
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "sinfo")
pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("dask_jobqueue") is None, reason="needs the extra 'cluster'"),
    pytest.mark.skipif(not all(map(shutil.which, PROGRAMS)), reason="needs SLURM: apt-get install slurm-wlm munge"),
    pytest.mark.skipif(os.geteuid() != 0, reason="starting SLURM needs root"),
]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """One node that is controller and worker at once, on 127.0.0.1, with a key and ports of its own."""
    host = socket.gethostname().split(".")[0]
    for name in ("state", "spool", "munge"):
        (tmp_path / name).mkdir(mode=0o755)
    key, door = tmp_path / "munge" / "key", tmp_path / "munge" / "socket"
    key.write_bytes(os.urandom(128))
    key.chmod(0o400)
    settings = {
        "ClusterName": "test", "SlurmctldHost": f"{host}(127.0.0.1)", "SlurmUser": "root", "SlurmdUser": "root",
        "AuthType": "auth/munge", "AuthInfo": f"socket={door}", "CredType": "cred/munge",
        "ProctrackType": "proctrack/linuxproc", "TaskPlugin": "task/none", "MpiDefault": "none",
        "SelectType": "select/cons_tres", "SelectTypeParameters": "CR_Core", "ReturnToService": "2",
        "StateSaveLocation": tmp_path / "state", "SlurmdSpoolDir": tmp_path / "spool",
        "SlurmctldPidFile": tmp_path / "slurmctld.pid", "SlurmdPidFile": tmp_path / "slurmd.pid",
        "SlurmctldLogFile": tmp_path / "slurmctld.log", "SlurmdLogFile": tmp_path / "slurmd.log",
        "SlurmctldPort": free_port(), "SlurmdPort": free_port(),
    }  # fmt: skip
    lines = [f"{name}={value}" for name, value in settings.items()]
    lines += [f"NodeName={host} NodeAddr=127.0.0.1 CPUs={os.cpu_count()} RealMemory=1000 State=UNKNOWN"]
    lines += ["PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP"]
    (tmp_path / "slurm.conf").write_text("\n".join(lines) + "\n")
    monkeypatch.setenv("SLURM_CONF", str(tmp_path / "slurm.conf"))
    munge = ["munged", "--foreground", "--force", f"--key-file={key}", f"--socket={door}"]
    munge += [f"--{word}-file={tmp_path / 'munge' / word}" for word in ("pid", "log", "seed")]
    daemons: list[subprocess.Popen[bytes]] = []
    try:
        for command in (munge, ["slurmctld", "-D"], ["slurmd", "-D"]):
            with (tmp_path / f"{command[0]}.out").open("wb") as log:
                daemons.append(subprocess.Popen(command, stdout=log, stderr=log))
            time.sleep(0.5)
        end = time.monotonic() + 30
        while not any(word in said(["sinfo", "-h", "-o", "%T"]) for word in ("idle", "mixed", "alloc")):
            assert time.monotonic() < end, "".join(file.read_text() for file in tmp_path.glob("*.log"))
            time.sleep(0.2)
        yield tmp_path
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


def test_runs_on_slurm(slurm: Path, scene_of: SceneOf) -> None:
    from dask_jobqueue import SLURMCluster

    root = slurm / "runs"
    with SLURMCluster(
        cores=1,
        memory="500MB",
        interface="lo",
        python=sys.executable,
        log_directory=str(slurm),
        local_directory=str(slurm),
        job_script_prologue=[f"export PYTHONPATH={HERE}"],
        scheduler_options={"dashboard": False, "dashboard_address": ":0", "interface": "lo"},
    ) as cluster:
        cluster.scale(jobs=1)
        results = dict(run_scenes(scenes(scene_of, 0.01, 0.02), root, scheduler=cluster.scheduler_address, task=busy))
        jobs = said(["squeue", "-h", "-o", "%j"]).split()
    assert {index: result.status for index, result in results.items()} == {0: "done", 1: "done"}
    assert jobs == ["dask-worker"]
