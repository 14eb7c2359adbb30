"""Derivatives of a run's features: against differences of whole runs; where there are none; what a deck without them holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from shapes import cut_ball

from lacli.anatomy.surface_features import Endocardium
from lacli.anatomy.wall.shell import mesh_shell
from lacli.base.errors import TableError
from lacli.contracts import bundle as bundles
from lacli.contracts.labels import EPI, REGIONS, RINGS
from lacli.contracts.scene import Scene, build_scene, with_parameters
from lacli.contracts.sections import MMHG_KPA
from lacli.freefem.program import FreeFem
from lacli.mechanics import deck, inputs, plan, sensitivities
from lacli.mechanics.numerics import stability
from lacli.mechanics.results import Results, State, transients
from lacli.mechanics.sensitivities import INPUTS, VEIN_SPRING, load_sensitivities
from lacli.mechanics.simulation import RunResult, run_scene

POINT = {
    **{f"c_{name}_kpa": value for name, value in zip(REGIONS, (1.7, 2.0, 1.4, 1.9, 1.5), strict=True)},
    **{f"alpha_{name}": value for name, value in zip(REGIONS, (1.5, 1.2, 1.8, 2.0, 1.4), strict=True)},
    **{"edp_mmhg": 3.0, "esp_mmhg": 8.0, "k_peri_kpa_per_um": 0.001, "pth": 0.75},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle: a ball of 20 mm radius cut at z = 14 mm, wall 2 mm, five regions around z, fibres, a vein, a pericardium."""
    bundle = mesh_shell(cut_ball(), 2.0, 9.0, order=2)
    centre = bundle.points[bundle.tets[:, :4]].mean(axis=1)
    fibre = np.cross([0.3, 0.2, 1.0], centre)
    middle = bundle.points[bundle.triangles[:, :3]].mean(axis=1)
    vein = (bundle.tags == EPI) & (middle[:, 2] < -12) & (middle[:, 0] > 0)
    around = np.floor((np.arctan2(centre[:, 1], centre[:, 0]) / (2 * np.pi) + 0.5) * 4.999).astype(int)
    body = bundle.region <= max(REGIONS.values())
    bundle = replace(
        bundle,
        region=np.where(body, 1 + around, bundle.region),
        fibre=fibre / np.linalg.norm(fibre, axis=1, keepdims=True),
        pericardium_coordinate=np.clip((14.0 - bundle.points[:, 2]) / 34.0, 0, 1),
        transmural=np.clip((np.linalg.norm(bundle.points, axis=1) - 20.0) / 2.0, 0, 1),
        tags=np.where(vein, RINGS["rspv"], bundle.tags),
    )
    target = tmp_path_factory.mktemp("ball")
    bundles.save(bundle, target / "bundle")
    return target


def scene(folder: Path, *overrides: str) -> Scene:
    base = [
        *("motion.annulus=axial", "motion.amplitude_mm=3", "numerics.order=1", "numerics.tolerance_mm=1e-9"),
        *("outputs.fields=none", "outputs.unloaded=false", "outputs.strain=true", "outputs.sensitivities=true"),
    ]
    settings = build_scene({"anatomy": {"bundle": "bundle"}}, [*base, *overrides], folder=folder, where="test")
    return with_parameters(settings, POINT)


def moved(given: Scene, name: str, by: float) -> Scene:
    """The scene with one input moved, and no derivatives asked for."""
    plain = given.model_copy(update={"outputs": given.outputs.model_copy(update={"sensitivities": False})})
    if name == VEIN_SPRING:
        loads = given.loads.model_copy(update={name: given.loads.vein_spring_kpa_per_um + by})
        return plain.model_copy(update={"loads": loads})
    return with_parameters(plain, {name: POINT[name] + by})


def features(result: RunResult, names: list[str]) -> pd.Series:
    """By the names of a table of derivatives."""
    assert result.status == "done", result.message
    frames = pd.read_csv(result.folder / "transients.csv")
    values = {f"{name}@{round(row['time'], 4):g}": row[name] for _, row in frames.iterrows() for name in frames.columns}
    return pd.Series({name: float((values | result.features)[name]) for name in names})


def compare(given: Scene, root: Path, columns: list[str] | None = None) -> None:
    result = run_scene(given, root)
    assert result.status == "done", result.message
    table = load_sensitivities(result.folder)
    assert table is not None and np.isfinite(table.to_numpy()).all()
    assert list(table.columns) == [*POINT, VEIN_SPRING]
    names = list(table.index)
    assert {"esv_ml", "d_global_mm", "fibre_strain_roof", "thickness_change_septum", "volume_ml@0.2", "d_lateral_mm@0.2"} < {
        *names
    }
    assert (table.loc["edv_ml"] == 0).all()  # the image
    for column in columns or table.columns:
        step = 2e-4 * (1.0 if column == "pth" else POINT.get(column, 0.001) * 10)
        ahead, behind = (features(run_scene(moved(given, column, sign * step), root), names) for sign in (1, -1))
        difference = (ahead - behind) / (2 * step)
        error = (table[column] - difference).abs()
        assert difference.abs().max() > 0, column
        assert error.max() < 2e-5 * difference.abs().max(), f"{column}: {error.idxmax()}"


def test_derivatives_are_those_of_whole_runs(freefem: FreeFem, folder: Path, tmp_path: Path) -> None:
    compare(scene(folder, "outputs.frames=2"), tmp_path)


@pytest.mark.slow
def test_derivatives_are_those_of_whole_runs_on_quadratic_cells(freefem: FreeFem, folder: Path, tmp_path: Path) -> None:
    columns = ["c_roof_kpa", "alpha_septum", "edp_mmhg", "esp_mmhg", "k_peri_kpa_per_um", "pth"]
    compare(scene(folder, "outputs.frames=2", "numerics.order=2", "pericardium.outward_only=true"), tmp_path, columns)


def test_without_end_diastolic_pressure_a_little_of_it_is_foreseen(freefem: FreeFem, folder: Path, tmp_path: Path) -> None:
    none = _with_edp(scene(folder), 0.0)
    result = run_scene(none, tmp_path)
    table = load_sensitivities(result.folder)
    assert table is not None
    names = ["esv_ml", "d_global_mm"]
    # one-sided, extrapolated to no step: 2 f(h) - f(2 h) / 2 - 3 / 2 f(0)
    h = 0.01
    at = [features(result, names)]
    at += [features(run_scene(_with_edp(none, k * h), tmp_path), names) for k in (1, 2)]
    difference = (2 * at[1] - 0.5 * at[2] - 1.5 * at[0]) / h
    assert table.loc[names, "edp_mmhg"].to_numpy() == pytest.approx(difference.to_numpy(), rel=1e-3)


def _with_edp(given: Scene, mmhg: float) -> Scene:
    return given.model_copy(update={"loads": given.loads.model_copy(update={"edp_mmhg": mmhg})})


def test_a_deck_that_is_not_asked_has_no_trace(folder: Path) -> None:
    def text(*overrides: str, plugin: Path | None = Path("/tmp/lacli.so")) -> str:
        case = plan.prepare(scene(folder, *overrides))
        return deck.render(case.scene, case.plan, plugin)

    asked = text("outputs.frames=2")
    assert asked.count("tellSensitivities(") == 2 and "wallSensitivities()" in asked
    for bare in (
        text("outputs.sensitivities=false", "outputs.frames=2"),
        text("outputs.frames=2", plugin=None),
        text("numerics.unloading=backward"),
    ):
        assert "ensitivit" not in bare and "wallWrong" not in bare and ".rates" not in bare
    # and what is asked adds lines, changes none
    assert {*text("outputs.sensitivities=false").splitlines()} < {*text().splitlines()}


def test_where_there_are_none_the_run_says_so(freefem: FreeFem, folder: Path, tmp_path: Path) -> None:
    for override, why in (
        ("numerics.engine=script", "compiled engine"),
        ("numerics.unloading=backward", "backward displacement"),
    ):
        result = run_scene(scene(folder, override, "numerics.tolerance_mm=1e-4"), tmp_path)
        assert result.status == "done", result.message
        assert load_sensitivities(result.folder) is None
        for said in (result.features["sensitivities"], result.manifest["sensitivities"]):
            assert said["given"] is False and why in said["why"]
    given = run_scene(scene(folder), tmp_path)
    assert given.manifest["sensitivities"] == {"given": True, "es": "given", "ed_unstable_modes": 0}
    assert sensitivities.FILE in given.manifest["products"]
    assert not list(given.folder.glob("*.rates"))
    assert "sensitivities" not in run_scene(moved(scene(folder), "pth", 0.0), tmp_path).manifest


def test_an_unstable_state_has_none(folder: Path) -> None:
    case = plan.prepare(scene(folder, "outputs.frames=2"))
    numbers = {
        "ed_modes": {"unstable": 7.0},
        "sensitivities_frame001": {"given": 0.0, "unstable": 3.0, "wrong": 0.0},
        "sensitivities_es": {"given": 0.0, "unstable": 0.0, "wrong": 4.0},
    }
    said = sensitivities.statement(case, Results({}, numbers))
    assert said == {
        "given": False,
        "frame001": "none: 3 unstable modes",
        "es": "none: the linear solver failed",
        "ed_unstable_modes": 7,
    }
    assert sensitivities.feature_rates(case, Results({}, numbers), folder) is None


def test_an_unstable_frame_is_told(folder: Path) -> None:
    """Two frames, one of them unstable; without sensitivities nobody knows, and the column is empty there."""
    case = plan.prepare(scene(folder, "outputs.frames=3"))
    state = State(case.bundle.points, case.bundle.points, 1.0, 1.0)
    states = dict.fromkeys(("ed", "frame001", "frame002", "es"), state)
    modes = {"ed_modes": {"unstable": 7.0}, "es_modes": {"unstable": 0.0}}
    frames = {
        "sensitivities_frame001": {"given": 0.0, "unstable": 3.0, "wrong": 0.0},
        "sensitivities_frame002": {"given": 0.0, "unstable": -1.0, "wrong": 0.0},  # cannot be factorised
    }
    known, unknown = Results(states, {**modes, **frames}), Results(states, modes)
    assert transients(case, known)["unstable_modes"].fillna(-9).tolist() == [7, 3, -9, 0]
    assert transients(case, unknown)["unstable_modes"].fillna(-9).tolist() == [7, -9, -9, 0]
    # a third of the way to end-systole
    time = f"{round(case.plan.stretches()[0].time_to / 3, 4):g}"
    assert stability.told(case, known) == {"unstable_frames": {time: 3}}
    assert f"3 at {time} RR" in stability.said_of(stability.told(case, known))
    assert stability.told(case, unknown) == {} and stability.said_of({}) == ""


def test_an_end_diastole_that_settled_without_derivatives_has_none_and_not_zero(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As told where the deck gave those of end-systole alone; those that need end-diastole's are left out with it."""
    case = plan.prepare(scene(folder, "outputs.strain=true"))
    state = State(case.bundle.points, case.bundle.points, 1.0, 1.0)
    monkeypatch.setattr(
        sensitivities, "read_rates", lambda case, name, folder: np.ones((len(INPUTS), len(case.bundle.points), 3))
    )
    for ed, told in (({}, True), ({"sensitivities_ed": {"given": 1.0}}, True), ({"sensitivities_ed": {"given": 0.0}}, False)):
        numbers = {**ed, "sensitivities_es": {"given": 1.0}}
        table = sensitivities.feature_rates(case, Results({"ed": state, "es": state}, numbers), tmp_path)
        assert table is not None and "esv_ml" in table.index
        assert ("edv_ml" in table.index) == told
        assert any(name.startswith("thickness_change") for name in table.index) == told


@pytest.mark.parametrize("order", [1, 2])
def test_rates_of_the_endocardium_s_features(folder: Path, order: int) -> None:
    bundle = plan.prepare(scene(folder, f"numerics.order={order}")).bundle
    random = np.random.default_rng(2)
    bundle = replace(bundle, uac=random.standard_normal((len(bundle.points), 2)))
    x = bundle.points + random.standard_normal(bundle.points.shape)
    moves = random.standard_normal((3, *x.shape))
    endocardium = Endocardium.of(bundle)
    rates = endocardium.rates(x, moves)
    assert rates.keys() == endocardium.features(x).keys()
    h = 1e-5
    for i in range(3):
        ahead, behind = (endocardium.features(x + sign * h * moves[i]) for sign in (1, -1))
        for name in rates:
            assert rates[name][i] == pytest.approx((ahead[name] - behind[name]) / (2 * h), rel=1e-6, abs=1e-7), name


def test_slope_of_the_pericardium_s_weight() -> None:
    xi, settings = np.linspace(0, 1, 101), build_scene({"anatomy": {"bundle": "b"}}, [], folder=Path("/"), where="t").pericardium
    ahead, behind = (inputs.pericardium_weight(xi, settings.model_copy(update={"pth": settings.pth + s})) for s in (1e-6, -1e-6))
    assert inputs.pericardium_weight_slope(xi, settings) == pytest.approx((ahead - behind) / 2e-6, abs=1e-4)
    # halfway up the ramp s = 1/2: -6 s (1 - s) / 0.2 = -7.5
    assert inputs.pericardium_weight_slope(np.array([0.65]), settings)[0] == pytest.approx(-7.5)


def test_pressures_follow_edp_and_esp(folder: Path) -> None:
    for overrides in (
        (),
        ("outputs.conduit=true",),
        ("loads.edp_mmhg=3", "loads.transient_mmhg=[[0.0, 3.0], [0.5, 9.0], [1.0, 3.0]]"),
    ):
        base = scene(folder, "outputs.frames=3", *overrides)
        for phase in plan.prepare(base).plan.phases:
            if base.loads.transient_mmhg is not None:
                assert phase.by_esp == 0 and phase.by_edp == pytest.approx(max(0.0, 1 - phase.time_to / 0.5))
            else:
                assert MMHG_KPA * (3 * phase.by_edp + 8 * phase.by_esp) == pytest.approx(phase.pressure_to)


def test_a_damaged_table_is_refused(tmp_path: Path) -> None:
    assert load_sensitivities(tmp_path) is None
    file = tmp_path / sensitivities.FILE
    for text in ("", "a,b\n1,2\n", "feature,pth\nesv_ml,\n", "feature,pth\nesv_ml,soft\n", "feature,pth\n"):
        file.write_text(text)
        with pytest.raises(TableError, match="simulate again"):
            load_sensitivities(tmp_path)
    file.write_text("feature,pth\nesv_ml,-2.5\n")
    table = load_sensitivities(tmp_path)
    assert table is not None and table.loc["esv_ml", "pth"] == -2.5
