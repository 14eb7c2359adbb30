"""A step of a study is found again by all that determines it: any of it changed, nothing old comes back."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.cohort import study
from lacli.cohort.participants import Participant
from lacli.cohort.steps import Step
from lacli.contracts.tables.covariance import write_covariance
from lacli.contracts.targets import Targets, write_targets

PATIENT = Participant("sub-1", {}, {})
Change = Callable[[Path, Step, pytest.MonkeyPatch], Step]


def _step(home: Path, name: str) -> Step:
    write_targets(home / "targets.toml", Targets(("f",), np.array([1.0]), np.array([0.1])))
    (home / "targets.toml").write_text('covariance = "c.npz"\n' + (home / "targets.toml").read_text())
    write_covariance(home / "c.npz", ["f"], np.array([[0.01]]))
    (home / "anatomy").mkdir()
    for file in ("anatomy/wall.vtu", "anatomy/boundary.vtp", "scene.toml"):
        (home / file).write_text(f"# {file}\n")
    reads = (home / "scene.toml", home / "anatomy", home / "targets.toml")
    return Step(name, (name, "scene.toml", "--ess", "300"), reads, home / "result.json")


def _written(name: str, change: Callable[[bytes], bytes]) -> Change:
    def do(home: Path, step: Step, patch: pytest.MonkeyPatch) -> Step:
        (home / name).write_bytes(change((home / name).read_bytes()))
        return step

    return do


def _argument(home: Path, step: Step, patch: pytest.MonkeyPatch) -> Step:
    return Step(step.name, (*step.arguments[:-1], "400"), step.reads, step.product)


def _covariance(home: Path, step: Step, patch: pytest.MonkeyPatch) -> Step:
    write_covariance(home / "c.npz", ["f"], np.array([[0.010001]]))
    return step


def _renamed(home: Path, step: Step, patch: pytest.MonkeyPatch) -> Step:
    (home / "anatomy" / "wall.vtu").rename(home / "anatomy" / "other.vtu")
    return step


def _patched(name: str, value: Any) -> Change:
    def do(home: Path, step: Step, patch: pytest.MonkeyPatch) -> Step:
        patch.setattr(study, name, value)
        return step

    return do


FILES = ("scene.toml", "anatomy/wall.vtu", "anatomy/boundary.vtp", "targets.toml", "result.json")
CHANGES: dict[str, Change] = {
    "an option": _argument,
    "a file of a folder renamed": _renamed,
    "the covariance that the targets name": _covariance,
    "the version": _patched("__version__", "99"),
    "a method": _patched("METHODS", study.METHODS | {"chain": 99}),
    "FreeFEM's scripts": _patched("solver_digest", lambda: "others"),
}


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_determining_input_changed_nothing_old_comes_back(data: st.DataObject) -> None:
    home = Path(tempfile.mkdtemp())
    done: list[str] = []

    def supervise(command: list[str], **_: Any) -> SimpleNamespace:
        done.append(command[3])
        (home / "result.json").write_text(f"result {len(done)}")
        return SimpleNamespace(cut=None, exit_code=0, cpu_s=1.0, wall_s=1.0, last_lines=())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "supervise", supervise)
        step = _step(home, data.draw(st.sampled_from(["mesh", "track", "calibrate", "compare"])))
        for _ in range(2):
            assert study.run(PATIENT, [step], home / "p", lambda name: None, lambda: True).status == "done"
        assert len(done) == 1, "the same is not done again"
        what = data.draw(st.sampled_from([*CHANGES, *FILES]))
        if what in CHANGES:
            step = CHANGES[what](home, step, patch)
        else:
            extra = data.draw(st.binary(min_size=1, max_size=3))
            step = _written(what, lambda content: content + b"#" + extra.hex().encode())(home, step, patch)
        outcome = study.run(PATIENT, [step], home / "p", lambda name: None, lambda: True)
        if what == "FreeFEM's scripts" and step.name != "calibrate":
            assert outcome.status == "done" and len(done) == 1
        else:
            assert outcome.status == "failed" and "choose another --out, or remove" in outcome.reason, what
            assert len(done) == 1
    shutil.rmtree(home)
