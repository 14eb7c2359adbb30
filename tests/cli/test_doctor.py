"""``lacli doctor``: one table or one document, exit code 1 when something needed is missing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lacli.base.errors import SolverMissingError
from lacli.cli.main import build
from lacli.freefem import plugins
from lacli.freefem import program as ff
from lacli.freefem.program import FreeFem
from lacli.mechanics import installation
from lacli.mechanics.installation import Check


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(build({"doctor"}), ["doctor", *arguments])
    return result.exit_code, result.stdout


def test_everything_is_here(freefem: FreeFem) -> None:
    code, text = run("--json")
    document = json.loads(text)
    names = [check["name"] for check in document["checks"]]
    assert {"FreeFEM", "FreeFEM's plugins", "BLAS", "gmsh", "pictures", "Python packages"} <= set(names)
    missing = [check for check in document["checks"] if check["state"] == "missing"]
    assert document["ok"] == (not missing)
    assert code == (1 if missing else 0)


def test_missing_freefem_is_exit_code_1(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent() -> FreeFem:
        raise SolverMissingError("FreeFEM is not installed")

    monkeypatch.setattr(ff, "find", absent)
    monkeypatch.setattr(installation, "_run_python", lambda code: (True, "1.0"))
    code, text = run("--json")
    document = json.loads(text)
    assert code == 1
    assert not document["ok"]
    assert document["checks"][0] == {
        "name": "FreeFEM",
        "ok": False,
        "found": "FreeFEM is not installed",
        "needed": True,
        "fix": ff.INSTALL,
        "state": "missing",
    }
    code, text = run()
    assert code == 1
    assert ff.INSTALL in text.replace("\n", " ")


def test_reference_blas_and_a_missing_compiler_are_advice(freefem: FreeFem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "blas_library", lambda binary: Path("/usr/lib/x86_64-linux-gnu/blas/libblas.so.3.11.0"))
    check = installation._blas(freefem)
    assert (check.state, check.fix) == ("advice", "sudo apt-get install -y libopenblas0-pthread")
    check = installation._compiler(FreeFem(**{**freefem.__dict__, "compiler": None}))
    assert (check.state, check.fix) == ("advice", "sudo apt-get install -y g++")
    assert "optional" in check.found and "the same numbers" in check.found


def test_only_freefems_kernels_are_compiled_as_its_plugins(freefem: FreeFem, monkeypatch: pytest.MonkeyPatch) -> None:
    sources: list[str] = []
    monkeypatch.setattr(plugins, "compile_plugin", lambda freefem, source, flags: sources.append(source.name))
    assert installation._compiler(freefem).ok
    assert sources == ["lacli.cpp"]


def test_plugins_that_do_not_load_are_named(freefem: FreeFem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "needed_plugins", lambda: ["msh3", "no_such_plugin"])
    (check,) = installation._plugins(freefem)
    assert check.state == "missing"
    assert check.found == "do not load: no_such_plugin"


def test_the_library_gmsh_lacks_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    message = "OSError: libGLU.so.1: cannot open shared object file: No such file or directory"
    monkeypatch.setattr(installation, "_run_python", lambda code: (False, message))
    assert installation._gmsh() == Check("gmsh", False, message, fix="sudo apt-get install -y libglu1-mesa")


def test_code_in_another_process_that_dies() -> None:
    ok, text = installation._run_python("import os; os.abort()")
    assert not ok
    assert "code -6" in text
