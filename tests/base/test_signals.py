"""Signals end lacli with one message and 128 + n, wherever they arrive; nothing that it started outlives it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def program(body: str) -> list[str]:
    lines = "\n".join("    " + line for line in body.strip().splitlines())
    text = f"from lacli.base.processes import signals\nsignals.catch()\ntry:\n{lines}\nfinally:\n    signals.settle()\n"
    return [sys.executable, "-c", text]


def shot(body: str, number: int, after_s: float = 0.1) -> tuple[int, str, float]:
    """Exit code, what was said, seconds until the end of a program that is shot when it has said ``ready``."""
    with subprocess.Popen(program(body), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as lacli:
        assert lacli.stdout is not None
        assert lacli.stdout.readline() == "ready\n"
        time.sleep(after_s)
        lacli.send_signal(number)
        start = time.monotonic()
        _, said = lacli.communicate(timeout=30)
    return lacli.returncode, said, time.monotonic() - start


BODIES = {
    "waiting": "import time; print('ready', flush=True); time.sleep(60)",
    # an exception raised here is only printed by Python, and lost
    "in a destructor": """
import time
class Slow:
    def __del__(self):
        time.sleep(0.5)
print('ready', flush=True)
while True:
    Slow()
    time.sleep(0.1)
""",
    # what fails because we are on the way out is no news
    "with a thread that fails": """
import threading, time
over = threading.Event()
def work():
    over.wait()
    raise ValueError("a consequence")
thread = threading.Thread(target=work)
thread.start()
print('ready', flush=True)
try:
    time.sleep(60)
finally:
    over.set()
    thread.join()
""",
    "with a destructor that fails": """
import time
class Bad:
    def __del__(self):
        raise ValueError("a consequence")
bad = Bad()
print('ready', flush=True)
try:
    time.sleep(60)
finally:
    del bad
""",
    # a library that swallows what is not its own
    "swallowed": """
import time
print('ready', flush=True)
while True:
    try:
        time.sleep(0.01)
    except (Exception, KeyboardInterrupt):
        pass
""",
    # C code that does not come back: the C library's sleep, through ctypes, takes up again after a signal
    "in a library": """
import ctypes
libc = ctypes.CDLL(None)
print('ready', flush=True)
libc.sleep(60); libc.sleep(60); libc.sleep(60)
""",
    "beside a thread that does not end": """
import threading, time
threading.Thread(target=time.sleep, args=(60,)).start()
print('ready', flush=True)
time.sleep(60)
""",
}


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("where", BODIES)
def test_one_message_and_128_plus_n(where: str, number: signal.Signals) -> None:
    code, said, seconds = shot(BODIES[where], number)
    assert code == 128 + number
    assert said.count("\n") == 1 and said.startswith("lacli: ") and "run the same command again" in said
    assert (number.name in said) == (number != signal.SIGINT)
    assert seconds < 4


@pytest.mark.parametrize("number", NUMBERS)
def test_an_import_is_not_cut_in_two(number: signal.Signals, tmp_path: Path) -> None:
    """A compiled module that is left half set up crashes the process: what is being imported is imported whole first."""
    (tmp_path / "slow.py").write_text(
        "import sys, time\nprint('ready', flush=True)\ntime.sleep(0.5)\nsys.stderr.write('whole\\n')\n"
    )
    code, said, _ = shot(f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import slow; import time; time.sleep(60)", number)
    assert code == 128 + number
    assert said.count("whole") == 1 and said.count("What was finished is kept") == 1


def test_what_is_ignored_stays_ignored() -> None:
    command = ["nohup", *program("import time; print('ready', flush=True); time.sleep(1)")]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as lacli:
        assert lacli.stdout is not None and lacli.stdout.readline() == b"ready\n"
        lacli.send_signal(signal.SIGHUP)
        assert lacli.wait(20) == 0


def test_cleaning_up_is_waited_for(tmp_path: Path) -> None:
    body = f"""
import time
from pathlib import Path
try:
    print('ready', flush=True)
    time.sleep(60)
finally:
    time.sleep(3)
    Path({str(tmp_path / "cleaned")!r}).touch()
"""
    assert shot(body, signal.SIGTERM)[0] == 143
    assert (tmp_path / "cleaned").exists()


@pytest.mark.parametrize("number", NUMBERS)
def test_a_command_that_still_imports_says_it_too(number: signal.Signals) -> None:
    """At many moments from the first handler on, while typer, numpy and the command are imported."""
    for moment in (0.0, 0.02, 0.05, 0.1, 0.2, 0.4):
        command = [sys.executable, "-m", "lacli", "verify"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as lacli:
            wait_for(lambda pid=lacli.pid: catches(pid, signal.SIGHUP))  # type: ignore[misc]
            time.sleep(moment)
            lacli.send_signal(number)
            _, said = lacli.communicate(timeout=30)
        assert lacli.returncode == 128 + number, said
        assert said.count("lacli: ") == 1 and "Traceback" not in said and "ignored" not in said, said


def catches(pid: int, number: int) -> bool:
    with suppress(OSError, StopIteration):
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        return bool(int(next(line for line in lines if line.startswith("SigCgt")).split()[1], 16) >> (number - 1) & 1)
    return False


def wait_for(condition: Callable[[], object], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def alive(name: str) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError, IndexError):
            state = (entry / "stat").read_text().rsplit(")", 1)[1].split()[0] if entry.name.isdigit() else "Z"
            if state != "Z" and int(entry.name) != os.getpid() and name.encode() in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
    return found


FAMILY = """
import os, sys
from pathlib import Path
from lacli.base.processes.process import answer_of, supervise
command = [sys.executable, "-c", "import subprocess; subprocess.run(['sleep', '{seconds}'])"]
print('ready', flush=True)
supervise(command, cwd=Path({folder!r}), env=os.environ, log=Path({folder!r}) / 'log', timeout_s=50, family={family})
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, *NUMBERS])
def test_no_grandchild_outlives_us(number: signal.Signals, tmp_path: Path) -> None:
    seconds = f"{60 + int(number)}.{os.getpid()}"
    body = FAMILY.format(seconds=seconds, folder=str(tmp_path), family=True)
    with subprocess.Popen(program(body), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as lacli:
        wait_for(lambda: len(alive(f"sleep\0{seconds}")) == 1)
        lacli.send_signal(number)
        wait_for(lambda: not alive(seconds), 1.0)


def test_no_grandchild_outlives_its_parent_while_we_live(tmp_path: Path) -> None:
    """A compiler's driver is shot: its own children go too."""
    seconds = f"77.{os.getpid()}"
    with subprocess.Popen(program(FAMILY.format(seconds=seconds, folder=str(tmp_path), family=True))) as lacli:
        wait_for(lambda: len(alive(f"sleep\0{seconds}")) == 1)
        drivers = alive(f"subprocess.run(['sleep', '{seconds}'])")
        (driver,) = [pid for pid in drivers if "launch.py" not in told(pid) and pid != lacli.pid]
        os.kill(driver, signal.SIGKILL)
        wait_for(lambda: not alive(f"sleep\0{seconds}"), 1.0)
        assert lacli.wait(10) == 0


def told(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_bytes().decode()


def test_a_child_started_when_its_parent_is_gone_does_not_run(tmp_path: Path) -> None:
    from lacli.base.processes.process import mortal

    command = mortal(["touch", str(tmp_path / "ran")])
    command[command.index("alone") + 1] = "1"  # not its parent
    assert subprocess.run(command, check=False).returncode != 0
    assert not (tmp_path / "ran").exists()
