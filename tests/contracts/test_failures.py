"""Every kind that a simulation can end with stands in the one list, so that whoever learns from failures knows it."""

from __future__ import annotations

import re
from pathlib import Path

import lacli
from lacli.base import resources
from lacli.contracts.failures import MACHINE, SCENE

# in scripts: stopKind = "kind", which stop(stopKind, ...) tells; stop("kind", ...); a line of the protocol
_STOPS = re.compile(r'stopKind = "(\w+)"|\bstop\("(\w+)"|@ stop kind=(\w+)')
# in Python: what reading results, and judging how FreeFEM ended, gives
_JUDGED = re.compile(r'SimulationError\(\s*"(\w+)"|return "(\w+)", ')


def kinds(text: str, pattern: re.Pattern[str]) -> set[str]:
    return {next(filter(None, found)) for found in pattern.findall(text)}


def test_every_stop_of_a_simulation_s_scripts_is_in_the_list() -> None:
    """Scripts that verify the solver end with kinds of their own, and no run is kept of them."""
    libraries = sorted((resources.folder("solvers") / "freefem").glob("*.idp"))
    text = "\n".join(file.read_text() for file in [*libraries, resources.folder("templates") / "simulation.edp.j2"])
    found = kinds(text, _STOPS)
    assert {"load_step_underflow", "unstable", "mesh_order"} <= found, "the pattern finds each way to stop"
    assert found <= set(SCENE), sorted(found - set(SCENE))


def test_every_end_that_python_tells_is_in_one_of_both_lists() -> None:
    package = Path(lacli.__file__).parent
    files = [package / "freefem" / "run.py", package / "contracts" / "failures.py", *(package / "mechanics").glob("*.py")]
    found = kinds("\n".join(file.read_text() for file in files), _JUDGED)
    assert {"bad_output", "freefem_error", "starved"} <= found
    assert found <= set(SCENE) | set(MACHINE), sorted(found - set(SCENE) - set(MACHINE))
    assert not set(SCENE) & set(MACHINE)
