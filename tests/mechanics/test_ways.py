"""The way from end-diastole to the states: forward where they are near each other, else from end-systole backward."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from shapes import cut_ball

from lacli.anatomy.wall.shell import mesh_shell
from lacli.contracts import bundle as bundles
from lacli.contracts.scene import Scene, build_scene
from lacli.freefem.program import FreeFem
from lacli.mechanics import deck, plan
from lacli.mechanics.results import TRANSIENTS
from lacli.mechanics.simulation import RunResult, run_scene

NEAR = '  if (nearby(1, "reservoir", soughtPositions, taskSymmetric, tightTolerance)) found = 1;\n'


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


def test_the_way_back_has_the_same_states(folder: Path) -> None:
    whole = plan.prepare(scene(folder, "outputs.frames=4")).plan
    up = {phase.file: phase for phase in whole.phases if phase.name == "reservoir"}
    assert [phase.file for phase in whole.back] == ["es", "frame003", "frame002", "frame001"]
    for phase in whole.back:
        forward = up[phase.file]
        assert (phase.pressure_to, phase.time_to, phase.by_edp) == (forward.pressure_to, forward.time_to, forward.by_edp)
    # 3 to 8 mmHg in four parts; from 3 at once, then each from the one after it
    at = [round(phase.pressure_from / whole.phases[0].pressure_to * 3, 6) for phase in whole.back]
    assert at == [3.0, 8.0, 6.75, 5.5]
    assert [round(phase.time_from, 6) for phase in whole.back] == [0.0, 0.4, 0.3, 0.2]


def test_one_state_needs_no_way_back(folder: Path) -> None:
    alone = plan.prepare(scene(folder, "outputs.frames=0", "outputs.conduit=false"))
    assert alone.plan.back == ()
    assert "nearby" not in deck.render(alone.scene, alone.plan, None)


@pytest.mark.parametrize("engine", ["plugin", "script"])
def test_both_ways_find_the_same(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: str, freefem: FreeFem
) -> None:
    given = scene(folder, "outputs.frames=3", f"numerics.engine={engine}")
    forward = run_scene(given, tmp_path / "forward")
    render = deck.render

    def without(*words: object) -> str:
        text = render(*words)  # type: ignore[arg-type]
        assert NEAR in text
        return text.replace(NEAR, "")

    monkeypatch.setattr(deck, "render", without)
    backward = run_scene(given, tmp_path / "backward")
    assert (forward.status, backward.status) == ("done", "done")
    pd.testing.assert_frame_equal(transients(forward), transients(backward), rtol=1e-9, atol=1e-8)
    assert transients(backward)["time"].is_monotonic_increasing


def transients(result: RunResult) -> pd.DataFrame:
    return pd.read_csv(result.folder / TRANSIENTS)
