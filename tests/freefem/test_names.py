"""Numbers that scripts, templates, the compiled engine and Python share are the same everywhere, and scripts name them."""

from __future__ import annotations

import re
from enum import IntEnum

import pytest

from lacli.base import resources
from lacli.contracts.labels import REGIONS
from lacli.contracts.laws import NUMBER
from lacli.freefem.names import Faces, Rates, Task
from lacli.mechanics.inputs import CELL_COLUMNS, Cell

SOLVERS = resources.folder("solvers") / "freefem"
SCRIPTS = sorted([*SOLVERS.glob("*.idp"), *resources.folder("templates").glob("*.j2")])
NAMES = {
    name: int(value) for name, value in re.findall(r"(\w+) = (\d+)[,;]", (SOLVERS / "names.idp").read_text(encoding="utf-8"))
}
# places where a task, a kind of faces, what is sought, or a search's end stands in a script
PLACES = (
    r"\bassemble\(\d", r"\bengineFaces\(\d", r"faceKind\[set\] [=!]= \d", r"tripletKind == \d", r"failed == [1-9]",
    r"\b(?:task|tangentTask|residualTask|sought) [=!<>]=? ?\d", r"table\[at \+ \d", r"\bs\[\d\]",
    r"(?:equilibrate|runPhase)\(.*, \d, \d, (?:\w*[tT]olerance|\{\{ tolerance|0\.)",
)  # fmt: skip


def enum_of(file: str, name: str) -> dict[str, int]:
    """An enum of the plugin: name -> number."""
    text = (SOLVERS / "plugin" / file).read_text(encoding="utf-8")
    found = re.search(rf"enum {name} {{(.*?)}};", text, re.DOTALL)
    assert found, name
    numbers: dict[str, int] = {}
    following = 0
    for item in found[1].split(","):
        key, _, value = (part.strip() for part in item.partition("="))
        following = eval(value, {}, numbers) if value else following
        numbers[key] = following
        following += 1
    return numbers


def camel(prefix: str, name: str) -> str:
    return prefix + "".join(word.capitalize() for word in name.split("_"))


@pytest.mark.parametrize(("prefix", "table"), [("task", Task), ("faces", Faces), ("rates", Rates)])
def test_scripts_and_python_agree(prefix: str, table: type[IntEnum]) -> None:
    assert {camel(prefix, one.name): int(one) for one in table} == {k: v for k, v in NAMES.items() if k.startswith(prefix)}


def test_columns_laws_and_regions_are_python_s() -> None:
    columns = [NAMES[f"cell{name}"] for name in ("Law", "C", "Alpha", "Bf", "Kp", "Kq", "Fibre", "Stab", "Length")]
    assert columns == [
        Cell.LAW, Cell.C, Cell.ALPHA, Cell.CONSTANTS, Cell.KAPPA_POINTS, Cell.KAPPA_FIELD, Cell.FIBRE, Cell.STABILISATION,
        CELL_COLUMNS,
    ]  # fmt: skip
    assert (NAMES["lawGuccione"], NAMES["lawNeoHookean"]) == (NUMBER["guccione"], NUMBER["neo_hookean"])
    assert NAMES["regionLast"] == max(REGIONS.values())


def test_the_compiled_engine_s_numbers_are_the_same() -> None:
    assert enum_of("lacli.cpp", "Asked") == {one.name: int(one) for one in Task if one is not Task.KEEP_PRESTRAIN}
    surfaces = {"PRESSURE": "PRESSURE", "VEIN_SPRING": "VEINS", "PERICARDIUM": "PERICARDIUM", "PERICARDIUM_OUTWARD": "OUTWARD"}
    assert {surfaces[key]: value for key, value in enum_of("elements.hpp", "Surface").items()} == {f.name: int(f) for f in Faces}
    told = ("MinJ", "MinJX", "Energy", "Volume", "Negative", "Length")
    assert list(enum_of("lacli.cpp", "Told").values()) == [NAMES[f"tells{name}"] for name in told]
    columns = enum_of("lacli.cpp", "CellColumn")
    assert [columns[k] for k in ("LAW", "STIFFNESS", "EXPONENT", "CONSTANTS", "KAPPA_POINTS", "KAPPA_FIELD", "FIBRE")] == [
        Cell.LAW, Cell.C, Cell.ALPHA, Cell.CONSTANTS, Cell.KAPPA_POINTS, Cell.KAPPA_FIELD, Cell.FIBRE,
    ]  # fmt: skip


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_script_says_names_not_numbers(script: object) -> None:
    lines = [line.split("//")[0] for line in script.read_text(encoding="utf-8").splitlines()]  # type: ignore[attr-defined]
    assert [line for line in lines if any(re.search(place, line) for place in PLACES)] == []
