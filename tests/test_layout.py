"""The house's sizes: a file is read at one sitting, a folder is seen at one glance."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MOST_LINES = 400
MOST_FILES = 14  # __init__.py counted
FOLDERS = sorted({file.parent for room in ("lacli", "tests") for file in (ROOT / room).rglob("*.py")})


def test_the_rooms_are_seen() -> None:
    assert {ROOT / "lacli" / "contracts", ROOT / "lacli" / "cli" / "inference", ROOT / "tests"} <= set(FOLDERS)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(ROOT)))
def test_a_folder_is_small_and_so_are_its_files(folder: Path) -> None:
    files = [file for file in folder.iterdir() if file.is_file() and file.suffix != ".pyc" and not file.name.startswith(".")]
    assert len(files) <= MOST_FILES, sorted(file.name for file in files)
    lines = {file.name: len(file.read_text(encoding="utf-8").splitlines()) for file in files if file.suffix == ".py"}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}


def test_scripts_beside_the_rooms_are_small_too() -> None:
    """Benchmarks and examples are a script each, named by what they measure; their folder is a list, not a room."""
    scripts = [*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "examples").rglob("*.py"), *(ROOT / "docs").glob("*.py")]
    assert scripts
    lines = {file.name: len(file.read_text(encoding="utf-8").splitlines()) for file in scripts}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}


def test_every_room_within_a_room_is_told() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rooms = [str(folder.relative_to(ROOT)) for folder in FOLDERS]
    assert [room for room in rooms if room.startswith("lacli/") and room.count("/") > 1 and f"`{room}`" not in text] == []


def test_no_two_files_of_tests_have_one_name() -> None:
    """pytest imports them by it: the second would not be read."""
    names = [file.name for file in (ROOT / "tests").rglob("*.py") if file.name != "conftest.py"]
    assert {name for name in names if names.count(name) > 1} == set()
