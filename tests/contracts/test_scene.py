"""Scenes: exact messages, units converted once, overrides, the parameter table."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.base.errors import SceneError
from lacli.contracts.identity import content_hash
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.parameters import parameter_box
from lacli.contracts.scene import Scene, build_scene, dump_scene, load_scene, with_parameters

HERE = Path("/somewhere")


def scene(*overrides: str, **tables: Any) -> Scene:
    return build_scene({"anatomy": {"bundle": "la"}, **tables}, list(overrides), folder=HERE, where="scene.toml")


finite = st.floats(1e-3, 100)


@given(st.floats(1e-3, 10))
def test_pressure_and_springs_are_converted_once(value: float) -> None:
    made = scene(f"loads.edp_mmhg={value!r}", "loads.esp_mmhg=100.0", f"loads.vein_spring_kpa_per_um={value!r}")
    # 1 mmHg = 133.322 Pa; 1 kPa/um = 1000 kPa/mm
    assert made.loads.edp_kpa == pytest.approx(value * 133.322 / 1000, rel=1e-14)
    assert made.loads.vein_spring_kpa_per_mm == pytest.approx(1000 * value, rel=1e-14)
    stiff = scene(f"pericardium.k_peri_kpa_per_um={value!r}")
    assert stiff.pericardium.k_peri_kpa_per_mm == pytest.approx(1000 * value, rel=1e-14)


def test_ten_mmhg_is_1_33_kpa() -> None:
    assert scene("loads.esp_mmhg=10").loads.esp_kpa == pytest.approx(1.33322, abs=1e-12)


@given(st.sampled_from(BODY_REGIONS), finite)
def test_override_of_one_region_leaves_the_others(name: str, value: float) -> None:
    for start in ({}, {"materials": {"alpha": 2.5}}):
        made = scene(f"materials.alpha.{name}={value!r}", **start)
        expected = dict.fromkeys(BODY_REGIONS, 2.5 if start else 1.0) | {name: value}
        assert made.materials.alpha.model_dump() == expected


@given(finite)
def test_one_number_stands_for_all_regions(value: float) -> None:
    made = scene(f"materials.c_kpa={value!r}")
    assert made.materials.c_kpa.values() == (value,) * 5
    assert made.materials.c_kpa.uniform


@given(st.dictionaries(st.sampled_from(sorted(parameter_box())), st.floats(0, 1), max_size=14))
def test_parameters_land_where_the_table_says(shares: dict[str, float]) -> None:
    box = parameter_box()
    values = {name: low + share * (high - low) for name, share in shares.items() for low, high in [box[name]]}
    made = with_parameters(scene(), values)
    for name, value in values.items():
        if name in ("edp_mmhg", "esp_mmhg"):
            assert getattr(made.loads, name) == value
        elif name in ("k_peri_kpa_per_um", "pth"):
            assert getattr(made.pericardium, name) == value
        elif name.startswith("c_"):
            assert getattr(made.materials.c_kpa, name.split("_")[1]) == value
        else:
            assert getattr(made.materials.alpha, name.removeprefix("alpha_")) == value


@given(st.dictionaries(st.sampled_from(sorted(parameter_box())), st.floats(0, 1), max_size=14))
def test_dumped_scene_reads_back_the_same(shares: dict[str, float]) -> None:
    box = parameter_box()
    made = with_parameters(scene(), {n: box[n][0] + s * (box[n][1] - box[n][0]) for n, s in shares.items()})
    again = build_scene(tomllib.loads(dump_scene(made)), [], folder=HERE, where="again")
    assert again == made
    assert content_hash(again.content()) == content_hash(made.content())


def test_content_has_every_setting_and_no_path() -> None:
    base = content_hash(scene().content())
    assert content_hash(scene("anatomy.bundle='other'").content()) == base
    assert content_hash(scene("numerics.order=1").content()) != base
    assert content_hash(scene("materials.c_kpa.roof=1.71").content()) != base


@given(st.text(max_size=30))
def test_any_override_is_taken_or_refused_by_name(text: str) -> None:
    try:
        made = scene(text)
    except SceneError as error:
        assert str(error)
    else:
        assert isinstance(made, Scene)


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(), lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)
    )
)
def test_any_document_is_taken_or_refused_by_name(value: Any) -> None:
    for table in ("loads", "materials", "anatomy", "numerics", "unknown"):
        try:
            build_scene({"anatomy": {"bundle": "la"}, table: value}, [], folder=HERE, where="scene.toml")
        except SceneError as error:
            assert "scene.toml" in str(error)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ("numerics.settle_ed=true", "numerics.unloading=backward"),
            r'settle_ed would do nothing where .*unloading is "backward"',
        ),
        (("numerics.settle_ed=true", "loads.edp_mmhg=0"), r"settle_ed would do nothing where loads\.edp_mmhg is 0"),
        (("outputs.conduit=true", "outputs.times=[0.2, 0.6]"), r"outputs\.conduit would do nothing beside outputs\.times"),
    ],
)
def test_a_switch_that_would_do_nothing_is_refused(settings: tuple[str, ...], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        scene(*settings)
    for one in settings:  # each alone is taken
        scene(one)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("loads.epd_mmhg=8", r"loads\.epd_mmhg: unknown key; known here: edp_mmhg, esp_mmhg, transient_mmhg, vein_spring"),
        ("load.edp_mmhg=8", r"load: unknown key; known here: anatomy, loads, materials"),
        ("loads.edp_mmhg=-1", r"loads\.edp_mmhg: -1 mmHg is not possible \(allowed: 0 to 100 mmHg\)"),
        ("loads.edp_mmhg=nan", r"loads\.edp_mmhg: .*finite"),
        ("materials.c_kpa.roof=-1", r"materials\.c_kpa\.roof: -1 kPa is not possible \(allowed: 0\.001 to 1000 kPa\)"),
        ("materials.c_kpa.top=1", r"materials\.c_kpa\.top: unknown key; known here: anterior, lateral, posterior, roof, septum"),
        ("pericardium.pth=1.5", r"pericardium\.pth: 1\.5 is not possible \(allowed: 0 to 1\)"),
        ("numerics.order=3", r"numerics\.order: .*1 or 2 \(given: 3\)"),
        ("loads.esp_mmhg=5", r"loads\.esp_mmhg \(5\) is below loads\.edp_mmhg \(8\)"),
        ("loads.transient_mmhg=[[0, 8], [0, 20]]", "increasing times"),
        ("loads.transient_mmhg=[[0, 8], [2, 20]]", r"must lie in \[0, 1\]"),
        ("loads.esp_mmhg=2.7", r"below loads\.edp_mmhg \(8\).*; kPa for mmHg\? 2\.7 kPa are 20\.3 mmHg"),  # 2.7 / 0.133322
        ("loads.esp_mmhg=true", r"loads\.esp_mmhg: .*valid number \(given: True\)"),
        ("loads.esp_mmhg='20'", r"loads\.esp_mmhg: .*valid number \(given: '20'\)"),
        ("loads.transient_mmhg=[[0, 8], [0.5, 2666]]", r"2666 mmHg is not possible.*Pa for mmHg\? 2666 Pa are 20 mmHg"),
        ("loads.edp_mmhg", "write it as key.key=value"),
        ("loads.edp_mmhg.x=1", r"is a value, not a table|valid number"),
    ],
)
def test_messages_name_the_key_and_what_is_allowed(override: str, message: str) -> None:
    base = {"loads": {"edp_mmhg": 8.0}}
    with pytest.raises(SceneError, match=message):
        scene(override, **base)


def test_missing_anatomy_is_named() -> None:
    with pytest.raises(SceneError, match=r"scene\.toml: anatomy: missing"):
        build_scene({}, [], folder=HERE, where="scene.toml")


def test_file_problems_are_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="no such scene file"):
        load_scene(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("[loads\n")
    with pytest.raises(SceneError, match=r"bad\.toml: not valid TOML"):
        load_scene(tmp_path / "bad.toml")
    (tmp_path / "bad.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(SceneError, match="the text is UTF-16"):
        load_scene(tmp_path / "bad.toml")


def test_dates_and_paths_that_are_none_are_named(tmp_path: Path) -> None:
    (tmp_path / "date.toml").write_text('[anatomy]\nbundle = "la"\n[materials]\nbf = 1979-05-27\n')
    with pytest.raises(SceneError, match=r"materials\.bf: .*number"):
        load_scene(tmp_path / "date.toml")
    with pytest.raises(SceneError, match=r"scene\.toml: anatomy\.bundle: no path .*null"):
        build_scene({"anatomy": {"bundle": "la\0"}}, [], folder=tmp_path, where="scene.toml")


def test_bundle_is_relative_to_the_scene_file(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text('[anatomy]\nbundle = "../la"\n')
    assert load_scene(tmp_path / "scene.toml").anatomy.bundle == tmp_path.parent / "la"


def test_parameter_box_is_the_studys() -> None:
    box = parameter_box()
    assert len(box) == 14
    assert box["c_roof_kpa"] == (0.2, 6.8)
    assert box["edp_mmhg"] == (1, 12)
    assert parameter_box(["pth"]) == {"pth": (0.5, 0.95)}
    with pytest.raises(SceneError, match="unknown parameter 'c_top_kpa'; known: c_anterior_kpa"):
        parameter_box(["c_top_kpa"])


def test_parameters_are_validated_again() -> None:
    with pytest.raises(SceneError, match="below loads"):
        with_parameters(scene(), {"edp_mmhg": 12.0, "esp_mmhg": 11.0})
    with pytest.raises(SceneError, match=r"alpha\.roof"):
        with_parameters(scene(), {"alpha_roof": math.nan})


def test_scene_is_frozen() -> None:
    with pytest.raises(Exception, match="frozen"):
        scene().loads.edp_mmhg = 3  # type: ignore[misc]
