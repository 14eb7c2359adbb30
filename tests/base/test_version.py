"""One version, wherever it is asked for."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest

import lacli
from lacli.base.version import __version__

ROOT = Path(__file__).parents[2]


def test_the_version_is_one() -> None:
    assert re.fullmatch(r"\d+\.\d+\.\d+", __version__)
    assert lacli.__version__ == importlib.metadata.version("lacli") == __version__
    said = subprocess.run([sys.executable, "-m", "lacli", "--version"], capture_output=True, text=True, timeout=60, check=True)
    assert said.stdout == f"lacli {__version__}\n"


def test_papers_say_the_same_version() -> None:
    citation = ROOT / "CITATION.cff"
    if not citation.is_file():
        pytest.skip("installed without the papers")
    assert f"version: {__version__}" in citation.read_text()
