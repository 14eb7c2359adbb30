"""The table of parameters: each quantity's limits hold where it is read, and a slip of units is named."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from lacli.base.errors import SceneError, UsageError
from lacli.contracts.parameters import BY_KEY, QUANTITIES, STUDY, Quantity, axis_label, judge
from lacli.contracts.scene import Scene, build_scene, notes, with_parameters
from lacli.contracts.sections import PerRegion
from lacli.inference import box

EVERY = list(QUANTITIES.values())
BASE = {"anatomy": {"bundle": "la"}}


def scene(*overrides: str) -> Scene:
    return build_scene(BASE, list(overrides), folder=Path("/"), where="scene.toml")


def with_value(quantity: Quantity, value: float) -> Scene:
    """A scene with this value, whose other values go with it (ESP above EDP, kappa above its part at the points)."""
    others = {
        "loads.edp_mmhg": ["loads.esp_mmhg=200"],
        "loads.esp_mmhg": ["loads.edp_mmhg=0"],
        "materials.kappa_kpa": ["numerics.kappa_points_kpa=0"],
        "numerics.kappa_points_kpa": ["materials.kappa_kpa=500000"],
    }.get(quantity.key, [])
    return scene(*others, f"{quantity.key}={int(value) if quantity.whole else repr(value)}")


def said(quantity: Quantity, value: float) -> str:
    """What is said about the value: the error, or the note."""
    try:
        made = with_value(quantity, value)
    except SceneError as error:
        assert str(error).startswith(f"scene.toml: {quantity.key}: ")
        return str(error)
    return " ".join(note for note in notes(made) if note.startswith(f"{quantity.key}: "))


def beyond(quantity: Quantity, bound: float, up: bool) -> float:
    if quantity.whole:
        return bound + (1 if up else -1)
    return math.nextafter(bound, math.inf if up else -math.inf)


def numbers(model: type[BaseModel], place: str = "") -> set[str]:
    """The keys of all numbers of a model."""
    found = set()
    for name, field in model.model_fields.items():
        key = f"{place}.{name}".lstrip(".")
        kind: Any = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            found |= numbers(kind, key)
        elif kind in (int, float):
            found.add(key)
    return found


def test_every_number_of_a_scene_is_in_the_table() -> None:
    assert numbers(Scene) == set(BY_KEY)


@pytest.mark.parametrize("quantity", EVERY, ids=lambda q: q.key)
def test_ranges_are_nested_and_hold_the_default(quantity: Quantity) -> None:
    assert quantity.possible[0] <= quantity.plausible[0] <= quantity.plausible[1] <= quantity.possible[1]
    value: Any = scene()
    for part in quantity.key.split("."):
        value = getattr(value, part)
    assert value == quantity.default
    assert judge(quantity, quantity.default) == ("fine", "")
    if quantity.study:
        assert quantity.plausible[0] <= quantity.study[0] < quantity.study[1] <= quantity.plausible[1]
    if quantity.off:
        assert quantity.possible[0] == 0
        assert judge(quantity, 0.0) == ("fine", "")


def test_a_usual_scene_needs_no_words() -> None:
    assert notes(scene()) == []
    ends = [{name: QUANTITIES[name].study[end] for name in STUDY} for end in (0, 1)]  # type: ignore[index]
    assert [notes(with_parameters(scene(), values)) for values in ends] == [[], []]


@pytest.mark.parametrize("up", [False, True])
@pytest.mark.parametrize("quantity", EVERY, ids=lambda q: q.key)
def test_the_possible_range_is_closed_and_what_lies_beyond_is_refused(quantity: Quantity, up: bool) -> None:
    bound = quantity.possible[up]
    with_value(quantity, bound)
    value = beyond(quantity, bound, up)
    with pytest.raises(SceneError) as caught:
        with_value(quantity, value)
    low, high = quantity.possible
    assert f"{quantity.key}: " in str(caught.value)
    assert "is not possible" in str(caught.value)
    assert f"{low:g} to {high:g}" in str(caught.value)


@pytest.mark.parametrize("up", [False, True])
@pytest.mark.parametrize("quantity", EVERY, ids=lambda q: q.key)
def test_beyond_the_plausible_range_there_is_a_note(quantity: Quantity, up: bool) -> None:
    bound = quantity.plausible[up]
    assert said(quantity, bound) == ""
    value = beyond(quantity, bound, up)
    words = said(quantity, value)
    if quantity.possible[up] == bound:
        assert "is not possible" in words
    else:
        assert "is unusual" in words
        assert f"{quantity.plausible[0]:g} to {quantity.plausible[1]:g}" in words


# slips that stay within the plausible range: nothing in the number tells
_HIDDEN = {
    ("edp_mmhg", "kPa"),  # 8 mmHg are 1.07 kPa; ESP, given in the same unit, tells
    ("plane_c_kpa", "MPa"),
    ("tolerance_mm", "m"),  # 1e-4 mm are 1e-7 m
    ("tolerance_mm", "cm"),
    ("timeout_s", "min"),
}


@pytest.mark.parametrize(
    ("quantity", "unit", "factor"),
    [
        pytest.param(q, slip.unit, slip.factor, id=f"{q.key} in {slip.unit}")
        for q in EVERY
        for slip in q.slips
        if (q.name, slip.unit) not in _HIDDEN
    ],
)
def test_the_usual_value_in_another_unit_is_named(quantity: Quantity, unit: str, factor: float) -> None:
    words = said(quantity, float(f"{quantity.default / factor:.6g}"))
    ending = f" for {quantity.unit}?" if quantity.shown_unit else "?"
    units, _, read = words.rpartition("; ")[2].partition(ending)
    assert unit in units.removeprefix("given in ").split(" or ")
    assert f" {unit} are {quantity.default:.3g}" in read or f" {unit} is {quantity.default:.3g}" in read


def test_the_hidden_slips_are_hidden() -> None:
    for name, unit in _HIDDEN:
        slip = next(s for s in QUANTITIES[name].slips if s.unit == unit)
        assert said(QUANTITIES[name], QUANTITIES[name].default / slip.factor) == ""


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("loads.esp_mmhg=800", "800 mmHg is not possible (allowed: 0 to 200 mmHg); Pa for mmHg? 800 Pa are 6 mmHg"),
        ("loads.esp_mmhg=1e9", "1e+09 mmHg is not possible (allowed: 0 to 200 mmHg)"),
        (
            "materials.c_kpa=1700",
            "materials.c_kpa: 1700 kPa is not possible (allowed: 0.001 to 1000 kPa); Pa or dyn/cm² for kPa? 1700 Pa are 1.7",
        ),
        ("materials.bf=1e9", "1e+09 is not possible (allowed: 0.001 to 500)"),
        ("materials.kappa_kpa=1e15", "1e+15 kPa is not possible"),
        ("loads.vein_spring_kpa_per_um=1e12", "1e+12 kPa/µm is not possible (allowed: 0 to 10 kPa/µm)"),
        ("pericardium.k_peri_kpa_per_um=1e12", "1e+12 kPa/µm is not possible"),
        ("motion.amplitude_mm=1e6", "1e+06 mm is not possible (allowed: 0 to 60 mm)"),
        ("motion.amplitude_mm=8000", "µm for mm? 8000 µm are 8 mm"),
        ("pericardium.pth=75", "given in %? 75 % are 0.75"),
    ],
)
def test_what_was_planned_without_a_word(override: str, words: str) -> None:
    with pytest.raises(SceneError) as caught:
        scene(override)
    assert override.partition("=")[0] in str(caught.value)
    assert words in str(caught.value)


def test_five_regions_of_one_value_are_said_once() -> None:
    assert notes(scene("materials.c_kpa=300")) == [
        "materials.c_kpa: 300 kPa is unusual (plausible: 0.02 to 60 kPa); "
        "Pa or dyn/cm² for kPa? 300 Pa are 0.3 kPa, 300 dyn/cm² are 0.03 kPa."
    ]
    (note,) = notes(scene("materials.c_kpa.roof=300"))
    assert note.startswith("materials.c_kpa.roof: ")


def test_parameters_by_name_keep_the_limits() -> None:
    assert with_parameters(scene(), {"kappa_kpa": 2000.0}).materials.kappa_kpa == 2000.0
    with pytest.raises(SceneError, match=r"materials\.c_kpa\.roof: 1700 kPa is not possible"):
        with_parameters(scene(), {"c_roof_kpa": 1700.0})
    with pytest.raises(SceneError, match="unknown parameter 'c_top_kpa'"):
        with_parameters(scene(), {"c_top_kpa": 1.0})


def test_a_box_keeps_the_limits() -> None:
    with pytest.raises(UsageError, match=r"box: c_roof_kpa: .* not possible .*6800 Pa are 6\.8 kPa, 6800 dyn/cm² are 0\.68 kPa"):
        box.make_box(["c_roof_kpa"], [200.0], [6800.0])
    odd = box.make_box(["esp_mmhg", "mine"], [1.7, 0.0], [4.9, 1e9])
    assert [note.partition("?")[0] for note in box.notes(odd)] == [
        f"box: esp_mmhg: {value} mmHg is unusual (plausible: 5 to 70 mmHg); kPa for mmHg" for value in (1.7, 4.9)
    ]
    assert box.notes(box.published_box(STUDY)) == []


def test_labels_of_axes() -> None:
    assert axis_label("c_roof_kpa") == r"$C_\mathrm{roof}$ (kPa)"
    assert axis_label("pth") == r"$P_\mathrm{TH}$ (-)"
    assert axis_label("mine") == "mine"
    assert issubclass(type(scene().materials.c_kpa), PerRegion)
