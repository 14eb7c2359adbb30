"""A step of a study is found again by all that determines it: any of it changed, nothing old comes back."""

from __future__ import annotations

import importlib
import shutil
import tempfile
import typing
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.anatomy.inputs.parts import parts
from lacli.cli.commands import commands
from lacli.cohort import study
from lacli.cohort.participants import Participant
from lacli.cohort.steps import COMMANDS, OURS, READ, WRITTEN, Settings, Step, steps_of
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
    "the model of discretisation errors": _patched("coefficients", lambda: {"error_model": {"held": 0.5}}),
    "the ways that an annulus can be wrong": _patched("ANNULUS_MODES", 7),
    "how frames are registered": _patched("ENGINES", {"greedy": SimpleNamespace(settings="others")}),
}
OF_ONE_STEP = {
    "FreeFEM's scripts": "calibrate", "the model of discretisation errors": "calibrate",
    "the ways that an annulus can be wrong": "calibrate", "how frames are registered": "track",
}  # fmt: skip


@settings(max_examples=80, deadline=None)
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
        if step.name != OF_ONE_STEP.get(what, step.name):
            assert outcome.status == "done" and len(done) == 1
        else:
            assert outcome.status == "failed" and "choose another --out, or remove" in outcome.reason, what
            assert len(done) == 1
    shutil.rmtree(home)


@pytest.mark.parametrize(
    ("name", "content", "behind"),
    [
        ("ct.mhd", "NDims = 3\nElementDataFile = voxels.raw\n", ["voxels.raw"]),
        ("ct.mhd", "NDims = 3\nElementDataFile = LIST\na.raw\nb.raw\n", ["a.raw", "b.raw"]),
        ("ct.mhd", "NDims = 3\nElementDataFile = s%02d.raw 1 2 1\n", ["s01.raw", "s02.raw"]),
        ("ct.nhdr", "NRRD0004\ndata file: voxels.raw.gz\n", ["voxels.raw.gz"]),
        ("ct.hdr", "header", ["ct.img"]),
        ("la.elem", "0", ["la.lon", "la.pts"]),
        ("la.elem.gz", "0", ["la.pts.gz"]),
        ("ct.mha", "NDims = 3\nElementDataFile = LOCAL\n", []),
        ("ct.nrrd", "NRRD0004\n\n", []),
        ("ct.nii.gz", "", []),
    ],
)
def test_data_behind_a_header_count(tmp_path: Path, name: str, content: str, behind: list[str]) -> None:
    (tmp_path / name).write_text(content)
    for file in behind:
        (tmp_path / file).write_text("1")
    assert parts(tmp_path / name) == [tmp_path / file for file in behind]
    step = Step("mesh", ("mesh", name), (tmp_path / name,), tmp_path / "anatomy")
    before = study._digests(step)
    for file in behind:
        (tmp_path / file).write_text("2")
        after = study._digests(step)
        assert after != before, file
        before = after


def test_files_that_options_name_count(tmp_path: Path) -> None:
    for name in (
        "targets.toml",
        "scene.toml",
        "box.toml",
        "la/wall.vtu",
        "patient/marks.toml",
        "coarse/wall.vtu",
        "runs/old.csv",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    paths = {"bundle": tmp_path / "la", "uniform": tmp_path / "thin" / "la", "targets": tmp_path / "targets.toml"}
    (tmp_path / "thin" / "coarse").mkdir(parents=True)
    options = {
        "calibrate": {
            "box": str(tmp_path / "box.toml"), "cheap": ["order=1", "anatomy.bundle = coarse"], "store": str(tmp_path / "runs"),
            "set": ["numerics.order=2"], "max-runs": 20,
        },
        "mesh": {"landmarks": "marks.toml", "fibres": "uac", "labels": "la=2," + 300 * "x"},
    }  # fmt: skip
    first, uniform, compare = steps_of(
        Participant("a", paths, {}), Settings(options), tmp_path / "patient", tmp_path / "scene.toml"
    )
    assert first.reads[3:] == (tmp_path / "box.toml", tmp_path / "coarse")
    assert uniform.reads[3:] == (tmp_path / "box.toml", tmp_path / "thin" / "coarse")
    assert len(compare.reads) == 3, "its own"
    labels = {"labels": tmp_path / "box.toml", "targets": tmp_path / "targets.toml"}
    mesh, *_ = steps_of(Participant("a", labels, {}), Settings(options), tmp_path / "patient", tmp_path / "scene.toml")
    assert mesh.reads == (tmp_path / "box.toml", tmp_path / "patient" / "marks.toml")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_that_is_a_path_is_known(command: str) -> None:
    """A new one is read, so that its content counts, or written, or no option that all patients can share."""
    hints = typing.get_type_hints(importlib.import_module(commands()[command].module).command, include_extras=True)
    options = [(name, hint) for name, hint in hints.items() if "Path" in str(hint) and "OptionInfo" in str(hint)]
    taken = set()
    for name, hint in options:
        told = (hint.__metadata__[0].default, *(hint.__metadata__[0].param_decls or ()), f"--{name}")
        taken.add(next(text for text in told if isinstance(text, str) and text[:2] == "--").removeprefix("--"))
    assert taken <= {*READ, *WRITTEN, *OURS}
