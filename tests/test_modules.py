"""Every module of the package is imported by a test, directly: what none imports, none tests."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = {"lacli.__main__": '"-m", "lacli"'}  # what is run, not imported, and how a test does that


def modules() -> set[str]:
    """Modules that hold something: a package's ``__init__`` counts only where it has code."""
    found = set()
    for file in (ROOT / "lacli").rglob("*.py"):
        parts = file.relative_to(ROOT).with_suffix("").parts
        if parts[-1] != "__init__":
            found.add(".".join(parts))
        elif len(ast.parse(file.read_text(encoding="utf-8")).body) > 1:
            found.add(".".join(parts[:-1]))
    return found


def imported(tree: ast.Module) -> Iterator[str]:
    """Every name that an import of the file could mean as a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_every_module_is_imported_by_a_test() -> None:
    texts = {file: file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("*.py") if file != Path(__file__)}
    seen = {name for text in texts.values() for name in imported(ast.parse(text))}
    run = {name for name, call in PROGRAMS.items() if any(call in text for text in texts.values())}
    assert sorted(modules() - seen - run) == []
