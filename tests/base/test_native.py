"""Compiled code that is kept: damage is noticed, a compiler that hangs or is killed is told, two may ask at once."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lacli.base import notes
from lacli.base.processes import native
from lacli.base.processes.native import CompilerError, cache_folder, compile_with, kept


def make(content: bytes):  # type: ignore[no-untyped-def]
    def build(folder: Path) -> Path:
        (folder / "it.so").write_bytes(content)
        return folder / "it.so"

    return build


@pytest.mark.parametrize("damage", ["truncated", "changed", "no digest", "gone"])
def test_what_is_not_what_was_built_is_built_again(damage: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = kept(tmp_path, ("a", "b"), "it.so", make(b"code" * 1000))
    assert kept(tmp_path, ("a", "b"), "it.so", make(b"never asked")) == file
    digest = file.with_name("it.so.sha256")
    if damage == "truncated":
        file.write_bytes(file.read_bytes()[:100])
    elif damage == "changed":
        file.write_bytes(b"CODE" * 1000)
    else:
        (digest if damage == "no digest" else file).unlink()
    assert kept(tmp_path, ("a", "b"), "it.so", make(b"anew")) == file
    assert file.read_bytes() == b"anew"
    assert ("compiling it again" in caplog.text) == (damage != "gone")
    assert [path.name for path in tmp_path.iterdir()] == [file.parent.name], "neither locks nor temporary folders"


def test_another_part_is_another_file(tmp_path: Path) -> None:
    first = kept(tmp_path, ("a", "b"), "it.so", make(b"1"))
    assert kept(tmp_path, ("a", "c"), "it.so", make(b"2")) != first


ASK = """
import sys, time
from pathlib import Path
from lacli.base.processes.native import kept
def build(folder):
    with open(sys.argv[2], "a") as log:
        log.write("built ")
    while not Path(sys.argv[3]).exists():
        time.sleep(0.01)
    (folder / "it.so").write_text("code")
    return folder / "it.so"
print(kept(Path(sys.argv[1]), ("a",), "it.so", build))
"""


def ask(folder: Path) -> subprocess.Popen[str]:
    """A process that asks for the file; its build takes until there is a file ``go``."""
    command = [sys.executable, "-c", ASK, str(folder / "cache"), str(folder / "log"), str(folder / "go")]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(file: Path) -> None:
    end = time.monotonic() + 30
    while not file.exists():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def test_two_processes_build_once(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    with ask(tmp_path) as first:
        wait_for(tmp_path / "log")
        with ask(tmp_path) as second:
            assert second.stderr is not None
            said = second.stderr.readline()
            (tmp_path / "go").touch()
            answers = [one.communicate(timeout=30)[0] for one in (first, second)]
    assert f"waiting for process {first.pid} on " in said and "which compiles it.so" in said
    assert answers[0] == answers[1] and (tmp_path / "log").read_text() == "built "


def test_a_build_that_was_killed_leaves_nothing_for_long(tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    with ask(tmp_path) as one:
        wait_for(tmp_path / "log")
        one.send_signal(signal.SIGKILL)
    assert list((tmp_path / "cache").glob(".build-*"))
    file = kept(tmp_path / "cache", ("a",), "it.so", make(b"code"))
    assert [path.name for path in (tmp_path / "cache").iterdir()] == [file.parent.name]


def compiler(folder: Path, script: str) -> list[str]:
    file = folder / "cxx"
    file.write_text(f"#!/bin/sh\n{script}\n")
    file.chmod(0o755)
    return [str(file), "it.cpp"]


def test_a_compiler_that_hangs_is_told_and_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(native, "_TIMEOUT_S", 1.0)
    monkeypatch.setattr(notes, "_PATIENCE_S", 0.2)
    monkeypatch.setattr(native, "slow", lambda text: notes.slow(text, 0.2))
    with pytest.raises(CompilerError, match="did not come to an end within 1 s"):
        compile_with(compiler(tmp_path, f"sleep 61.{os.getpid()}"), tmp_path, "it.cpp")
    assert "compiling it.cpp with" in caplog.text and "up to 1 s" in caplog.text
    end = time.monotonic() + 1
    while subprocess.run(["pgrep", "-f", f"sleep 61.{os.getpid()}"], capture_output=True, check=False).stdout:
        assert time.monotonic() < end, "its child runs on"


def test_a_killed_compiler_is_asked_once_more(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    script = f"if [ ! -e {tmp_path}/once ]; then touch {tmp_path}/once; kill -9 $$; fi; echo fine"
    assert compile_with(compiler(tmp_path, script), tmp_path, "it.cpp").lines == ("fine",)
    assert "was killed from outside when it compiled it.cpp" in caplog.text
    # the driver tells that its own child was killed
    script = "echo 'g++: fatal error: Killed signal terminated program cc1plus'; exit 1"
    with pytest.raises(CompilerError, match="killed from outside, twice"):
        compile_with(compiler(tmp_path, script), tmp_path, "it.cpp")


def test_errors_are_no_kill(tmp_path: Path) -> None:
    answer = compile_with(compiler(tmp_path, "echo 'it.cpp:1: error: what'; exit 1"), tmp_path, "it.cpp")
    assert (answer.code, answer.lines) == (1, ("it.cpp:1: error: what",))


def test_a_home_that_is_not_there_is_not_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "nowhere"))
    with pytest.raises(OSError, match=r"nowhere does not exist\); set XDG_CACHE_HOME"):
        cache_folder()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert cache_folder() == tmp_path / "cache" / "lacli"
