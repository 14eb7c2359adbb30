"""A signal at every line of the program's frame: before, between and after all that a command does, one message is said."""

from __future__ import annotations

import ast
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from lacli.base.processes import signals
from lacli.cli import main

# in a child for each moment: run the program, and at that line be shot
PROGRAM = """
import json, os, signal, sys
from lacli.base.processes import signals
from lacli.cli import main
file, line, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
sys.argv = ["lacli", "--version"]
main.build({"doctor"})
shots = []
def trace(frame, event, arg):
    if frame.f_code.co_filename != file:
        return None
    # the line a function is defined at is that of its call: there a signal finds us on the way in
    if frame.f_lineno == line and event in ("call", "line") and not shots:
        shots.append(event)
        os.kill(os.getpid(), number)
    return trace
sys.settrace(trace)
main.run()
"""
# what answers a signal, or runs in a thread beside
ANSWERS = {
    "_on_signal",
    "_on_alarm",
    "_raise",
    "_importing",
    "_unraisable",
    "_in_thread",
    "_uncaught",
    "_watch",
    "_leave",
    "held",
}


def moments() -> list[tuple[str, int]]:
    """File and line of every statement and definition that runs when a command that does nothing is called."""
    wanted = {main.__file__: {"run", "_code_of_the_command", "_caches"}, signals.__file__: {"settle", "leave"}}
    found = []
    for file, names in wanted.items():
        for function in ast.parse(Path(file).read_text()).body:
            if isinstance(function, ast.FunctionDef) and function.name in names and function.name not in ANSWERS:
                lines = {node.lineno for node in ast.walk(function) if isinstance(node, ast.stmt)}
                found += [(file, line) for line in sorted(lines | {function.lineno})]
    return found


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_no_moment_of_the_program_answers_a_signal_with_a_traceback(number: signal.Signals) -> None:
    source = Path(main.__file__).read_text().splitlines()
    taken_over = next(i for i, text in enumerate(source, 1) if "signals.catch()" in text)
    wrong, hit = {}, 0
    waiting = moments()
    while waiting:
        some, waiting = waiting[:4], waiting[4:]
        children = [
            # -P: what is installed is shot, not a checkout that is the working folder
            (place, subprocess.Popen(
                [sys.executable, "-P", "-c", PROGRAM, place[0], str(place[1]), str(int(number))],
                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            ))
            for place in some
        ]  # fmt: skip
        for place, child in children:
            _, said = child.communicate(timeout=30)
            if child.returncode == 0 and not said:
                continue  # the line is not run by this command
            if child.returncode == -number and place[1] <= taken_over:
                continue  # it is not ours yet
            hit += 1
            if child.returncode != 128 + number or said.count("lacli: ") != 1 or said.count("\n") != 1:
                wrong[f"{Path(place[0]).name}:{place[1]}"] = (child.returncode, said[-800:])
    assert not wrong, json.dumps(wrong, indent=1)
    assert hit > 20
