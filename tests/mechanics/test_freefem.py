"""FreeFEM as an external program: real FreeFEM, real kills, a really full device."""

from __future__ import annotations

import math
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.base.errors import MachineError, SolverMissingError
from lacli.base.processes import process
from lacli.freefem import program as ff
from lacli.freefem.plugins import compile_plugin, plugin_obstacle
from lacli.freefem.program import FreeFem, find
from lacli.freefem.run import parse_progress, parse_stop, run

SPEAK = 'cout << "@ progress phase=load load=0.5 step=0.1 newton=2 residual=1e-3 minj=0.9" << endl; cout.flush;\n'
BUSY = SPEAK + "while (true) clock();\n"
DONE = 'cout << "@ done" << endl; cout.flush;\n'


def script(folder: Path, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "deck.edp"
    file.write_text(text)
    return file


def processes_of(file: Path) -> list[int]:
    """Processes with ``file`` in their command line, zombies not counted."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and entry.name != str(os.getpid()):
            try:
                if str(file).encode() in (entry / "cmdline").read_bytes():
                    found.append(int(entry.name))
            except OSError:
                continue
    return found


def wait_for(condition: Callable[[], object], seconds: float = 10) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def test_find_gives_a_folder_of_plugins_that_load(freefem: FreeFem) -> None:
    assert (freefem.load_path / "msh3.so").is_file()
    assert float(freefem.version) >= 4
    assert all(ff.can_load(freefem, name) for name in ("msh3", "MUMPS_seq", "Element_QF"))
    assert not ff.can_load(freefem, "no_such_plugin")


def test_missing_freefem_is_one_message_with_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ff, "_ROOTS", (str(tmp_path),))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("LACLI_FREEFEM", raising=False)
    with pytest.raises(SolverMissingError, match=r"not installed.*apt-get install -y freefem\+\+"):
        find()
    monkeypatch.setenv("LACLI_FREEFEM", str(tmp_path / "nowhere"))
    with pytest.raises(SolverMissingError, match=r"LACLI_FREEFEM=.*nowhere: no such program"):
        find()


def test_a_binary_that_does_not_run_is_named(freefem: FreeFem, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "FreeFem++"
    broken.write_text("#!/bin/sh\necho 'libblas.so.3: cannot open shared object file'\nexit 127\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("LACLI_FREEFEM", str(broken))
    with pytest.raises(SolverMissingError, match=r"does not run \(libblas.so.3: cannot open"):
        find()


def test_a_probe_that_is_killed_is_told_as_killed(freefem: FreeFem, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    shot = tmp_path / "FreeFem++"
    shot.write_text("#!/bin/sh\nkill -9 $$\n")
    shot.chmod(shot.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("LACLI_FREEFEM", str(shot))
    with pytest.raises(MachineError, match=r"was killed from outside .SIGKILL. when it was tried. Run again") as error:
        find()
    assert error.value.kind == "killed"


def test_a_file_larger_than_allowed_is_no_kill(freefem: FreeFem, tmp_path: Path) -> None:
    text = '{ ofstream f("big.txt"); for (int i = 0; i < 40000; i++) f << i << endl; }\n' + DONE
    file = script(tmp_path, text)
    code = (
        "import resource; from pathlib import Path; from lacli.freefem.program import find;"
        "from lacli.freefem.run import run; freefem = find();"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 15, 1 << 15));"
        f"outcome = run(freefem, Path({str(file)!r}), Path({str(tmp_path)!r}), 60); print(outcome.kind, outcome.message)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.startswith("disk_full ") and "larger than allowed (ulimit -f, 32 kB)" in said and str(tmp_path) in said


@pytest.mark.parametrize(("number", "kind"), [(-13, "out_of_memory"), (-10, "linear_solver")])
def test_a_solver_without_memory_is_the_machines(freefem: FreeFem, tmp_path: Path, number: int, kind: str) -> None:
    text = f'cout << "@ mumps error={number}" << endl; cout << "@ stop kind=linear_solver message=x" << endl; exit(4);\n'
    outcome = run(freefem, script(tmp_path, text), tmp_path, 30)
    assert outcome.kind == kind
    recovered = f'cout << "@ mumps error={number}" << endl;\n' + DONE
    assert run(freefem, script(tmp_path, recovered), tmp_path, 30).done


def test_plugins_are_found_through_the_package_list(freefem: FreeFem, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    listed = ff._packaged_plugins()
    if listed is None:
        pytest.skip("FreeFEM is not a Debian package here")
    monkeypatch.setattr(ff, "_ROOTS", ())
    assert ff._plugins("", [tmp_path]) == listed
    assert ff._plugins(f"/nowhere;;{listed};;", []) == listed


def test_success_needs_the_last_word(freefem: FreeFem, tmp_path: Path) -> None:
    good = run(freefem, script(tmp_path / "a", 'load "msh3"\n' + DONE), tmp_path / "a", 30)
    assert (good.exit_code, good.kind, good.done) == (0, None, True)
    assert (tmp_path / "a" / "solver.log").read_text().strip() == "@ done"
    early = run(freefem, script(tmp_path / "b", "exit(0);\n" + DONE), tmp_path / "b", 30)
    assert early.exit_code == 0
    assert early.kind == "freefem_error"
    assert "before the script was done" in early.message


def test_lines_arrive_while_the_script_runs(freefem: FreeFem, tmp_path: Path) -> None:
    times = []
    text = SPEAK + 'exec("sleep 0.7");\n' + DONE
    run(freefem, script(tmp_path, text), tmp_path, 30, on_line=lambda line: times.append(time.monotonic()))
    assert len(times) >= 2
    assert times[-1] - times[0] > 0.5


def test_stop_reason_is_the_scripts(freefem: FreeFem, tmp_path: Path) -> None:
    text = 'cout << "@ stop kind=inverted_element message=J is -0.2 at 3 points, load 0.4" << endl; cout.flush;\nexit(4);\n'
    outcome = run(freefem, script(tmp_path, text), tmp_path, 30)
    assert (outcome.kind, outcome.message) == ("inverted_element", "J is -0.2 at 3 points, load 0.4")
    assert outcome.exit_code == 4


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("cout << nothing << endl;\n", "nothing does not exist"),
        ("cout << 1. / 0. << endl;\n", "Div by 0"),
        ('load "no_such_plugin"\n', "no_such_plugin"),
        ("assert(1 < 0);\n", "assert"),
        ("exit(3);\n", "code 3"),
    ],
)
def test_errors_inside_freefem_are_quoted(freefem: FreeFem, tmp_path: Path, text: str, said: str) -> None:
    outcome = run(freefem, script(tmp_path, text), tmp_path, 30)
    assert outcome.kind == "freefem_error"
    assert outcome.exit_code > 0
    assert said in outcome.message


def test_timeout_kills_freefem_and_its_children(freefem: FreeFem, tmp_path: Path) -> None:
    marker = tmp_path / "deck.edp"
    text = SPEAK + f"exec(\"sh -c 'sleep 60; : {marker}'\");\n"
    start = time.monotonic()
    outcome = run(freefem, script(tmp_path, text), tmp_path, 0.6)
    assert outcome.kind == "starved", "it slept"
    assert "0.6 s" in outcome.message
    assert time.monotonic() - start < 5
    wait_for(lambda: not processes_of(marker))


def test_kill_9_of_freefem_is_named(freefem: FreeFem, tmp_path: Path) -> None:
    file = script(tmp_path, BUSY)

    def shoot(line: str) -> None:
        for pid in processes_of(file):
            os.kill(pid, signal.SIGKILL)

    outcome = run(freefem, file, tmp_path, 30, on_line=shoot)
    assert outcome.kind == "killed"
    assert outcome.exit_code == -signal.SIGKILL
    assert "SIGKILL" in outcome.message


def test_kill_9_of_lacli_leaves_no_orphan(freefem: FreeFem, tmp_path: Path) -> None:
    file = script(tmp_path, BUSY)
    code = (
        "from pathlib import Path; from lacli.freefem.program import find; from lacli.freefem.run import run;"
        f"run(find(), Path({str(file)!r}), Path({str(tmp_path)!r}), 60)"
    )
    with subprocess.Popen([sys.executable, "-c", code]) as lacli:
        wait_for(lambda: "@ progress" in ((tmp_path / "solver.log").read_text() if (tmp_path / "solver.log").exists() else ""))
        assert len(processes_of(file)) == 2, "lacli and FreeFEM"
        lacli.kill()
    wait_for(lambda: not processes_of(file), seconds=3)


def test_ctrl_c_kills_freefem_and_passes_on(freefem: FreeFem, tmp_path: Path) -> None:
    file = script(tmp_path, BUSY)
    with pytest.raises(KeyboardInterrupt):
        run(freefem, file, tmp_path, 30, on_line=lambda line: signal.raise_signal(signal.SIGINT))
    assert not processes_of(file)


def test_full_disk_stops_the_run(freefem: FreeFem, tmp_path: Path) -> None:
    file = script(tmp_path, BUSY)
    (tmp_path / "solver.log").symlink_to("/dev/full")
    outcome = run(freefem, file, tmp_path, 30)
    assert outcome.kind == "disk_full"
    assert str(tmp_path) in outcome.message
    assert not processes_of(file)


def test_results_cut_short_by_a_full_disk_are_not_a_success(freefem: FreeFem, small_disk: Path) -> None:
    # FreeFEM's streams fail silently: it comes to its end with half a file
    text = '{ ofstream f("big.txt"); for (int i = 0; i < 40000; i++) f << i << endl; }\n' + DONE
    outcome = run(freefem, script(small_disk, text), small_disk, 30)
    assert outcome.kind == "disk_full"


def test_memory_and_cpu_are_the_childs(freefem: FreeFem, tmp_path: Path) -> None:
    ballast = bytearray(400 * 2**20)  # our own size must not be counted
    ballast[:: 2**12] = b"x" * len(ballast[:: 2**12])
    # 25e6 doubles are 191 MB
    text = 'real[int] a(25000000); a = 1.; exec("sleep 0.5"); while (clock() < 0.5) clock();\n' + DONE
    outcome = run(freefem, script(tmp_path, text), tmp_path, 60)
    assert outcome.done
    assert 190 < outcome.peak_memory_mb < 330
    assert 0.4 < outcome.cpu_s < 2
    assert outcome.wall_s > 0.5
    assert len(ballast) > 0


def test_out_of_memory_is_recognised(freefem: FreeFem, tmp_path: Path) -> None:
    text = 'cout << "terminate called after throwing an instance of std::bad_alloc" << endl; exit(1);\n'
    assert run(freefem, script(tmp_path, text), tmp_path, 30).kind == "out_of_memory"


def test_freefem_is_stopped_before_the_machine_has_no_memory(
    freefem: FreeFem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a machine of 400 MB with nothing left: FreeFEM, with its 200 MB, is the greedy one
    monkeypatch.setattr(process, "memory_mb", lambda: (400.0, 1.0))
    file = script(tmp_path, "real[int] a(25000000); a = 1.;\n" + BUSY)
    outcome = run(freefem, file, tmp_path, 60)
    assert outcome.kind == "out_of_memory"
    assert outcome.wall_s < 20
    assert "Run fewer side by side" in outcome.message
    assert not processes_of(file)


PLUGIN = """#include "ff++.hpp"
static double triple(double x) { return 3 * x; }
static void Load_Init() { Global.Add("triple", "(", new OneOperator1<double, double>(triple)); }
LOADFUNC(Load_Init)
"""


@pytest.fixture
def compiling(freefem: FreeFem) -> FreeFem:
    if reason := plugin_obstacle(freefem):
        pytest.skip(reason)
    return freefem


def test_plugin_is_built_once_even_if_asked_for_twice_at_once(compiling: FreeFem, tmp_path: Path) -> None:
    source = tmp_path / "triple.cpp"
    source.write_text(PLUGIN)
    cache = tmp_path / "cache"
    barrier = threading.Barrier(2)

    def ask(_: int) -> Path:
        barrier.wait()
        return compile_plugin(compiling, source, cache)

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(ask, range(2))
    assert first == second
    assert [path.name for path in cache.iterdir()] == [first.parent.name], "temporary folders are gone"
    built = first.stat().st_mtime_ns
    assert compile_plugin(compiling, source, cache) == first
    assert first.stat().st_mtime_ns == built
    text = f'load "{first.with_suffix("")}"\ncout << "@ value " << triple(14.) << endl;\n' + DONE
    assert "@ value 42" in run(compiling, script(tmp_path, text), tmp_path, 30).last_lines


def test_plugin_that_cannot_be_built_says_why(compiling: FreeFem, tmp_path: Path) -> None:
    source = tmp_path / "wrong.cpp"
    source.write_text("int x = ;\n")
    with pytest.raises(SolverMissingError, match=r"wrong\.cpp does not compile"):
        compile_plugin(compiling, source, tmp_path / "cache")
    no_compiler = FreeFem(**{**compiling.__dict__, "compiler": None})
    with pytest.raises(SolverMissingError, match=r"apt-get install -y g\+\+"):
        compile_plugin(no_compiler, source, tmp_path / "cache")


def test_progress_line() -> None:
    line = "@ progress phase=unload load=0.25 step=0.25 newton=3 residual=1.2e-4 minj=0.8 trial=2"
    seen = parse_progress(line)
    assert seen is not None
    assert (seen.phase, seen.load, seen.newton, seen.residual, seen.minj) == ("unload", 0.25, 3, 1.2e-4, 0.8)
    assert seen.extra == {"trial": "2"}
    partial = parse_progress("@ progress phase=mesh")
    assert partial is not None
    assert math.isnan(partial.load)
    assert parse_progress("@ progress phase=x load=much") is None


@given(st.text())
def test_any_line_can_be_parsed(line: str) -> None:
    for text in (line, "@ progress " + line, "@ stop " + line, "@ stop kind=" + line):
        parse_progress(text)
        parse_stop(text)


@given(
    st.from_regex(r"[a-z_]{1,20}", fullmatch=True), st.text(st.characters(codec="ascii", exclude_categories=["C"]), min_size=1)
)
def test_stop_line_round_trip(kind: str, message: str) -> None:
    assert parse_stop(f"@ stop kind={kind} message={message}") == (kind, message.strip())
