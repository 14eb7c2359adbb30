"""Many scenes: side by side, results as they finish, failures recorded, interruptions clean."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from lacli.base.errors import MachineError, StorageError, UsageError
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene, dump_scene
from lacli.mechanics import execute
from lacli.mechanics.execute import run_scenes
from lacli.mechanics.places import pool
from lacli.mechanics.store import list_runs, open_run

SceneOf = Callable[..., Scene]


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


def stored(scene: Scene, root: Path, on_progress: Callable[[Any], None] | None = None) -> Result:
    """EDP up to 3: waits EDP x 0.1 s, 2.5: until three others have ended; 4: fails; 5: the disk is full; 6: the process is shot;
    7: a bug; 8: hangs; at its first time 9: is shot, 10: has no memory, 11: its FreeFEM is killed when it is tried."""
    edp = scene.loads.edp_mmhg
    with open_run(root, run_key(scene)) as run:
        if run.stored is None:
            first = root / f"first-{edp}"
            if edp > 8 and not first.exists():
                first.touch()
                if edp == 9:
                    os.kill(os.getpid(), signal.SIGKILL)
                if edp == 11:
                    raise MachineError("killed", "FreeFEM was killed when it was tried.")
                run.finish("failed", kind="out_of_memory", message="no memory")
                return Result(run.key, run.folder, "failed", "out_of_memory", "no memory")
            if on_progress is not None:
                on_progress({"load": edp})
            if edp == 4:
                run.finish("failed", kind="inverted_element", message="J < 0")
            elif edp == 5:
                raise StorageError("the disk is full")
            elif edp == 6:
                os.kill(os.getpid(), signal.SIGKILL)
            elif edp == 7:
                raise ZeroDivisionError("a bug")
            else:
                if edp == 2.5:
                    ended = time.monotonic() + 60.0
                    while len(list_runs(root)) < 3 and time.monotonic() < ended:
                        time.sleep(0.05)
                    time.sleep(1.0)  # what the others returned is under way
                time.sleep(60 if edp == 8 else min(edp, 3) * 0.1)
                run.finish(peak_memory_mb=100.0, process=os.getpid())
        assert run.stored is not None
        return Result(run.key, run.folder, run.stored.status, run.stored.kind, manifest=run.stored.manifest)


def scenes(scene_of: SceneOf, *pressures: float) -> list[Scene]:
    return [scene_of(f"loads.edp_mmhg={p}") for p in pressures]


def test_results_come_as_they_finish_and_failures_are_results(scene_of: SceneOf, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    seen: list[tuple[int, Any]] = []
    todo = scenes(scene_of, 2.5, 0.1, 4, 0.2)
    results = list(run_scenes(todo, root, lambda i, e: seen.append((i, e)), workers=2, task=stored))
    assert [index for index, _ in results] == [1, 2, 3, 0]
    assert {i: r.status for i, r in results} == {0: "done", 1: "done", 2: "failed", 3: "done"}
    assert dict(results)[2].kind == "inverted_element"
    assert (0, {"load": 2.5}) in seen
    assert len({r.manifest["process"] for i, r in results if i != 2}) == 2, "two workers, used again"
    assert len(list_runs(root)) == 4


def test_started_again_nothing_is_done_twice(scene_of: SceneOf, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    first = dict(run_scenes(scenes(scene_of, 0.1, 0.2), root, workers=1, task=stored))
    again = dict(run_scenes(scenes(scene_of, 0.2, 0.1, 0.3), root, workers=1, task=stored))
    assert again[0] == first[1]
    assert again[1] == first[0]


@pytest.mark.parametrize(
    ("edp", "error", "text"), [(5, StorageError, "the disk is full"), (7, RuntimeError, "ZeroDivisionError: a bug")]
)
def test_what_stops_every_run_is_raised(scene_of: SceneOf, tmp_path: Path, edp: float, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        list(run_scenes(scenes(scene_of, edp), tmp_path / "runs", workers=1, task=stored))


def test_a_run_whose_process_is_shot_three_times_is_given_up_and_not_kept(scene_of: SceneOf, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    results = dict(run_scenes(scenes(scene_of, 6, 0.1), root, workers=1, task=stored))
    assert (results[0].status, results[0].kind) == ("failed", "killed")
    assert "3 x" in results[0].message and "SIGKILL" in results[0].message
    assert re.search(r"It was seen to take \d+ MB; this .*(has|may use) \d+ MB", results[0].message)
    assert results[1].status == "done"
    assert [run.key for run in list_runs(root)] == [results[1].key]
    assert not list(root.glob(".tmp-*")) and not list((root / ".locks").iterdir())


def test_a_run_that_the_machine_ends_once_is_done_all_the_same(scene_of: SceneOf, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    for kind in (9, 10, 11):
        (result,) = dict(run_scenes(scenes(scene_of, kind), root, workers=2, task=stored)).values()
        assert result.status == "done"


def test_closing_the_iterator_ends_the_workers_cleanly(scene_of: SceneOf, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    series = run_scenes(scenes(scene_of, 0.1, 8), root, workers=2, task=stored)
    assert next(iter(series))[0] == 0
    wait_for(lambda: list(root.glob(".tmp-*")))
    series.close()  # type: ignore[attr-defined]
    assert len(list_runs(root)) == 1
    assert not list(root.glob(".tmp-*")), "the hanging run has cleaned up after itself"


SERIES = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from lacli.mechanics.execute import run_scenes
from lacli.mechanics.places import pool
from lacli.contracts.scene import load_scene
from test_execute import stored
if __name__ == "__main__":
    scenes = [load_scene(Path({scene!r}), [f"loads.edp_mmhg={{p}}"]) for p in (0.1, 8)]
    for index, result in run_scenes(scenes, Path({root!r}), workers=2, task=stored):
        print(index, flush=True)
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_or_killed_series_leaves_no_process(scene_of: SceneOf, tmp_path: Path, how: signal.Signals) -> None:
    scene, series, root = tmp_path / "scene.toml", tmp_path / "series.py", tmp_path / "runs"
    scene.write_text(dump_scene(scene_of()))
    series.write_text(SERIES.format(tests=str(Path(__file__).parent), scene=str(scene), root=str(root)))
    with subprocess.Popen([sys.executable, str(series)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as main:
        assert main.stdout is not None
        assert main.stdout.readline() == "0\n"
        workers = Path(f"/proc/{main.pid}/task/{main.pid}/children").read_text().split()
        assert len(workers) >= 2
        wait_for(lambda: list(root.glob(".tmp-*")))  # the second has begun
        main.send_signal(how)
        main.communicate(timeout=20)
    wait_for(lambda: all(state(pid) == "Z" for pid in workers))
    assert len(list_runs(root)) == 1
    assert bool(list(root.glob(".tmp-*"))) == (how == signal.SIGKILL)
    list(run_scenes([scene_of("loads.edp_mmhg=0.3")], root, workers=1, task=stored))
    assert not list(root.glob(".tmp-*"))


def wait_for(condition: Callable[[], object], seconds: float = 10) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def state(pid: str) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return "Z"


def test_little_memory_means_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (execute, pool):
        monkeypatch.setattr(module, "memory_mb", lambda: (2000.0, 900.0))
    assert execute.default_workers() == 1
    busy = pool.Worker(None, None, index=0)  # type: ignore[arg-type]
    idle = pool.Worker(None, None)  # type: ignore[arg-type]
    assert pool.may_start([idle], 4, 5000.0, 1, set()), "one always runs"
    assert not pool.may_start([busy, idle], 4, 0.0, 1, set())
    assert pool.may_start([busy, idle], 4, 700.0, 1, set())
    assert not pool.may_start([busy, idle], 4, 800.0, 1, set())
    assert not pool.may_start([busy, idle], 1, 10.0, 1, set())
    assert not pool.may_start([busy, idle], 4, 10.0, 1, {1}), "it had too little memory beside others"
    assert not pool.may_start([busy, idle], 4, 10.0, 1, {0}), "the other one had"
    assert pool.may_start([idle], 4, 10.0, 1, {1})


def test_cluster_without_dask_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"pip install 'lacli\[cluster\]'"):
        list(run_scenes([], tmp_path, scheduler="tcp://nowhere:1", task=stored))


def test_a_worker_that_is_interrupted_as_it_starts_is_told_and_replaced(
    scene_of: SceneOf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    hire, hired = pool._hire, []

    def shot_once(*arguments: Any) -> pool.Worker:
        worker = hire(*arguments)
        if not hired:
            worker.process.send_signal(signal.SIGINT)
        hired.append(worker)
        return worker

    monkeypatch.setattr(pool, "_hire", shot_once)
    results = dict(run_scenes(scenes(scene_of, 0.1), tmp_path / "runs", workers=1, task=stored))
    assert results[0].status == "done" and len(hired) == 2
    assert "killed from outside (SIGINT" in caplog.text and "Tried once more" in caplog.text
