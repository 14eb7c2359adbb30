"""The launcher: a program's output and end are its own, and it does not outlive who wanted it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lacli.base.processes import launch

START = [sys.executable, "-I", "-S", launch.__file__]


def started(way: str, *program: str) -> subprocess.CompletedProcess[str]:
    command = [*START, way, str(os.getpid()), *program]
    return subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)


@pytest.mark.parametrize("way", ["alone", "family"])
def test_output_code_and_signal_are_the_program_s(way: str) -> None:
    said = started(way, "/bin/sh", "-c", "echo out; echo err >&2; exit 7")
    assert (said.stdout, said.stderr, said.returncode) == ("out\n", "err\n", 7)
    assert started(way, "/bin/sh", "-c", "kill -TERM $$").returncode == -signal.SIGTERM
    assert started(way, "/bin/sh", "-c", "kill -KILL $$").returncode == -signal.SIGKILL
    missing = started(way, "/no/such/program")
    assert missing.returncode == 127 and missing.stderr == "/no/such/program: No such file or directory\n"


@pytest.mark.parametrize("way", ["alone", "family"])
def test_a_parent_that_is_gone_already_starts_nothing(way: str, tmp_path: Path) -> None:
    command = [*START, way, "1", "/bin/touch", str(tmp_path / "made")]  # no child of process 1
    ended = subprocess.run(command, capture_output=True, timeout=30, check=False)
    assert ended.returncode == 127
    assert not (tmp_path / "made").exists()


def test_a_family_ends_with_who_wanted_it(tmp_path: Path) -> None:
    mark = tmp_path / "pids"
    script = f"sleep 60 & echo $! $$ > {mark}.part; mv {mark}.part {mark}; wait"
    code = (
        "import os, subprocess, sys; subprocess.Popen([*sys.argv[2:], 'family', str(os.getpid()), '/bin/sh', '-c', sys.argv[1]],"
        "start_new_session=True); sys.stdin.read()"
    )
    parent = subprocess.Popen([sys.executable, "-c", code, script, *START], stdin=subprocess.PIPE)
    begin = time.monotonic()
    while not mark.exists() and time.monotonic() - begin < 20:
        time.sleep(0.02)
    pids = [int(word) for word in mark.read_text().split()]
    parent.kill()
    parent.communicate(timeout=10)
    begin = time.monotonic()
    while any(_alive(pid) for pid in pids) and time.monotonic() - begin < 20:
        time.sleep(0.02)
    assert not any(_alive(pid) for pid in pids)


def _alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
