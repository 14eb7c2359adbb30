"""The worked examples of CONTRIBUTING.md, in a copy of the project."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The project's code, to be changed."""
    for name in ("lacli", "solvers", "templates"):
        shutil.copytree(ROOT / name, tmp_path / "copy" / name, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "copy"


def _python(copy: Path, *words: str) -> str:
    environment = os.environ | {"PYTHONPATH": str(copy)}
    done = subprocess.run(
        [sys.executable, *words], cwd=copy, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_command_is_one_file(copy: Path) -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    example = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert example
    (copy / "lacli/cli/anatomy/volume.py").write_text(example[1])
    assert "Print the volume of a bundle's cavity" in _python(copy, "-m", "lacli", "--help")
    _python(copy, "-m", "lacli", "synthesize", "atrium", "--cell-size-mm", "8", "--order", "1", "--volume-ml", "80")
    volume = json.loads(_python(copy, "-m", "lacli", "volume", "atrium", "--json"))["volume_ml"]
    assert volume == pytest.approx(80.0, rel=0.15)  # straight 8 mm cells cut the corners of a cavity of 80 mL


def test_a_feature_is_two_lines_in_two_files(copy: Path) -> None:
    table, measure = copy / "lacli/contracts/features.py", copy / "lacli/anatomy/surface_features.py"
    for file, line, new in (
        (table, '    "n_{}_mm": (', '    "z_{}_mm": ("mm", "mean of u along z"),\n'),
        (measure, "        # each region's mean of every field\n", '        fields["z_{}_mm"] = moved[..., 2]\n'),
    ):
        text = file.read_text(encoding="utf-8")
        assert text.count(line) == 1
        file.write_text(text.replace(line, new + line))
    script = (
        "from lacli.synthetic.atrium import synthesize\nfrom lacli.anatomy.surface_features import surface_features\n"
        "from lacli.contracts.features import KEYS\n"
        "bundle, _ = synthesize(3, cell_size_mm=8.0, order=1)\n"
        "found = surface_features(bundle, bundle.points, bundle.points + [0.0, 0.0, 2.5])\n"
        "print(found['z_roof_mm'], KEYS['z_roof_mm'].unit)\n"
    )
    value, unit = _python(copy, "-c", script).split()
    assert float(value) == pytest.approx(2.5) and unit == "mm"  # a shift by 2.5 mm along z
