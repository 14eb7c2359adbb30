"""Runs on a Dask cluster of real processes: whoever is killed, no run is lost, one message says so, and nothing runs on."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import pytest
from clusters import Cluster, wait_for

from lacli.base.errors import LacliError, StorageError, UsageError
from lacli.base.processes.process import supervise
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene, dump_scene
from lacli.mechanics.execute import run_scenes
from lacli.mechanics.places.cluster import _outcome
from lacli.mechanics.store import list_runs, open_run

SceneOf = Callable[..., Scene]
HERE = Path(__file__).parent
pytestmark = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="needs the extra 'cluster'")


@dataclass(frozen=True)
class Result:
    """What a stand-in for run_scene returns."""

    key: str
    folder: Path
    status: str
    kind: str | None = None
    message: str = ""
    features: dict[str, float] = field(default_factory=dict)
    manifest: dict[str, Any] = field(default_factory=dict)


def busy(scene: Scene, root: Path, on_progress: Callable[[Any], None] | None = None) -> Result:
    """A run whose child, in FreeFEM's place, takes 10 s per mmHg of EDP; 1: the disk is full, 2: it takes its worker along."""
    edp = scene.loads.edp_mmhg
    with open_run(root, run_key(scene)) as run:
        if run.stored is None:
            if on_progress is not None:
                on_progress({"load": edp})
            if edp == 1:
                raise StorageError("the disk is full")
            if edp == 2:
                os.kill(os.getpid(), signal.SIGKILL)
            command = ["sleep", f"{10 * edp}"]
            ended = supervise(command, cwd=run.folder, env=os.environ, log=run.folder / "log", timeout_s=100)
            if ended.exit_code == 0:
                run.finish(process=os.getpid())
            else:
                run.finish("failed", kind=ended.cut or "killed", message="ended")
        assert run.stored is not None
        return Result(run.key, run.folder, run.stored.status, run.stored.kind, run.stored.message, {}, run.stored.manifest)


def children_at_work(root: Path) -> list[psutil.Process]:
    """The stand-ins for FreeFEM that run below ``root``."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        with suppress(psutil.Error):
            if (process.info["cmdline"] or [])[:1] == ["sleep"] and Path(process.cwd()).is_relative_to(root):
                found.append(process)
    return found


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    (tmp_path / "cluster").mkdir()
    it = Cluster(tmp_path / "cluster", workers=2, modules=[HERE, HERE.parent])
    try:
        yield it
    finally:
        it.stop()


def scenes(scene_of: SceneOf, *pressures: float) -> list[Scene]:
    return [scene_of(f"loads.edp_mmhg={p}", "loads.esp_mmhg=20") for p in pressures]


def later(condition: Callable[[], object], action: Callable[[], object]) -> threading.Thread:
    """Do ``action`` in a thread as soon as the condition holds."""

    def wait() -> None:
        wait_for(condition, 60)
        action()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def test_same_interface_progress_and_failures(cluster: Cluster, scene_of: SceneOf, tmp_path: Path) -> None:
    seen: list[tuple[int, Any]] = []
    todo = scenes(scene_of, 0.01, 0.02, 0.03)
    root = tmp_path / "runs"
    results = dict(run_scenes(todo, root, lambda i, e: seen.append((i, e)), scheduler=cluster.address, task=busy))
    assert {i: r.status for i, r in results.items()} == {0: "done", 1: "done", 2: "done"}
    assert sorted(seen) == [(0, {"load": 0.01}), (1, {"load": 0.02}), (2, {"load": 0.03})]
    again = dict(run_scenes(todo, root, scheduler=cluster.address, task=busy))
    assert {i: r.manifest["process"] for i, r in again.items()} == {i: r.manifest["process"] for i, r in results.items()}
    with pytest.raises(StorageError, match="the disk is full"):
        list(run_scenes(scenes(scene_of, 1), root, scheduler=cluster.address, task=busy))


@pytest.mark.parametrize("victim", ["worker", "nanny"])
def test_the_run_of_a_lost_worker_goes_elsewhere(cluster: Cluster, victim: str, scene_of: SceneOf, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    killed: list[int] = []

    def kill() -> None:
        worker = children_at_work(root)[0].parent()
        assert worker is not None
        process = worker if victim == "worker" else worker.parent()
        assert process is not None and process.pid != os.getpid()
        killed.append(worker.pid)
        process.kill()

    shot = later(lambda: len(children_at_work(root)) == 2, kill)
    results = dict(run_scenes(scenes(scene_of, 0.5, 0.51, 0.01), root, scheduler=cluster.address, task=busy))
    shot.join()
    assert {i: r.status for i, r in results.items()} == {0: "done", 1: "done", 2: "done"}
    assert all(r.manifest["process"] not in killed for i, r in results.items() if i < 2)
    assert len(list_runs(root)) == 3 and not children_at_work(root)


def test_a_run_that_takes_its_workers_along_is_given_up_and_not_kept(cluster: Cluster, scene_of: SceneOf, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    results = dict(run_scenes(scenes(scene_of, 2, 0.01), root, scheduler=cluster.address, task=busy))
    assert (results[0].status, results[0].kind) == ("failed", "lost_worker")
    assert "4 workers died while they did it" in results[0].message and "--memory-limit" in results[0].message
    assert results[1].status == "done"
    assert [run.key for run in list_runs(root)] == [results[1].key]


def test_a_lost_scheduler_is_one_message_and_nothing_runs_on(cluster: Cluster, scene_of: SceneOf, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    died: list[float] = []

    def kill() -> None:
        cluster.scheduler.kill()
        died.append(time.monotonic())

    later(lambda: len(children_at_work(root)) == 2 and list_runs(root), kill)
    with pytest.raises(LacliError, match=r"connection to the Dask scheduler at tcp://127.0.0.1:.* is lost. What was finished"):
        list(run_scenes(scenes(scene_of, 0.01, 6, 6.1), root, scheduler=cluster.address, task=busy))
    wait_for(lambda: not children_at_work(root), died[0] + 5 - time.monotonic())
    assert len(list_runs(root)) == 1


CLIENT = """
import sys
from pathlib import Path
from lacli.base.processes import signals
from lacli.contracts.scene import load_scene
from lacli.mechanics.execute import run_scenes
from test_cluster import busy
signals.catch()
try:
    overrides = ["loads.esp_mmhg=20"]
    scenes = [load_scene(Path(sys.argv[1]), [f"loads.edp_mmhg={p}", *overrides]) for p in (0.01, 6, 6.1)]
    for index, result in run_scenes(scenes, Path(sys.argv[2]), scheduler=sys.argv[3], task=busy):
        print(index, flush=True)
finally:
    signals.settle()
"""


@pytest.mark.parametrize(("how", "code"), [("SIGKILL", -9), ("SIGINT", 130), ("SIGTERM", 143)])
def test_a_client_that_goes_ends_its_runs(cluster: Cluster, scene_of: SceneOf, tmp_path: Path, how: str, code: int) -> None:
    scene, root = tmp_path / "scene.toml", tmp_path / "runs"
    scene.write_text(dump_scene(scene_of()))
    command = [sys.executable, "-c", CLIENT, str(scene), str(root), cluster.address]
    environment = cluster.environment
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        assert client.stdout is not None
        assert client.stdout.readline() == "0\n"
        wait_for(lambda: len(children_at_work(root)) == 2)
        client.send_signal(signal.Signals[how])
        went = time.monotonic()
        _, said = client.communicate(timeout=20)
    assert client.returncode == code
    said = "\n".join(line for line in said.splitlines() if not line.startswith("Dask at "))
    assert said.count("\n") == 0 and ("run the same command again" in said) == (code > 0), "one message"
    wait_for(lambda: not children_at_work(root), went + 5 - time.monotonic())
    # what was finished is there, the rest is done when asked for again
    assert len(list_runs(root)) == 1
    (result,) = dict(run_scenes(scenes(scene_of, 0.02), root, scheduler=cluster.address, task=busy)).values()
    assert result.status == "done"
    wait_for(lambda: not list(root.glob(".tmp-*")) and not list((root / ".locks").iterdir()), 10)


def test_no_scheduler_is_one_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lacli.mechanics.places import cluster as places

    monkeypatch.setattr(places, "_CONNECT_S", 1)
    with pytest.raises(UsageError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1 "):
        list(run_scenes([], tmp_path, scheduler="tcp://127.0.0.1:1", task=busy))


@pytest.mark.parametrize("error", [TimeoutError("timed out after 30 s."), asyncio.CancelledError()])
def test_an_answer_that_went_with_its_worker_is_asked_for_again(error: BaseException) -> None:
    """A worker dies after it has said that it is done, before its answer is fetched."""

    class Gone:
        status, cancelled = "finished", False

        def result(self, timeout: float) -> None:
            raise error

        def cancel(self) -> None:
            self.cancelled = True

    future = Gone()
    word, (kind, message) = _outcome(future)
    assert (word, kind, future.cancelled) == ("ended", "lost_worker", True) and "gone" in message
