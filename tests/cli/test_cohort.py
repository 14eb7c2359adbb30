"""`lacli cohort` end to end, on runs done elsewhere: no solver is needed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from lacli.base.errors import LacliError, UsageError
from lacli.cli import main
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.targets import Targets, write_targets

NAMES = [f"alpha_{name}" for name in BODY_REGIONS]
OUTPUTS = tuple(f"d_{name}_mm" for name in BODY_REGIONS)
TRUTH = {"sub-1": [0.8, 1.5, 2.2, 3.0, 1.2], "sub-2": [1.0, 1.2, 2.5, 2.8, 1.6], "sub-3": [1.0, 1.0, 1.0, 1.0, 1.0]}


@pytest.fixture
def table(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    rows = []
    for name, alpha in TRUTH.items():
        x = 0.5 + 3.5 * rng.random((40, 5))
        runs = pd.DataFrame(x, columns=NAMES).assign(**dict(zip(OUTPUTS, (10 - 2 * x).T, strict=True)), cpu_s=30.0)
        if name == "sub-3":
            runs[OUTPUTS[0]] = "broken"
        runs.to_csv(tmp_path / f"{name}.csv", index=False)
        write_targets(tmp_path / f"{name}.toml", Targets(OUTPUTS, 10 - 2 * np.array(alpha), np.full(5, 0.3)))
        rows.append({"participant_id": name, "age": 60, "table": f"{name}.csv", "targets": f"{name}.toml"})
    pd.DataFrame(rows).to_csv(tmp_path / "participants.csv", index=False)
    text = "[calibrate]\nmax-waves = 1\nfirst-runs = 40\ness = 300\nfigures = false\n[compare]\nparticles = 150\n"
    (tmp_path / "settings.toml").write_text(text)
    return tmp_path / "participants.csv"


def _call(table: Path, *more: str) -> Any:
    call = ["cohort", str(table), "--out", str(table.parent / "study"), "--settings", str(table.parent / "settings.toml")]
    return CliRunner().invoke(main.build({"cohort"}), [*call, *more])


def test_the_dry_run_runs_nothing(table: Path) -> None:
    shown = _call(table, "--dry-run", "--json")
    assert shown.exit_code == 0, shown.output
    document = json.loads(shown.stdout)
    assert [(r["participant_id"], r["step"], r["state"]) for r in document["steps"][:2]] == [
        ("sub-1", "calibrate", "to do"), ("sub-1", "compare", "to do"),
    ]  # fmt: skip
    assert document["cost"] == {  # the runs are there
        "calibrations": 0, "runs_each": 0, "cpu_s_per_run": None, "reference_runs_each": 0, "cpu_s_per_reference_run": None,
        "compared": 0, "compared_runs_each": 0,
    }  # fmt: skip
    assert "lacli calibrate --from-table" in _call(table, "--dry-run").stdout
    assert not (table.parent / "study").exists()
    script = table.parent / "job.sh"
    assert _call(table, "--write-slurm", str(script)).exit_code == 0
    assert "patients=(sub-1 sub-2 sub-3)" in script.read_text()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[calibrate]\nfirst-run = 3\n", "has no option --first-run"),
        ("[fat]\nfigures = false\n", "--no-figures"),
        ('[calibrate]\nfigures = "no"\n', "figures = no: true or false"),
        ("[calibrate]\nmax-runs = 2\n", "[calibrate]: Invalid value for '--max-runs'"),
        ('[mesh]\ncell-size-mm = "big"\n', "[mesh]: Invalid value for '--cell-size-mm'"),
        ('[track]\nwork-mm = "wide"\n', "[track]: Invalid value for '--work-mm'"),
        ('[compare]\nparticles = "many"\n', "[compare]: Invalid value for '--particles'"),
    ],
)
def test_an_option_that_a_command_would_refuse_is_told_before(table: Path, text: str, words: str) -> None:
    (table.parent / "settings.toml").write_text(text)
    shown = _call(table)
    assert isinstance(shown.exception, UsageError) and words in str(shown.exception)
    assert not (table.parent / "study").exists()


def _spoilt(table: Path, how: str) -> None:
    frame = pd.read_csv(table, dtype=str)
    if how == "missing file":
        frame.loc[1, "table"] = "gone.csv"
    if how == "missing table":
        table.unlink()
        return
    if how == "twice":
        frame.loc[1, "participant_id"] = "sub-1"
    if how == "age":
        frame.loc[1, "age"] = "sixty"
    if how == "NaN":
        frame.loc[1, "participant_id"] = None
    if how == "empty":
        frame = frame[:0]
    if how == "path":
        frame.loc[1, "participant_id"] = "/etc/passwd"
    if how == "regions":
        write_targets(table.parent / "sub-2.toml", Targets(OUTPUTS[:4], np.full(4, 8.0), np.full(4, 0.3)))
    if how == "no targets":
        (table.parent / "sub-2.toml").write_text("targets = 1\n")
    frame.to_csv(table, index=False)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("missing file", "gone.csv is not there"),
        ("missing table", "participants.csv"),
        ("twice", "sub-1 stands twice"),
        ("age", "age is 'sixty', not a number"),
        ("NaN", "row 2: '' is no identifier"),
        ("empty", "participants.csv"),
        ("path", "'/etc/passwd' is no identifier"),
        ("regions", "sub-2 lack the displacement of roof, which sub-1 has"),
        ("no targets", "sub-2.toml"),
    ],
)
def test_a_bad_table_of_participants_is_one_message_and_nothing_runs(table: Path, how: str, words: str) -> None:
    _spoilt(table, how)
    for more in ((), ("--dry-run",)):
        shown = _call(table, *more)
        assert isinstance(shown.exception, LacliError) and shown.exception.exit_code in (1, 2), shown.output
        assert words in str(shown.exception) and "\n" not in str(shown.exception)
    assert not (table.parent / "study").exists()


def test_one_patient_alone_is_told_by_stats(tmp_path: Path) -> None:
    frame = pd.DataFrame({"participant_id": "sub-1", "region": BODY_REGIONS, "d_mm": np.arange(5.0)})
    frame.to_csv(tmp_path / "regions.csv", index=False)
    call = ["stats", str(tmp_path / "regions.csv"), "--response", "d_mm", "--out", str(tmp_path / "statistics")]
    shown = CliRunner().invoke(main.build({"stats"}), call)
    assert isinstance(shown.exception, LacliError) and "one patient (sub-1)" in str(shown.exception)
    assert not (tmp_path / "statistics").exists()


@pytest.mark.slow
def test_a_study_goes_on_and_a_failure_stays_its_own(table: Path) -> None:
    study = table.parent / "study"
    shown = _call(table)
    assert type(shown.exception) is LacliError and "1 of 3 participants failed" in str(shown.exception), shown.output
    patients = pd.read_csv(study / "patients.csv").set_index("participant_id")
    assert list(patients["status"]) == ["done", "done", "failed"]
    assert patients.loc["sub-3", "step"] == "calibrate" and "broken" in patients.loc["sub-3", "reason"]
    regions = pd.read_csv(study / "regions.csv")
    assert sorted(set(regions["participant_id"])) == ["sub-1", "sub-2"]
    # the truths, in the tables' order; a posterior's sd is .3 mm / 2 mm a unit
    assert regions["alpha"].to_numpy() == pytest.approx([*TRUTH["sub-1"], *TRUTH["sub-2"]], abs=0.1)
    assert regions["alpha_sd"].to_numpy() == pytest.approx(np.full(10, 0.15), abs=0.05)
    draws = pd.read_csv(study / "draws.csv")
    assert len(draws) == 2 * 5 * 200
    summary = json.loads((study / "summary.json").read_text())
    assert {m["name"]: m["patients"] for m in summary["models"]} == {"regional": 2, "global": 2, "pooled": 2}
    assert any("thickness_mm" in note for note in summary["notes"])
    # mended, it goes on; what was done is not done again
    before = (study / "sub-1" / "calibration" / "result.json").stat().st_mtime_ns
    frame = pd.read_csv(table.parent / "sub-3.csv")
    frame[OUTPUTS[0]] = 10 - 2 * frame[NAMES[0]]
    frame.to_csv(table.parent / "sub-3.csv", index=False)
    shown = _call(table, "--json")
    assert shown.exit_code == 0, shown.output
    assert [p["status"] for p in json.loads(shown.stdout)["patients"]] == ["done"] * 3
    assert (study / "sub-1" / "calibration" / "result.json").stat().st_mtime_ns == before
    # what was done from something else is never mixed
    frame.iloc[1:].to_csv(table.parent / "sub-3.csv", index=False)
    shown = _call(table, "--dry-run")
    assert shown.exit_code == 0 and "from another" in " ".join(shown.output.split())
    shown = _call(table)
    assert type(shown.exception) is LacliError and "1 of 3 participants failed" in str(shown.exception), shown.output
    patients = pd.read_csv(study / "patients.csv").set_index("participant_id")
    assert list(patients["status"]) == ["done", "done", "failed"] and "from another" in patients.loc["sub-3", "reason"]
