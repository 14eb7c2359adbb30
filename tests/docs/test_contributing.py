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

from lacli.freefem.program import FreeFem

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The project's code, to be changed."""
    for name in ("lacli", "solvers", "templates"):
        shutil.copytree(ROOT / name, tmp_path / "copy" / name, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "copy"


def _python(copy: Path, *words: str, code: int = 0) -> str:
    environment = os.environ | {"PYTHONPATH": str(copy)}
    done = subprocess.run(
        [sys.executable, *words], cwd=copy, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == code, done.stderr
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
        (table, '    "n_{}_mm": (', '    "z_{}_mm": ("mm", _ALONG, "mean of u along z"),\n'),
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


@pytest.mark.slow
def test_a_law_is_two_files(copy: Path, freefem: FreeFem) -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    header, entry = re.search(r"```cpp\n(.*?)```", text, re.DOTALL), re.search(r"```python\n(Law\(.*?\n\))\n```", text, re.DOTALL)
    assert header and entry
    (copy / "solvers/freefem/plugin/laws/demiray.hpp").write_text(header[1], encoding="utf-8")
    table = copy / "lacli/contracts/laws.py"
    before, end, after = table.read_text(encoding="utf-8").partition(")\n\nLAWS: ")
    table.write_text(before + entry[1] + ",\n" + end + after, encoding="utf-8")
    checks = json.loads(_python(copy, "-m", "lacli", "verify", "law", "--json"))
    errors = {check["quantity"]: check["error"] for check in checks if check["quantity"].startswith("demiray")}
    # central differences of fourth order with h = 5e-4: h^4 W^(5) / 30 and rounding eps / h both stay below 1e-9
    assert errors.keys() == {"demiray_energy", "demiray_stress", "demiray_tangent"}
    assert max(errors.values()) < 1e-9
    # another exponent in the header alone is found
    wrong = header[1].replace("s = m.c * std::exp(Q)", "s = m.c * std::exp(1.001 * Q)")
    assert wrong != header[1]
    (copy / "solvers/freefem/plugin/laws/demiray.hpp").write_text(wrong, encoding="utf-8")
    failed = _python(copy, "-m", "lacli", "verify", "law", "--json", code=1)
    assert {check["quantity"] for check in json.loads(failed) if not check["passed"]} >= {"demiray_stress"}
    # the scene knows the law and its constant, with the range
    (copy / "scene.toml").write_text('[anatomy]\nbundle = "atrium"\n[materials]\nlaw = "demiray"\nbeta = 4.0\n', encoding="utf-8")
    _python(copy, "-m", "lacli", "synthesize", "atrium", "--cell-size-mm", "8", "--order", "1")
    said = _python(copy, "-m", "lacli", "simulate", "scene.toml", "--set", "numerics.order=1", "--dry-run", "--json")
    assert "demiray" in said
    run = ("simulate", "scene.toml", "--set", "numerics.order=1", "--set", "loads.edp_mmhg=0", "--set", "loads.esp_mmhg=3")
    (copy / "solvers/freefem/plugin/laws/demiray.hpp").write_text(header[1], encoding="utf-8")
    result = json.loads(_python(copy, "-m", "lacli", *run, "--json"))
    assert result["features"]["esv_ml"] > result["features"]["edv_ml"]
