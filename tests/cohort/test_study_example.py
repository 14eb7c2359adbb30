"""examples/study.sh from the cohort to the report; installing is not its subject, so that a stand-in takes its place."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from lacli.cli.study.cohort import _check_options
from lacli.contracts.priors import read_prior_file
from lacli.synthetic.cycle import LOADS

ROOT = Path(__file__).resolve().parents[2]
INSTALLED = """
ROOT="{root}"
BIN="{bin}"
PYTHON="{python}"
say() {{ printf '== %s\\n' "$*"; }}
die() {{ printf 'lacli: %s\\n' "$*" >&2; exit 1; }}
install_lacli() {{ :; }}
"""
NOTHING, STRONGLY = "no contrast can be claimed", "strongly preferred"


def call(tmp_path: Path, *words: str, script: str = "study.sh", lacli: str = "") -> subprocess.CompletedProcess[str]:
    home, programs = tmp_path / "examples", tmp_path / "bin"
    for folder in (home, programs):
        folder.mkdir(exist_ok=True)
    for name in (script, "patients.sh"):
        shutil.copy(ROOT / "examples" / name, home)
    (home / "install.sh").write_text(INSTALLED.format(root=ROOT, bin=programs, python=sys.executable))
    (programs / "lacli").write_text(lacli or f'#!/bin/bash\nexec "{sys.executable}" -m lacli "$@"\n')
    (programs / "lacli").chmod(0o755)
    settings = tmp_path / "settings.toml"
    settings.write_text("[calibrate]\nmax-runs = 24\ness = 200\nfigures = false\n[compare]\nparticles = 150\n")
    paths = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH", "")) if p)
    environment = {**os.environ, "PYTHONPATH": paths, "CELL_MM": "10", "SETTINGS": str(settings)}
    return subprocess.run(
        ["bash", str(home / script), *words], env=environment, capture_output=True, text=True, check=False, timeout=1500
    )


@pytest.mark.slow
def test_the_study_ends_with_a_report_and_goes_on(tmp_path: Path) -> None:
    told = call(tmp_path, str(tmp_path / "results"), "2")
    page = tmp_path / "results" / "heterogeneous" / "report.html"
    assert page.is_file(), told.stdout[-2000:] + told.stderr[-2000:]
    assert "== done: pages are" in told.stdout and "truths inside 95 % intervals" in told.stdout
    study = tmp_path / "results" / "heterogeneous" / "study"
    assert list(pd.read_csv(study / "patients.csv")["status"]) == ["done", "done"]
    text = page.read_text()
    assert text.count("data:image/png;base64,") >= 3 and "sub-02" in text
    # what the participants' table gives, and what the bundle's cavity has: the same atrium
    anatomies = pd.read_csv(study / "anatomies.csv")
    assert anatomies["ed_volume_ml_measured"].tolist() == pytest.approx(anatomies["ed_volume_ml_given"].tolist(), abs=0.06)
    assert all((study.parent / "report_figures" / f"gallery.{suffix}").is_file() for suffix in ("png", "pdf", "svg"))
    made = {file: file.stat().st_mtime_ns for file in study.glob("*/calibration/result.json")}
    again = call(tmp_path, str(tmp_path / "results"), "2")
    assert again.returncode == told.returncode, again.stderr[-2000:]
    assert {file: file.stat().st_mtime_ns for file in made} == made, "found, not done again"


@pytest.mark.parametrize("script", ["study.sh", "gated.sh"])
def test_the_number_of_patients_is_a_number(tmp_path: Path, script: str) -> None:
    told = call(tmp_path, str(tmp_path / "results"), "many", script=script)
    assert told.returncode == 1 and told.stderr == "lacli: many patients; a whole number, 1 or more.\n"


# says what it is called with, and leaves what the script itself reads of it
STAND_IN = """#!/bin/bash
printf '%s\\n' "$*" >>"$(dirname "$0")/calls"
for word in "$@"; do
  [ "$word" = --gated ] && mkdir -p "$2/truth" && echo '{"alpha_roof": 1.5}' >"$2/truth/parameters.json"
done
exit 0
"""


def test_the_study_from_images_hands_each_patient_s_images_on(tmp_path: Path) -> None:
    results = tmp_path / "results"
    told = call(tmp_path, str(results), "2", script="gated.sh", lacli=STAND_IN)
    # the stand-in calibrates nobody: that is told at the end, after the page
    assert told.returncode == 1 and "no patient is done" in told.stdout, told.stdout + told.stderr
    calls = (tmp_path / "bin" / "calls").read_text().splitlines()
    assert [line.split()[0] for line in calls] == [*["synthesize"] * 4, "cohort", "cohort", "report"]
    table = pd.read_csv(results / "cohort" / "participants.csv").set_index("participant_id")
    assert list(table.index) == ["sub-01", "sub-02"]
    assert table.loc["sub-02", "images"] == "sub-02/gated/frames" and table.loc["sub-02", "labels"] == "sub-02/still/labels.nrrd"
    # the loads' ranges are known, as measured pressures would be, and stiffness is not
    assert table["priors"].tolist() == ["priors.toml"] * 2
    known = {one.name: (one.distribution, one.lower, one.upper) for one in read_prior_file(results / "cohort" / "priors.toml")}
    assert known == {name: ("uniform", low, high) for name, (low, high, _) in LOADS.items()}
    truths = pd.read_csv(results / "cohort" / "truths.csv")
    assert truths.to_dict("list") == {"participant_id": ["sub-01", "sub-02"], "alpha_roof": [1.5, 1.5]}


@pytest.mark.parametrize(
    ("arm", "verdict", "difference", "of_sum", "said", "code"),
    [
        ("heterogeneous", NOTHING, 0.5, NOTHING, "that regions differ is claimed of the arm: NOT MET", 0),
        (
            "heterogeneous",
            NOTHING,
            2.5,
            f"pooled is {STRONGLY} (less s2)",
            "that regions differ is claimed of the arm: met",
            0,
        ),
        ("heterogeneous", NOTHING, 0.5, "", "that regions differ is claimed of the arm: NOT MET", 0),
        ("heterogeneous", f"global is {STRONGLY}", -9.0, NOTHING, "no claim the wrong way round: NOT MET", 1),
        ("heterogeneous", NOTHING, -2.0, f"global is {STRONGLY}", "no claim the wrong way round: NOT MET", 1),
        ("control", NOTHING, 0.5, NOTHING, "that regions differ is not claimed of the arm: met", 0),
        ("control", NOTHING, -2.5, f"global is {STRONGLY}", "no claim the wrong way round: met", 0),
        ("control", NOTHING, 2.5, f"pooled is {STRONGLY}", "no claim the wrong way round: NOT MET", 1),
    ],
)
def test_what_is_asked_of_a_study_is_told_line_by_line(
    tmp_path: Path, arm: str, verdict: str, difference: float, of_sum: str, said: str, code: int
) -> None:
    """Three truths of four are in their intervals: 75 %, which no exit code is for."""
    (tmp_path / "truths.csv").write_text("participant_id,a,b\ns1,1,1\ns2,1,3\n")
    (tmp_path / "participants.csv").write_text(f"participant_id,arm\ns1,{arm}\ns2,{arm}\n")
    pairs = [("pooled", "global"), ("regional", "global")]
    contrasts = [{"model": m, "against": o, "difference": difference, "se": 0.1, "verdict": verdict} for m, o in pairs]
    for name in ("s1", "s2"):
        (tmp_path / name / "calibration").mkdir(parents=True)
        posterior = [{"input": key, "low95": 0.0, "high95": 2.0} for key in ("a", "b")]
        (tmp_path / name / "calibration" / "result.json").write_text(json.dumps({"posterior": posterior}))
        (tmp_path / name / "comparison.json").write_text(json.dumps({"contrasts": contrasts}))
    if of_sum:
        (tmp_path / "contrasts.csv").write_text(f"model,against,verdict\nregional,global,x\npooled,global,{of_sum}\n")
    command = [sys.executable, str(ROOT / "benchmarks" / "study.py"), str(tmp_path), str(tmp_path)]
    told = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert told.returncode == code, told.stderr
    assert f"asked: {said}" in told.stdout and "asked: coverage of 93% to 97%: NOT MET: 75.0% ± 25.0%" in told.stdout


def test_the_settings_of_the_examples_are_options_of_the_commands() -> None:
    for name in ("study.toml", "two_fidelities.toml", "gated.toml"):
        _check_options(ROOT / "examples" / name)
