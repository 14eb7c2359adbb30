"""Locks: who waits is told for whom; nothing is left, also where a file system has no locks."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from lacli.base.errors import MachineError
from lacli.base.processes.locks import lock, working_on
from lacli.base.processes.process import while_wanted

HOLD = """
import sys, time, fcntl, errno
from pathlib import Path
def none(*_):
    raise OSError(errno.ENOLCK, "No locks available")
if sys.argv[2] == "soft":
    fcntl.flock = none
from lacli.base.processes.locks import lock, working_on
with lock(Path(sys.argv[1]), "which does the same"):
    print("held", flush=True)
    time.sleep(float(sys.argv[3]))
"""


def hold(path: Path, way: str, seconds: float) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", HOLD, str(path), way, str(seconds)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture(params=["flock", "soft"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A file system with locks, and one without."""

    def none(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    if request.param == "soft":
        monkeypatch.setattr(fcntl, "flock", none)
    return str(request.param)


def test_who_waits_is_told_for_whom(way: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "key"
    with hold(path, way, 1) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        with lock(path, "which does the same", wait=False) as got:
            assert not got
        with lock(path, "which does the same") as got:
            assert (got and other.poll() is not None) or got
    assert f"waiting for process {other.pid} on " in caplog.text and ", which does the same" in caplog.text
    assert "since " in caplog.text
    assert not list(tmp_path.iterdir())


def test_a_killed_holder_is_noticed(way: str, tmp_path: Path) -> None:
    path = tmp_path / "key"
    with hold(path, way, 60) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        os.kill(other.pid, signal.SIGKILL)
    with lock(path, "which does the same") as got:
        assert got
    assert not list(tmp_path.iterdir())


def test_many_at_once_one_at_a_time(way: str, tmp_path: Path) -> None:
    path, count = tmp_path / "key", tmp_path / "count"
    count.write_text("0")
    begin = HOLD.index('    print("held"')
    counting = "n = int(open(sys.argv[3]).read()); time.sleep(0.02); open(sys.argv[3], 'w').write(str(n + 1))"
    text = f"{HOLD[:begin]}    {counting}"
    others = [subprocess.Popen([sys.executable, "-c", text, str(path), way, str(count)]) for _ in range(6)]
    assert [other.wait(60) for other in others] == [0] * 6
    assert count.read_text() == "6"
    assert [file.name for file in tmp_path.iterdir()] == ["count"]


def test_a_wait_that_is_no_longer_wanted_ends(tmp_path: Path) -> None:
    path = tmp_path / "key"
    with hold(path, "flock", 60) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        with pytest.raises(MachineError, match="cancelled"), while_wanted(lambda: False), lock(path, "which does it"):
            pass
        other.kill()


def test_a_second_process_waits_for_the_one_that_fills_a_place(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A table whose folder is still to be made; the second one begins when the first has ended, and says for whom it waited."""
    out = tmp_path / "new" / "runs.csv"
    body = f"""
import time
from pathlib import Path
from lacli.base.processes.locks import working_on
out = Path({str(out)!r})
with working_on(out):
    print("held", flush=True)
    time.sleep(1)
    out.write_text("first")
"""
    with subprocess.Popen([sys.executable, "-c", body], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        with working_on(out):
            assert out.read_text() == "first"
    assert f"waiting for process {other.pid} on " in caplog.text and f"which fills {out}" in caplog.text
    assert [path.name for path in out.parent.iterdir()] == ["runs.csv"]
