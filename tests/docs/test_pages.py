"""What the pages name exists (commands, options, keys, functions, files), and pages made from the code are current."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer.main

from lacli import __version__
from lacli.cli import main
from lacli.cli.commands import commands
from lacli.contracts.parameters import BY_KEY
from lacli.contracts.scene import Scene

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)
FILES = (".json", ".npz", ".toml")
CODE = re.compile(r"`([^`\n]+)`")


def _needs(*names: str) -> None:
    for name in names:
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"needs {name}: pip install '.[docs]'")


def test_pages_made_from_the_code_are_current() -> None:
    _needs("grimp")
    done = subprocess.run(
        [sys.executable, ROOT / "docs/generate.py", "--check"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_site_builds_without_a_warning_or_a_network(tmp_path: Path) -> None:
    _needs("sphinx", "myst_parser", "furo", "latex2mathml")
    call = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(ROOT / "docs"), str(tmp_path / "site")]
    done = subprocess.run(call, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    methods = (tmp_path / "site/methods.html").read_text(encoding="utf-8")
    assert "<math" in methods and '<script src="http' not in methods and 'rel="stylesheet" href="http' not in methods
    assert "[box]" in (tmp_path / "site/commands.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    group: Any = typer.main.get_command(main.build(set(commands())))
    for block in SHELL.findall(page.read_text(encoding="utf-8")):
        for line in block.splitlines():
            words = shlex.split(line, comments=True)
            if not words or words[0] != "lacli" or len(words) == 1 or words[1].startswith("-"):
                continue
            assert words[1] in group.commands, line
            known = {name for p in group.commands[words[1]].params for name in (*p.opts, *p.secondary_opts)} | {"--help"}
            for word in words[2:]:
                if re.match(r"--?[a-z]", word):
                    assert word.partition("=")[0] in known, f"{page.name}: {line}: {word}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_of_functions_keys_and_files_exist(page: Path) -> None:
    tables = {name: set(field.annotation.model_fields) for name, field in Scene.model_fields.items()}  # type: ignore[union-attr]
    for name in CODE.findall(page.read_text(encoding="utf-8")):
        if re.fullmatch(r"lacli(\.\w+)+", name):
            module, _, member = name.rpartition(".")
            found = (
                importlib.util.find_spec(name) if module == "lacli" else getattr(importlib.import_module(module), member, None)
            )
            assert found is not None, f"{page.name}: {name}"
        elif re.fullmatch(r"\w+\.\w+( = .+)?", name) and not name.endswith(FILES) and name.partition(".")[0] in tables:
            assert name.partition(".")[2].partition(" = ")[0] in tables[name.partition(".")[0]], f"{page.name}: {name}"
        elif re.fullmatch(r"(lacli|docs|tests|examples|benchmarks|solvers|templates)/[\w./]+", name):
            assert (ROOT / name).exists(), f"{page.name}: {name}"


def test_the_scene_reference_has_every_key_and_a_meaning_of_each() -> None:
    text = (ROOT / "docs/scene.md").read_text(encoding="utf-8")
    for section, field in Scene.model_fields.items():
        for name in field.annotation.model_fields:  # type: ignore[union-attr]
            row = next(line for line in text.splitlines() if line.startswith(f"| `{section}.{name}` |"))
            assert row.rstrip(" |").rpartition("|")[2].strip(), f"{section}.{name} has no meaning"
    assert all(key in text or key.rpartition(".")[0] in text for key in BY_KEY)


def test_the_citation_is_valid_and_of_this_version() -> None:
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"version: {__version__}\n" in text
    assert all(f"\n{key}:" in f"\n{text}" for key in ("cff-version", "message", "title", "authors"))
    assert f"## [{__version__}]" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_version_stands_in_one_place() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["dynamic"] == ["version"] and "version" not in project["project"]
    place = ROOT / project["tool"]["hatch"]["version"]["path"]
    assert f'__version__ = "{__version__}"' in place.read_text(encoding="utf-8")
    assert importlib.metadata.version("lacli") == __version__


def test_the_picture_is_small() -> None:
    assert 10_000 < (ROOT / "docs/result.png").stat().st_size < 200_000
