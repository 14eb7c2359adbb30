"""The participants' table, settings, steps, and the batch script: all that is checked before anything runs."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.base.errors import InputError, TableError, UsageError
from lacli.cohort.analysis.observations import IDENTIFIER
from lacli.cohort.participants import check_targets, read_participants
from lacli.cohort.slurm import array_script
from lacli.cohort.steps import Settings, read_settings, steps_of


@pytest.fixture
def home(tmp_path: Path) -> Path:
    for name in ("labels.nrrd", "ct.nrrd", "targets.toml", "scene.toml", "runs.csv"):
        (tmp_path / name).write_text("x")
    for name in ("frames", "bundle"):
        (tmp_path / name).mkdir()
    return tmp_path


def _table(home: Path, *rows: str) -> Path:
    file = home / "participants.csv"
    file.write_text("participant_id,age,sex,labels,bundle,ct,images,targets,table\n" + "\n".join(rows) + "\n")
    return file


def test_the_steps_follow_the_files(home: Path) -> None:
    file = _table(
        home,
        "sub-1,61,F,labels.nrrd,,ct.nrrd,frames,,",
        "sub-2,n/a,M,,bundle,,,targets.toml,",
        "3,70,F,,,,,targets.toml,runs.csv",
    )
    patients = read_participants(file)
    assert [p.identifier for p in patients] == ["sub-1", "sub-2", "3"]
    assert patients[1].others == {"sex": "M"}
    steps = [steps_of(p, Settings(), home / "out" / p.identifier, home / "scene.toml") for p in patients]
    assert [[s.name for s in one] for one in steps] == [
        ["mesh", "fat", "track", "calibrate", "compare"], ["calibrate", "compare"], ["calibrate", "compare"],
    ]  # fmt: skip
    own, given_ = steps[0][2].arguments, steps[1][0].arguments
    assert "--update-bundle" in own  # the study's own bundle
    assert f"anatomy.bundle={home / 'bundle'}" in given_ and str(home / "scene.toml") in given_
    assert "--from-table" in steps[2][0].arguments
    with pytest.raises(UsageError, match="sub-2: no scene"):
        steps_of(patients[1], Settings(), home, None)


def test_a_table_s_calibration_takes_no_options_of_runs(home: Path) -> None:
    """Settings are shared: what says how to run is for those who are simulated, the rest for both."""
    shared = {"calibrate": {"workers": 2, "retry": True, "discretisation-error": False, "set": ["a=1"], "ess": 300}}
    table, simulated = (
        steps_of(p, Settings(shared), home / "out", home / "scene.toml")[0].arguments
        for p in read_participants(_table(home, "a,60,F,,,,,targets.toml,runs.csv", "b,60,F,,bundle,,,targets.toml,"))
    )
    assert table[-2:] == ("--ess", "300") and not {"--workers", "--retry", "--no-discretisation-error", "--set"} & set(table)
    assert {"--workers", "--retry", "--no-discretisation-error", "a=1", "--ess"} <= set(simulated)


def test_what_is_known_of_a_patient_s_pressures_goes_to_the_tracking(home: Path) -> None:
    (home / "mine.toml").write_text("[priors.edp_mmhg]\nmean = 8.0\nsd = 1.5\n")
    file = home / "participants.csv"
    file.write_text("participant_id,bundle,images,priors\na,bundle,frames,mine.toml\nb,bundle,frames,n/a\n")
    with_, without = (steps_of(p, Settings(), home / "out", home / "scene.toml")[0] for p in read_participants(file))
    assert with_.arguments[0] == "track" and with_.arguments[-2:] == ("--priors", str(home / "mine.toml"))
    assert home / "mine.toml" in with_.reads, "tracked targets are written again where it changes"
    assert "--priors" not in without.arguments
    file.write_text("participant_id,bundle,targets,priors\na,bundle,targets.toml,mine.toml\n")
    with pytest.raises(
        TableError, match=r"a: priors go into the targets of images that are tracked; state them in targets\.toml"
    ):
        read_participants(file)


def test_a_bundle_of_uniform_thickness_is_calibrated_too_and_compared(home: Path) -> None:
    (home / "flat").mkdir()
    file = home / "participants.csv"
    file.write_text("participant_id,bundle,targets,uniform\na,bundle,targets.toml,flat\nb,bundle,targets.toml,\n")
    first, second = read_participants(file)
    out = home / "out"
    steps = steps_of(first, Settings({"calibrate": {"max-runs": 24}}), out, home / "scene.toml")
    assert [s.name for s in steps] == ["calibrate", "calibrate_uniform", "compare"]
    assert steps[1].arguments[0] == "calibrate" and f"anatomy.bundle={home / 'flat'}" in steps[1].arguments
    assert steps[1].arguments[-2:] == ("--max-runs", "24") and home / "flat" in steps[1].reads
    assert f"uniform={out / 'calibration_uniform'}" in steps[2].arguments
    assert out / "calibration_uniform" / "result.json" in steps[2].reads, "done again where it changes"
    assert [s.name for s in steps_of(second, Settings(), out, home / "scene.toml")] == ["calibrate", "compare"]
    file.write_text("participant_id,table,targets,uniform\na,runs.csv,targets.toml,flat\n")
    with pytest.raises(TableError, match="does not go with table"):
        read_participants(file)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["sub-1,61,F,labels.nrrd,,,frames,,", "sub-1,61,F,labels.nrrd,,,frames,,"], "sub-1 stands twice"),
        (["sub-1,61,F,labels.nrrd,,,frames,,", "SUB-1,61,F,labels.nrrd,,,frames,,"], "SUB-1 stands twice"),
        (["../x,61,F,labels.nrrd,,,frames,,"], "'../x' is no identifier"),
        ([",61,F,labels.nrrd,,,frames,,"], "'' is no identifier"),
        (["sub-1,old,F,labels.nrrd,,,frames,,"], "age is 'old', not a number"),
        (["sub-1,61,F,nothing.nrrd,,,frames,,"], "nothing.nrrd is not there"),
        (["sub-1,61,F,,,,frames,,"], "neither labels"),
        (["sub-1,61,F,labels.nrrd,,,,,"], "neither images"),
        (["sub-1,61,F,,,,,,runs.csv"], "needs targets"),
        (["sub-1,61,F,,,,,bundle,runs.csv"], "bundle is no plain file"),
        (["sub-1,61,F,,labels.nrrd,,,targets.toml,"], "labels.nrrd is no folder"),
        (["Patients.csv,61,F,labels.nrrd,,,frames,,"], "the name of one of the study's own files"),
        (["slurm,61,F,labels.nrrd,,,frames,,"], "the name of one of the study's own files"),
    ],
)
def test_a_bad_table_is_one_message(home: Path, rows: list[str], words: str) -> None:
    with pytest.raises(TableError) as told:
        read_participants(_table(home, *rows))
    assert words in str(told.value) and "Nothing was run" in str(told.value)


def test_targets_that_cannot_be_read_are_told_with_whose_they_are(home: Path) -> None:
    patients = read_participants(_table(home, "sub-1,61,F,,bundle,,,targets.toml,"))
    with pytest.raises(InputError, match=r"sub-1: targets .*targets\.toml: not valid TOML.* Nothing was run"):
        check_targets(patients, home / "participants.csv")


@given(st.text(max_size=80))
def test_an_identifier_is_a_folder_s_plain_name(name: str) -> None:
    if IDENTIFIER.fullmatch(name):
        assert Path("a", name).name == name and name not in (".", "..") and not name.startswith("-")


def test_settings_become_arguments(home: Path) -> None:
    file = home / "settings.toml"
    file.write_text(
        '[calibrate]\nfirst-runs = 40\nfigures = false\nretry = true\nset = ["a=1", "b=2"]\n[slurm]\naccount = "heart"\n'
    )
    settings = read_settings(file)
    assert settings.arguments("calibrate") == [
        "--first-runs", "40", "--no-figures", "--retry", "--set", "a=1", "--set", "b=2",
    ]  # fmt: skip
    assert settings.arguments("mesh") == []


@pytest.mark.parametrize(
    "text",
    ["[calibrat]\na = 1", "[calibrate]\nout = 'x'", "[calibrate]\n'Bad name' = 1", "[calibrate]\nset = '--out=x'",
     "[calibrate]\nx = {a = 1}", "[slurm]\nqueue = 'x'", "[slurm]\naccount = 'a; rm -rf x'", "[slurm]\nmodules = ['$(x)']",
     "mesh = 1"],
)  # fmt: skip
def test_settings_that_could_be_another_thing_are_refused(home: Path, text: str) -> None:
    (home / "s.toml").write_text(text)
    with pytest.raises(UsageError):
        read_settings(home / "s.toml")


def test_the_batch_script_calls_one_patient_a_task(tmp_path: Path) -> None:
    settings = Settings(slurm={"account": "heart", "modules": ["gcc/12", "freefem"], "limit": 4})
    program = tmp_path / "a b" / "python"
    program.parent.mkdir()
    program.write_text('#!/bin/bash\nprintf "%s\\n" "$@"\n')
    program.chmod(0o755)
    script = tmp_path / "job.sh"
    script.write_text(
        array_script(str(program), ["cohort", "/x/my table.csv", "--out", "/s"], ["sub-1", "sub-2"], settings, tmp_path)
    )
    text = script.read_text()
    for line in ("#SBATCH --array=0-1%4", "#SBATCH --account=heart", "module load gcc/12", "#SBATCH --time=48:00:00"):
        assert line in text.splitlines()
    # a shell stands in for SLURM
    shell = ["bash", "-c", f"module() {{ :; }}; export -f module; SLURM_ARRAY_TASK_ID=1 bash '{script}'"]
    told = subprocess.run(shell, capture_output=True, text=True, check=True, timeout=60)
    assert told.stdout.splitlines() == ["-m", "lacli", "cohort", "/x/my table.csv", "--out", "/s", "--only", "sub-2"]
