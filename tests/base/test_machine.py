"""What the machine gives, in numbers and words; programs that end with their parent; warnings that are kept back."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from lacli.base.processes import launch, machine
from lacli.base.quiet import quiet, reason
from lacli.base.threads import one_thread, single_threaded


def test_memory_is_what_the_kernel_says() -> None:
    total, available = machine.memory_mb()
    kernel = {line.split(":")[0]: float(line.split()[1]) / 1024 for line in Path("/proc/meminfo").read_text().splitlines()}
    assert 0 < available <= total <= kernel["MemTotal"]
    assert any(word in machine.memory_limit() for word in ("this machine has", "this container or job", "ulimit"))


def test_the_narrowest_limit_is_the_one_that_is_told() -> None:
    words = "import resource; resource.setrlimit(resource.RLIMIT_DATA, (900 << 20, 900 << 20))\n"
    words += "from lacli.base.processes import machine; print(machine.memory_limit())"
    told = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True).stdout
    assert told.strip() == "ulimit -d allows 900 MB"


def test_a_full_disk_is_seen_and_named(small_disk: Path) -> None:
    assert not machine.disk_is_full(small_disk) and machine.free_bytes(small_disk) > 1 << 16
    (small_disk / "all").write_bytes(bytes(machine.free_bytes(small_disk)))
    assert machine.disk_is_full(small_disk)
    deep = small_disk / "not" / "yet"
    assert machine.full_place([Path("/tmp"), deep]) == small_disk  # the folder that would hold it
    assert not list(small_disk.glob(".probe*"))
    assert machine.full_words("out.vtu", errno.ENOSPC).startswith("out.vtu: the disk is full. Free some space")
    assert "a file would be larger than allowed" in machine.full_words("out.vtu", errno.EFBIG)


def test_a_family_s_memory_is_more_than_its_head_s() -> None:
    hold = "import subprocess, sys; x = bytes(60 << 20); subprocess.run([sys.executable, '-c', {0!r}])"
    child = "import time; y = bytearray(80 << 20); print('up', flush=True); time.sleep(30)"
    with subprocess.Popen([sys.executable, "-c", hold.format(child)], stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        alone, family = machine.status_kb(process.pid, "VmRSS") / 1024, machine.family_mb(process.pid)
        os.killpg(process.pid, 9)
    assert family > alone + 80 > 80
    assert machine.status_kb(process.pid, "VmRSS") == 0.0  # there is none any more


def started(*words: str) -> subprocess.CompletedProcess[str]:
    """As lacli starts a program: by a bare interpreter."""
    command = [sys.executable, "-I", "-S", launch.__file__, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)


@pytest.mark.parametrize("way", ["alone", "family"])
def test_a_launched_program_ends_as_it_would_by_itself(way: str) -> None:
    me = str(os.getpid())
    assert started(way, me, "sh", "-c", "echo said; exit 3").returncode == 3
    assert started(way, me, "sh", "-c", "kill -TERM $$").returncode == -15
    missing = started(way, me, "/no/such/program")
    assert missing.returncode == 127 and missing.stderr == "/no/such/program: No such file or directory\n"
    assert started(way, "1", "echo", "too late").returncode in (127, -15)  # whose parent is gone before it begins


def test_a_family_ends_with_its_parent(tmp_path: Path) -> None:
    # parent -> launch family -> sh -> sleep; the parent is killed
    command = [sys.executable, "-I", "-S", launch.__file__, "family"]
    inner = f"echo $$ > {tmp_path}/sh; sleep 60 & echo $! > {tmp_path}/sleep; wait"
    parent = f"import os, subprocess; subprocess.run({command!r} + [str(os.getpid()), 'sh', '-c', {inner!r}], process_group=0)"
    with subprocess.Popen([sys.executable, "-c", parent]) as process:
        for _ in range(200):
            if (tmp_path / "sleep").is_file() and (tmp_path / "sleep").read_text().strip():
                break
            time.sleep(0.05)
        process.kill()
    pids = [int((tmp_path / name).read_text()) for name in ("sh", "sleep")]
    for _ in range(100):
        if not any(machine.status_kb(pid, "VmRSS") for pid in pids):
            break
        time.sleep(0.05)
    assert not any(machine.status_kb(pid, "VmRSS") for pid in pids)


def test_libraries_are_quiet_inside_and_heard_again_after(capfd: pytest.CaptureFixture[str]) -> None:
    from vtkmodules.vtkCommonCore import vtkObject

    before = vtkObject.GetGlobalWarningDisplay()
    with quiet(meshio=True):
        warnings.warn("a library's", stacklevel=1)
        assert np.isinf(np.float64(1.0) / np.float64(0.0))
        sys.stderr.write("meshio's\n")
        assert not vtkObject.GetGlobalWarningDisplay()
    assert vtkObject.GetGlobalWarningDisplay() == before
    with pytest.warns(UserWarning, match="mine"):
        warnings.warn("mine", stacklevel=1)
    with pytest.raises(ValueError, match="goes on"), quiet():
        raise ValueError("goes on")
    assert vtkObject.GetGlobalWarningDisplay() == before
    assert "meshio" not in capfd.readouterr().err


def test_a_complaint_is_its_kind_and_first_line() -> None:
    assert reason(ValueError("\n  first\nsecond")) == "ValueError: first"
    assert reason(KeyError()) == "KeyError"
    assert reason(ValueError("x" * 300)) == "ValueError: " + "x" * 188 + " ..."


def test_blas_has_one_thread_inside() -> None:
    from threadpoolctl import threadpool_info

    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    outside = threads()
    with one_thread():
        assert threads() == {1}
    assert threads() == outside

    @single_threaded
    def inside(a: int, *, b: int) -> tuple[int, set[int]]:
        """Doc."""
        return a - b, threads()

    assert inside(5, b=2) == (3, {1}) and inside.__doc__ == "Doc."
