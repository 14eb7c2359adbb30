"""Runs on disk: nothing half-written, one writer per key, keys of content and of nothing else."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lacli.base import files
from lacli.base.errors import AnatomyError, StorageError
from lacli.base.files import check_file, check_folder, replacing, write_json, write_text
from lacli.contracts import identity
from lacli.contracts.failures import MACHINE
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene, dump_scene, load_scene
from lacli.mechanics import store
from lacli.mechanics.store import StoredRun, find_run, list_runs, open_run

SceneOf = Callable[..., Scene]


def visible(root: Path) -> list[str]:
    return sorted(path.name for path in root.iterdir() if path.name != ".locks")


def finished(root: Path, scene: Scene, **how: str) -> store.StoredRun:
    with open_run(root, run_key(scene)) as run:
        assert run.stored is None
        write_json(run.folder / "features.json", {"edv_ml": 80.5})
        return run.finish(**how)  # type: ignore[arg-type]


def test_key_is_content_not_path(scene_of: SceneOf, tmp_path: Path) -> None:
    scene = scene_of()
    key = run_key(scene)
    moved = tmp_path / "elsewhere"
    scene.anatomy.bundle.rename(moved)
    assert run_key(scene.model_copy(update={"anatomy": scene.anatomy.model_copy(update={"bundle": moved})})) == key
    assert len(key) == 16


def test_key_changes_with_scene_bundle_motion_and_solver(
    scene_of: SceneOf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of()
    keys = [run_key(scene), run_key(scene_of("loads.edp_mmhg=7.5"))]
    bundle = scene.anatomy.bundle
    (bundle / "wall.vtu").write_bytes(b"another wall")
    keys.append(run_key(scene))
    np.savez(bundle / "motion.npz", times=np.arange(3.0))
    keys.append(run_key(scene))
    np.savez(bundle / "motion.npz", times=np.arange(3.0) + 1e-12)
    keys.append(run_key(scene))
    monkeypatch.setattr(identity, "solver_digest", lambda: "other")
    keys.append(run_key(scene))
    assert len(set(keys)) == len(keys)


def test_a_run_does_not_depend_on_the_emulators_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("templates/deck.edp.j2", "solvers/freefem/laws.idp", "solvers/emulator/moments.cpp"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("one")
    monkeypatch.setattr(identity, "resource_folder", lambda name: tmp_path / name)
    before = identity.solver_digest.__wrapped__()
    (tmp_path / "solvers/emulator/moments.cpp").write_text("another")
    assert identity.solver_digest.__wrapped__() == before
    (tmp_path / "solvers/freefem/laws.idp").write_text("another")
    assert identity.solver_digest.__wrapped__() != before


def test_motion_counts_by_its_arrays_and_is_never_unpickled(scene_of: SceneOf) -> None:
    scene = scene_of()
    motion = scene.anatomy.bundle / "motion.npz"
    np.savez(motion, a=np.arange(4.0), b=np.ones((2, 2)))
    key = run_key(scene)
    np.savez_compressed(motion, b=np.ones((2, 2)), a=np.arange(4.0))
    assert run_key(scene) == key
    np.savez(motion, a=np.array([{"an": "object"}], dtype=object))
    whole = motion.read_bytes()
    for damaged in (whole, whole[: len(whole) // 2], b""):
        motion.write_bytes(damaged)
        with pytest.raises(AnatomyError, match=r"motion\.npz: .* damaged"):
            run_key(scene)


def test_missing_bundle_is_named(scene_of: SceneOf) -> None:
    scene = scene_of()
    (scene.anatomy.bundle / "boundary.vtp").unlink()
    with pytest.raises(AnatomyError, match=r"boundary\.vtp is missing"):
        run_key(scene)


def test_finished_run_is_found_and_not_run_again(scene_of: SceneOf, tmp_path: Path) -> None:
    scene, root = scene_of(), tmp_path / "runs"
    stored = finished(root, scene)
    assert visible(root) == [run_key(scene)]
    assert sorted(stored.manifest["products"]) == ["features.json"]
    assert stored.manifest["versions"]["lacli"]
    assert stored.features() == {"edv_ml": 80.5}
    with open_run(root, run_key(scene)) as again:
        assert again.stored == stored
    assert list_runs(root) == [stored]
    assert not any((root / ".locks").iterdir())


def test_run_without_its_products_is_not_complete(scene_of: SceneOf, tmp_path: Path) -> None:
    scene, root = scene_of(), tmp_path / "runs"
    stored = finished(root, scene)
    (stored.folder / "features.json").write_text("{")  # cut short
    assert find_run(root, stored.key) is None
    finished(root, scene)
    assert find_run(root, stored.key) is not None
    assert visible(root) == [stored.key]


def test_promised_product_must_exist(scene_of: SceneOf, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"transients\.csv was not written"), open_run(tmp_path, run_key(scene_of())) as run:
        run.finish(products=["transients.csv"])


def test_failed_run_stays_and_counts(scene_of: SceneOf, tmp_path: Path) -> None:
    scene, root = scene_of(), tmp_path / "runs"
    with open_run(root, run_key(scene)) as run:
        (run.folder / "state_0007.txt").write_text("last good state")
        run.finish("failed", kind="load_step_underflow", message="at load 0.7")
    with open_run(root, run_key(scene)) as again:
        assert again.stored is not None
        assert (again.stored.status, again.stored.kind) == ("failed", "load_step_underflow")
        assert (again.stored.folder / "state_0007.txt").is_file()
    with open_run(root, run_key(scene), retry_failed=True) as retry:
        assert retry.stored is None
        retry.finish()
    assert [run.status for run in list_runs(root)] == ["done"]


@pytest.mark.parametrize("kind", sorted(MACHINE))
def test_failures_of_the_machine_are_told_and_not_kept(scene_of: SceneOf, tmp_path: Path, kind: str) -> None:
    root, scene = tmp_path / "runs", scene_of()
    with open_run(root, run_key(scene)) as run:
        (run.folder / "half.txt").write_text("half")
        told = run.finish("failed", kind=kind, message="why")
    assert (told.status, told.kind, told.message) == ("failed", kind, "why")
    assert visible(root) == [] and list_runs(root) == []
    # one that an earlier version kept counts no more
    (root / run.key).mkdir()
    write_json(root / run.key / "manifest.json", {"key": run.key, "status": "failed", "kind": kind, "products": {}})
    assert find_run(root, run.key) is None
    finished(root, scene)
    assert [stored.status for stored in list_runs(root)] == ["done"]


def test_a_status_needs_its_kind(scene_of: SceneOf, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="failed with a kind"), open_run(tmp_path, run_key(scene_of())) as run:
        run.finish("failed")


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_interruption_leaves_nothing(scene_of: SceneOf, tmp_path: Path, error: type[BaseException]) -> None:
    root = tmp_path / "runs"
    with pytest.raises(error), open_run(root, run_key(scene_of())) as run:
        (run.folder / "half.txt").write_text("half")
        raise error
    assert visible(root) == []


HOLD = """
import sys, time
from pathlib import Path
from lacli.contracts.identity import run_key
from lacli.contracts.scene import load_scene
from lacli.mechanics.store import open_run
with open_run(Path(sys.argv[1]), run_key(load_scene(Path(sys.argv[2])))) as run:
    print("stored" if run.stored else "open", flush=True)
    if run.stored is None:
        time.sleep(float(sys.argv[3]))
        (run.folder / "features.json").write_text('{"writer": "' + sys.argv[4] + '"}')
        run.finish()
print(run.stored.features()["writer"], flush=True)
"""


def holder(root: Path, scene_file: Path, seconds: float, name: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", HOLD, root, scene_file, str(seconds), name], stdout=subprocess.PIPE, text=True)


@pytest.fixture
def scene_file(scene_of: SceneOf, tmp_path: Path) -> Path:
    file = tmp_path / "scene.toml"
    file.write_text(dump_scene(scene_of()))
    return file


def test_two_processes_one_key_one_run(scene_file: Path, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    with holder(root, scene_file, 0.8, "first") as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "open\n"
        with holder(root, scene_file, 0, "second") as second:
            said, _ = second.communicate(timeout=30)
        rest = first.stdout.read()
    assert said.split() == ["stored", "first"]
    assert rest == "first\n"
    assert len(visible(root)) == 1


def test_kill_9_leaves_a_run_that_starts_again(scene_file: Path, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    with holder(root, scene_file, 60, "killed") as lacli:
        assert lacli.stdout is not None
        assert lacli.stdout.readline() == "open\n"
        lacli.send_signal(signal.SIGKILL)
    assert visible(root)[0].startswith(".tmp-")
    assert list_runs(root) == []
    scene = load_scene(scene_file)
    # another key's run sweeps the dead one's leftovers
    finished(root, load_scene(scene_file, ["loads.edp_mmhg=1"]))
    assert len(visible(root)) == 1
    finished(root, scene)
    assert len(list_runs(root)) == 2


def test_a_running_neighbour_is_not_swept(scene_file: Path, tmp_path: Path) -> None:
    root = tmp_path / "runs"
    with holder(root, scene_file, 0.8, "neighbour") as lacli:
        assert lacli.stdout is not None
        assert lacli.stdout.readline() == "open\n"
        finished(root, load_scene(scene_file, ["loads.edp_mmhg=1"]))
        assert lacli.stdout.read() == "neighbour\n"
    assert len(list_runs(root)) == 2


def test_full_disk_is_one_message_and_leaves_nothing_half(scene_of: SceneOf, small_disk: Path) -> None:
    root = small_disk / "runs"
    scene = scene_of()
    kept = finished(root, scene_of("loads.edp_mmhg=1"))
    with pytest.raises(StorageError, match="the disk is full"), open_run(root, run_key(scene)) as run:
        (run.folder / "fields.bin").write_bytes(os.urandom(1 << 18))
    assert visible(root) == [kept.key]
    assert find_run(root, kept.key) == kept
    with pytest.raises(StorageError, match="the disk is full"):
        write_text(small_disk / "table.csv", "x" * (1 << 18))
    assert [path.name for path in small_disk.iterdir()] == ["runs"]


def test_place_that_cannot_be_written(scene_of: SceneOf, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="in the way"), open_run(tmp_path / "file", run_key(scene_of())):
        pass


def test_a_folder_in_a_files_place_is_one_message(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(StorageError, match=r"folder: a folder of that name is in the way"):
        write_text(tmp_path / "folder", "text")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_a_place_is_looked_at_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for folder in (tmp_path / "file", tmp_path / "file" / "deeper"):
        with pytest.raises(StorageError, match="is a file"):
            check_folder(folder)
    (tmp_path / "link").symlink_to("link")
    with pytest.raises(StorageError, match="link is a link that leads nowhere"):
        check_folder(tmp_path / "link" / "deeper")
    check_folder(tmp_path / "new" / "deeper")
    check_file(tmp_path / "new" / "table.csv")
    with pytest.raises(StorageError, match="a folder of that name is in the way"):
        check_file(tmp_path / "folder")
    with pytest.raises(StorageError, match="is a file"):
        check_file(tmp_path / "file" / "table.csv")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder", "link"]


def test_atomic_text_keeps_the_old_one_on_error(tmp_path: Path) -> None:
    file = tmp_path / "a" / "table.csv"
    write_text(file, "old")
    with pytest.raises(ZeroDivisionError), replacing(file) as temporary:
        assert temporary.suffix == ".csv"
        temporary.write_text("new")
        raise ZeroDivisionError
    assert file.read_text() == "old"
    with pytest.raises(ValueError, match="JSON"):
        write_json(file, {"a": float("nan")})
    assert [path.name for path in file.parent.iterdir()] == ["table.csv"]
    write_json(file, {"a": np.float64(1.5), "b": np.arange(2), "c": tmp_path})
    assert json.loads(file.read_text()) == {"a": 1.5, "b": [0, 1], "c": str(tmp_path)}
    assert file.stat().st_mode & 0o777 == 0o666 & ~files._umask()


def test_times_are_recorded(scene_of: SceneOf, tmp_path: Path) -> None:
    with open_run(tmp_path / "runs", run_key(scene_of())) as run:
        time.sleep(0.05)
        stored = run.finish(cpu_s=1.5, seeds={"sobol": 3}, versions={"freefem": "4.9"})
    assert 0.05 <= stored.manifest["wall_s"] < 5
    assert stored.manifest["cpu_s"] == 1.5
    assert stored.manifest["seeds"] == {"sobol": 3}
    assert {"lacli", "python", "numpy", "freefem"} <= set(stored.manifest["versions"])


def test_a_file_larger_than_allowed_is_one_message(tmp_path: Path) -> None:
    """``ulimit -f``: 64 kB."""
    limited = (
        "import resource, sys; from pathlib import Path; resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, 1 << 16));"
        "from lacli.base.errors import StorageError; from lacli.base.files import write_text\n"
        "try: write_text(Path(sys.argv[1]), 'x' * (1 << 18))\n"
        "except StorageError as error: print(error)"
    )
    command = [sys.executable, "-c", limited, str(tmp_path / "table.csv")]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "larger than allowed (ulimit -f, 64 kB). Raise the limit" in said and str(tmp_path) in said
    assert not list(tmp_path.iterdir())


def test_locks_of_killed_processes_are_swept(scene_of: SceneOf, tmp_path: Path) -> None:
    (tmp_path / ".locks").mkdir()
    (tmp_path / ".locks" / "0123456789abcdef").write_text("4194304 here\n")
    finished(tmp_path, scene_of())
    assert not list((tmp_path / ".locks").iterdir())


@pytest.mark.parametrize(
    ("made", "asked", "told"),
    [("script", "auto", True), ("plugin", "auto", False), ("script", "script", False), (None, "auto", False)],
)
def test_a_run_of_the_other_engine_is_one_result_and_told(scene_of: SceneOf, made: str | None, asked: str, told: bool) -> None:
    from lacli.mechanics.simulation import of_another_engine

    scene = scene_of(f"numerics.engine={asked}")
    words = of_another_engine(StoredRun("k", Path("k"), {"engine": made} if made else {}), scene)
    assert ("made by the script engine" in words) == told


def test_another_engine_asked_for_by_name_is_another_run(scene_of: SceneOf) -> None:
    keys = {run_key(scene_of(f"numerics.engine={name}")) for name in ("auto", "plugin", "script")}
    assert len(keys) == 3


def test_a_run_of_another_freefem_is_made_again_with_a_word(
    scene_of: SceneOf, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with open_run(tmp_path, "k", solver="4.15") as run:
        (run.folder / "features.json").write_text("{}")
        run.finish(versions={"freefem": "4.15"})
    with open_run(tmp_path, "k", solver="4.15") as run:
        assert run.stored is not None
    with open_run(tmp_path, "k", solver=None) as run:
        assert run.stored is not None, "without FreeFEM, what there is can be looked at"
    with open_run(tmp_path, "k", solver="4.16") as run:
        assert run.stored is None
    assert "made with FreeFEM 4.15, this is 4.16; the run is made again" in caplog.text


def test_a_running_neighbour_is_not_swept_where_the_file_system_has_no_locks(
    scene_of: SceneOf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", none)
    one, other = scene_of(), scene_of("loads.edp_mmhg=3")
    with open_run(tmp_path, run_key(one)) as running:
        marker = tmp_path / ".locks" / f"{run_key(one)}.marker"
        assert marker.is_file() and running.folder.is_dir()
        for _ in range(2):
            with open_run(tmp_path, run_key(other)):
                pass
            assert marker.is_file() and running.folder.is_dir()
