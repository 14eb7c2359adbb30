"""What the machine gives: memory, room on the disk, and the words for a full one."""

from __future__ import annotations

import errno
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from lacli.base.processes import machine


def test_memory_is_the_machine_s_or_the_container_s(monkeypatch: pytest.MonkeyPatch) -> None:
    total, available = machine.memory_mb()
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20
    assert 0 < available <= total <= physical * 1.001
    monkeypatch.setattr(machine, "_container_mb", lambda: (1000.0, 400.0))
    assert machine.memory_mb()[0] == min(1000.0, physical) and machine.memory_mb()[1] <= 600.0
    assert machine.memory_limit() == "this container or job may use 1000 MB"


def test_the_narrowest_limit_is_named() -> None:
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_DATA, (700 << 20, 700 << 20));"
        "from lacli.base.processes.machine import memory_limit; print(memory_limit())"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True).stdout
    assert said.strip() == "ulimit -d allows 700 MB"


def test_room_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = os.statvfs(tmp_path)
    assert abs(machine.free_bytes(tmp_path) - state.f_bfree * state.f_frsize) < 2**30
    assert not machine.disk_is_full(tmp_path)
    assert list(tmp_path.iterdir()) == [], "the probe is gone"
    assert machine.full_place([tmp_path / "not" / "yet"]) is None

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no room")

    monkeypatch.setattr(os, "fsync", full)
    assert machine.disk_is_full(tmp_path)
    assert machine.full_place([tmp_path / "not" / "yet"]) == tmp_path
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_in_words() -> None:
    assert re.fullmatch(r"D: the disk is full\. Free some space .* is kept\.", machine.full_words("D", errno.ENOSPC))
    assert "larger than allowed" in machine.full_words("D", errno.EFBIG)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, hard))
    try:
        assert "(ulimit -f, 1048576 kB)" in machine.full_words("D", errno.EFBIG)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_family_s_memory_counts_its_children() -> None:
    own = machine.status_kb(os.getpid(), "VmRSS") / 1024
    assert own > 10
    code = "x = bytearray(80 << 20); print(len(x), flush=True); input()"
    child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        child.stdout.readline()
        assert machine.family_mb(child.pid) > 80
        assert machine.family_mb(os.getpid()) > own + 75
    finally:
        child.communicate("\n", timeout=30)
    assert machine.status_kb(child.pid, "VmRSS") == 0.0
    assert machine.family_mb(child.pid) == 0.0
