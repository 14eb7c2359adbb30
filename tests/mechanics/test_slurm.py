"""Runs on SLURM: a single-node cluster of this test's own, its workers started by dask-jobqueue."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from clusters import no_slurm, said, slurm_node
from test_cluster import busy, scenes

from lacli.contracts.scene import Scene
from lacli.mechanics.execute import run_scenes

SceneOf = Callable[..., Scene]
HERE = Path(__file__).parent
pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("dask_jobqueue") is None, reason="needs the extra 'cluster'"),
    pytest.mark.skipif(bool(no_slurm()), reason=no_slurm()),
]


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with slurm_node(tmp_path, monkeypatch):
        yield tmp_path


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
        job_script_prologue=[f"export PYTHONPATH={HERE}:{HERE.parent}:$PYTHONPATH"],
        scheduler_options={"dashboard": False, "dashboard_address": ":0", "interface": "lo"},
    ) as cluster:
        cluster.scale(jobs=1)
        results = dict(run_scenes(scenes(scene_of, 0.01, 0.02), root, scheduler=cluster.scheduler_address, task=busy))
        jobs = said(["squeue", "-h", "-o", "%j"]).split()
    assert {index: result.status for index, result in results.items()} == {0: "done", 1: "done"}
    assert jobs == ["dask-worker"]
