"""The way to the states: end-systole from end-diastole at once, earlier frames from it backward, later ones forward."""

from __future__ import annotations

import itertools
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from shapes import cut_ball

from lacli.anatomy.wall.shell import mesh_shell
from lacli.contracts import bundle as bundles
from lacli.contracts.case import Plan
from lacli.contracts.scene import Scene, build_scene
from lacli.contracts.sections import MMHG_KPA
from lacli.freefem.program import FreeFem
from lacli.mechanics import deck, plan
from lacli.mechanics.results import TRANSIENTS
from lacli.mechanics.simulation import RunResult, run_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle: a ball of 20 mm radius cut at z = 14 mm, wall 2 mm."""
    target = tmp_path_factory.mktemp("ways")
    bundles.save(mesh_shell(cut_ball(), 2.0, 9.0), target / "bundle")
    return target


def scene(folder: Path, *overrides: str) -> Scene:
    base = [
        *(
            "motion.annulus=axial",
            "motion.amplitude_mm=3",
            "motion.es_time=0.4",
            "numerics.order=1",
            "numerics.tolerance_mm=1e-9",
        ),
        *("materials.bf=6", "materials.bft=6", "materials.bt=6"),
        *("loads.edp_mmhg=3", "loads.esp_mmhg=8", "pericardium.k_peri_kpa_per_um=0", "loads.vein_spring_kpa_per_um=0"),
        *("outputs.fields=none", "outputs.unloaded=false", "outputs.conduit=true"),
    ]
    return build_scene({"anatomy": {"bundle": "bundle"}}, [*base, *overrides], folder=folder, where="test")


def test_end_systole_comes_first_and_earlier_frames_from_it_backward(folder: Path) -> None:
    phases = plan.prepare(scene(folder, "outputs.frames=4")).plan.stretches()
    reservoir = [phase for phase in phases if phase.name == "reservoir"]
    assert [phase.file for phase in reservoir] == ["es", "frame003", "frame002", "frame001"]
    assert [phase.start for phase in reservoir] == ["ed", "es", "frame003", "frame002"]
    # 3 to 8 mmHg in four parts; from 3 at once, then each from the one after it
    at = [(round(phase.pressure_from / MMHG_KPA, 6), round(phase.pressure_to / MMHG_KPA, 6)) for phase in reservoir]
    assert at == [(3.0, 8.0), (8.0, 6.75), (6.75, 5.5), (5.5, 4.25)]
    assert [round(phase.time_from, 6) for phase in reservoir] == [0.0, 0.4, 0.3, 0.2]
    conduit = [phase for phase in phases if phase.name == "conduit"]
    assert [conduit[0].start, conduit[0].time_from] == ["es", 0.4]
    assert [phase.file for phase in conduit] == ["frame005", "frame006", "frame007", "frame008"]


@pytest.mark.parametrize("engine", ["plugin", "script"])
def test_frames_that_are_asked_for_do_not_change_end_systole(folder: Path, tmp_path: Path, engine: str, freefem: FreeFem) -> None:
    alone, framed = (
        run_scene(scene(folder, f"outputs.frames={frames}", f"numerics.engine={engine}"), tmp_path) for frames in (0, 3)
    )
    assert (alone.status, framed.status) == ("done", "done")
    for key in ("esv_ml", "d_global_mm"):
        assert framed.features[key] == alone.features[key]  # the very same systems, to the last digit


def test_every_way_finds_what_is_unique(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, freefem: FreeFem) -> None:
    given = scene(folder, "outputs.frames=3")
    backward = run_scene(given, tmp_path / "backward")
    made = plan.make_plan

    def forward(*words: object) -> Plan:
        whole = made(*words)  # type: ignore[arg-type]
        load, *rest = whole.phases
        rest = sorted(rest, key=lambda phase: phase.time_to)
        ways = [
            replace(phase, start=before.file, pressure_from=before.pressure_to, time_from=before.time_to)
            for before, phase in itertools.pairwise([load, *rest])
        ]
        return replace(whole, phases=(load, *ways))

    monkeypatch.setattr(plan, "make_plan", forward)
    other = run_scene(given, tmp_path / "forward")
    assert (backward.status, other.status) == ("done", "done")
    pd.testing.assert_frame_equal(transients(other), transients(backward), rtol=1e-8, atol=1e-7)
    assert transients(backward)["time"].is_monotonic_increasing


def transients(result: RunResult) -> pd.DataFrame:
    return pd.read_csv(result.folder / TRANSIENTS)


def test_where_a_tangent_cannot_be_solved_the_damped_one_is_tried(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, freefem: FreeFem
) -> None:
    """A linear solver that fails on every tangent of the plain Newton method: the viscous one's are others, and find the same."""
    given = scene(folder, "outputs.frames=1", "outputs.conduit=false")
    whole = run_scene(given, tmp_path / "whole")
    libraries = shutil.copytree(deck.libraries(), tmp_path / "libraries")
    newton = (libraries / "newton.idp").read_text()
    solved = "if (fresh) error = solveLinear(rightSide, z);"
    assert newton.count(solved) == 1
    (libraries / "newton.idp").write_text(newton.replace(solved, "if (fresh) error = 1;"))
    monkeypatch.setattr(deck, "libraries", lambda: libraries)
    broken = run_scene(given, tmp_path / "broken")
    assert broken.status == "done", (broken.kind, broken.message)
    said = (broken.folder / "solver.log").read_text()
    assert "kind=linear_solver rung=viscous" in said and "rung=shorter_moves" not in said
    for key in ("edv_ml", "esv_ml", "d_global_mm"):
        assert broken.features[key] == pytest.approx(whole.features[key], rel=1e-7)
