"""A study on disk: a step is done once, found by the content of what it read, and one patient's failure stays that patient's."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from chains import chain_of

from lacli.api.cohort import run_cohort
from lacli.base.errors import Cancelled, InputError, UsageError
from lacli.base.processes.locks import lock
from lacli.cohort import page as study_pages
from lacli.cohort import study
from lacli.cohort.analysis import summary as summaries
from lacli.cohort.analysis.summary import median_cpu_s, write_summary
from lacli.cohort.files import MODELS, PATIENTS, REGIONS, SUMMARY
from lacli.cohort.participants import Participant, read_participants
from lacli.cohort.steps import Step
from lacli.cohort.study import Outcome, content_digest, known_outcome, planned, run
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.targets import Targets, write_targets
from lacli.inference.sampling.posterior import save_chain


@pytest.fixture
def patient(tmp_path: Path) -> Participant:
    (tmp_path / "targets.toml").write_text("x")
    (tmp_path / "scene.toml").write_text("x")
    (tmp_path / "runs.csv").write_text("x")
    (tmp_path / "p.csv").write_text("participant_id,targets,table\nsub-1,targets.toml,runs.csv\n")
    (found,) = read_participants(tmp_path / "p.csv")
    return found


def version_step(tmp_path: Path, name: str = "mesh", reads: str = "input.txt") -> Step:
    """A step that costs nothing: `lacli --version`."""
    (tmp_path / "product").mkdir(exist_ok=True)
    return Step(name, ("--version",), (tmp_path / reads,), tmp_path / "product")


def test_a_step_is_done_once_and_refused_from_other_content(patient: Participant, tmp_path: Path) -> None:
    (tmp_path / "input.txt").write_text("one")
    step, folder, begun = version_step(tmp_path), tmp_path / "study" / "sub-1", list[str]()
    assert [row.state for row in planned(patient, [step], folder)] == ["to do"]
    outcome = run(patient, [step], folder, begun.append, lambda: True)
    assert (outcome.status, outcome.step, begun) == ("done", "", ["mesh"])
    assert outcome.cpu_s["mesh"] > 0
    mark = folder / "steps" / "mesh.json"
    first = mark.read_bytes()
    assert run(patient, [step], folder, begun.append, lambda: True) == outcome
    assert mark.read_bytes() == first, "found, not done again"
    assert [row.state for row in planned(patient, [step], folder)] == ["done"]
    assert known_outcome(folder) == outcome

    (tmp_path / "input.txt").write_text("two")
    with pytest.raises(UsageError, match=r"done from another .*input\.txt"):
        planned(patient, [step], folder)
    assert run(patient, [step], folder, begun.append, lambda: True).status == "failed"
    (tmp_path / "input.txt").write_text("one")
    with pytest.raises(UsageError, match="with other options"):
        planned(patient, [dataclasses.replace(step, arguments=("--help",))], folder)


def making(content: str) -> Callable[..., SimpleNamespace]:
    """A stand-in of a step's process: it writes the product, the last of its arguments."""

    def supervise(command: list[str], **_: Any) -> SimpleNamespace:
        Path(command[-1]).parent.mkdir(exist_ok=True)
        Path(command[-1]).write_text(content)
        return SimpleNamespace(cut=None, exit_code=0, cpu_s=1.0, wall_s=1.0, last_lines=())

    return supervise


def test_the_dry_run_says_what_the_run_does(patient: Participant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step whose inputs are made anew is done where they are the same, refused where not; one that reads none of it is done."""
    wall, fat, other = (tmp_path / name for name in ("anatomy/wall.txt", "fat/fat.txt", "other/other.txt"))
    steps = [
        Step("mesh", ("mesh", str(wall)), (tmp_path / "scene.toml",), wall),
        Step("fat", ("fat", str(fat)), (wall.parent,), fat),
        Step("track", ("track", str(other)), (tmp_path / "runs.csv",), other),
    ]
    folder = tmp_path / "s"

    def told() -> list[str]:
        return [row.state for row in planned(patient, steps, folder)]

    monkeypatch.setattr(study, "supervise", making("one"))
    assert told() == ["to do"] * 3
    assert run(patient, steps, folder, lambda name: None, lambda: True).status == "done"
    again = ["to do", "done, if mesh makes the same again; else refused", "done"]
    for lost in (wall, folder / "steps" / "mesh.json"):
        lost.unlink()
        assert told() == again
        assert run(patient, steps, folder, lambda name: None, lambda: True).status == "done"
        assert told() == ["done"] * 3

    (tmp_path / "scene.toml").write_text("another")
    with pytest.raises(UsageError, match="mesh was done from another"):
        told()
    (folder / "steps" / "mesh.json").unlink()
    assert told() == again
    kept = fat.stat().st_mtime_ns
    monkeypatch.setattr(study, "supervise", making("two"))
    outcome = run(patient, steps, folder, lambda name: None, lambda: True)
    assert (outcome.status, outcome.step) == ("failed", "fat") and "done from another" in outcome.reason
    assert fat.stat().st_mtime_ns == kept, "what was done from the old mesh stays"
    # as the refusal says
    (folder / "steps" / "fat.json").unlink()
    assert told() == ["done", "to do", "done"]
    assert run(patient, steps, folder, lambda name: None, lambda: True).status == "done" and fat.read_text() == "two"


def test_what_is_lost_with_another_step_s_folder_is_done_again(
    patient: Participant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tracking's motion stands in the bundle: one that is meshed anew, though the same, has none."""
    wall, motion = tmp_path / "anatomy" / "wall.txt", tmp_path / "motion" / "targets.txt"
    inside = wall.with_name("motion.npz")
    steps = [
        Step("mesh", ("mesh", str(wall)), (tmp_path / "scene.toml",), wall),
        Step("track", ("track", str(inside), str(motion)), (wall,), motion, (inside,)),
    ]
    made: list[str] = []

    def supervise(command: list[str], **_: Any) -> SimpleNamespace:
        made.append(command[3])
        if command[3] == "mesh":
            inside.unlink(missing_ok=True)
        for file in map(Path, command[4:]):
            file.parent.mkdir(exist_ok=True)
            file.write_text("one")
        return SimpleNamespace(cut=None, exit_code=0, cpu_s=1.0, wall_s=1.0, last_lines=())

    monkeypatch.setattr(study, "supervise", supervise)
    run(patient, steps, tmp_path / "s", lambda name: None, lambda: True)
    (tmp_path / "s" / "steps" / "mesh.json").unlink()
    states = [row.state for row in planned(patient, steps, tmp_path / "s")]
    assert states == ["to do", "to do, if mesh makes the same again; else refused"]
    assert run(patient, steps, tmp_path / "s", lambda name: None, lambda: True).status == "done"
    assert made == ["mesh", "track"] * 2 and inside.is_file()


def test_a_refusal_that_is_known_comes_before_anything_is_done(patient: Participant, tmp_path: Path) -> None:
    (tmp_path / "input.txt").write_text("one")
    folder, last = tmp_path / "study" / "sub-1", version_step(tmp_path, "calibrate")
    run(patient, [last], folder, lambda name: None, lambda: True)
    assert [row.state for row in planned(patient, [version_step(tmp_path, "mesh"), last], folder)] == ["to do", "done"]
    with pytest.raises(UsageError, match="calibrate was done with other options"):
        planned(patient, [version_step(tmp_path, "mesh"), dataclasses.replace(last, arguments=("--help",))], folder)


def test_a_failure_is_an_outcome_with_its_last_words(patient: Participant, tmp_path: Path) -> None:
    (tmp_path / "input.txt").write_text("one")
    good = version_step(tmp_path)
    bad = Step("calibrate", ("mesh", "none.nrrd", "--out", "x"), (), tmp_path / "product")
    outcome = run(patient, [good, bad], tmp_path / "s", lambda name: None, lambda: True)
    assert (outcome.status, outcome.step) == ("failed", "calibrate")
    assert "none.nrrd" in outcome.reason and set(outcome.cpu_s) == {"mesh"}
    missing = dataclasses.replace(good, name="track", reads=(tmp_path / "gone",))
    assert "gone: cannot be read" in run(patient, [missing], tmp_path / "s", lambda name: None, lambda: True).reason
    with pytest.raises(Cancelled, match="what is done is kept"):
        run(
            patient, [dataclasses.replace(good, name="fat", arguments=("doctor",))], tmp_path / "s", lambda n: None, lambda: False
        )
    (tmp_path / "s" / "status.json").write_text('{"status": "done"}')
    with pytest.raises(InputError, match="not a patient's state"):
        known_outcome(tmp_path / "s")
    assert known_outcome(tmp_path / "nobody") is None


def test_a_folder_s_digest_is_that_of_its_files_and_their_names(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "one").write_text("1")
    assert content_digest(tmp_path / "a") == content_digest(tmp_path / "b")
    (tmp_path / "b" / "one").rename(tmp_path / "b" / "other")
    assert content_digest(tmp_path / "a") != content_digest(tmp_path / "b")


def compared(folder: Path, rmse: float) -> None:
    """What a finished patient left, as the tables need it."""
    (folder / "calibration").mkdir(parents=True)
    rows = [{"input": f"alpha_{r}", "map": 1.0 + i, "mean": 1.1 + i, "sd": 0.1} for i, r in enumerate(BODY_REGIONS)]
    fit = [{"feature": f"d_{r}_mm", "target": 5.0 + i, "sd": 0.2, "emulated": 5.0} for i, r in enumerate(BODY_REGIONS)]
    result = {"posterior": rows, "fit": fit, "waves": [{"runs": 10}], "rmse_mm": rmse}
    (folder / "calibration" / "result.json").write_text(json.dumps(result))
    pd.DataFrame({"a": [1.0, 2.0, 3.0], "cpu_s": [10.0, 30.0, np.nan]}).to_csv(folder / "calibration" / "runs.csv", index=False)
    chain = chain_of([f"alpha_{r}" for r in BODY_REGIONS])
    chain = dataclasses.replace(chain, samples=[row["mean"] for row in rows] + 0.1 * chain.samples)
    save_chain(folder / "calibration" / "chain.npz", chain)
    same = {"log_evidence": -3.0, "log_evidence_se": 0.1, "elpd": -4.0, "elpd_se": 1.0, "p_loo": 2.0}
    fits = [{"name": n, "rmse_mm": rmse + k, **same} for k, n in enumerate(("regional", "global"))]
    contrast = {
        "model": "regional",
        "against": "global",
        "difference": 10 * rmse,
        "se": 0.3,
        "verdict": "no contrast can be claimed",
    }
    (folder / "comparison.json").write_text(json.dumps({"fits": fits, "contrasts": [contrast]}))


def test_the_tables_hold_who_is_done_and_say_who_is_not(tmp_path: Path) -> None:
    (tmp_path / "targets.toml").write_text("x")
    (tmp_path / "p.csv").write_text(
        "participant_id,targets,table,age\n" + "".join(f"sub-{i},targets.toml,targets.toml,{60 + i}\n" for i in range(3))
    )
    patients = read_participants(tmp_path / "p.csv")
    home = tmp_path / "study"
    for i in (0, 1):
        compared(home / f"sub-{i}", 0.2 + 0.2 * i)
    (home / "sub-0" / "motion").mkdir()
    (home / "sub-0" / "motion" / "tracking.json").write_text(
        json.dumps({"times": [0.1 * i for i in range(10)], "voxel_mm": [0.4, 0.4, 0.8]})
    )
    outcomes = [Outcome(f"sub-{i}", "done", "", "", {"mesh": 2.0, "calibrate": 5.0}) for i in (0, 1)]
    outcomes.append(Outcome("sub-2", "failed", "mesh", "no atrium", {}))
    told, summary = write_summary(home, patients, outcomes)
    assert told == tuple(outcomes)
    assert (summary["patients"], summary["done"], summary["failed"]) == (3, 2, ["sub-2"])
    regional = summary["models"][0]
    # .2 and .4: mean .3, sd .2 / sqrt 2
    assert (regional["name"], regional["patients"]) == ("regional", 2)
    assert regional["rmse_mean_mm"] == pytest.approx(0.3) and regional["rmse_sd_mm"] == pytest.approx(0.2 / np.sqrt(2.0))
    # 2 effective parameters in each; -4 + -4, sqrt 2
    assert [regional[key] for key in ("p_loo_mean", "p_loo_sd", "elpd", "elpd_se")] == pytest.approx([2.0, 0.0, -8.0, 2.0**0.5])
    people = pd.read_csv(home / PATIENTS)
    assert people["frames"].tolist()[0] == 10 and people["voxel_mm"].tolist()[0] == 0.8 and people["frames"].isna().tolist()[1:]
    assert people["cpu_s"].tolist() == [7.0, 7.0, 0.0] and people["reason"].tolist()[2] == "no atrium"
    table = pd.read_csv(home / REGIONS)
    assert len(table) == 10 and set(table["region"]) == set(BODY_REGIONS)
    draws = pd.read_csv(home / "draws.csv")
    assert len(draws) == 2 * 5 * 200 and set(draws["draw"]) == set(range(200))
    assert median_cpu_s(home) == (20.0, None)
    assert median_cpu_s(tmp_path / "nowhere") == (None, None)
    # of one patient whose runs were carried by cheap ones, those are the dear ones
    (home / "sub-0" / "calibration" / "runs_cheap.csv").write_text("cpu_s\n1.0\n2.0\n3.0\n")
    assert median_cpu_s(home) == (3.0, 20.0)  # of 1, 2, 3 and the other patient's 10, 30

    features = pd.read_csv(home / "features.csv").set_index("feature")
    # emulated 5, targets 5 to 9, the same in both patients: no spread; sd .2
    assert features.loc["d_roof_mm", ["rmse", "sd", "rmse_in_sd"]].tolist() == pytest.approx([4.0, 0.0, 20.0])
    (contrast,) = pd.read_csv(home / "contrasts.csv").to_dict("records")
    # 2 + 4 nats, sqrt(.3^2 + .3^2): beyond 3 + 2 se
    assert contrast["log_evidence"] == pytest.approx(6.0) and contrast["se"] == pytest.approx(0.3 * np.sqrt(2.0))
    assert contrast["verdict"] == "regional is strongly preferred" and contrast["prefer_model"] == 0

    made = study_pages.study_page(home, tmp_path)
    assert made.lead == "2 of 3 participants done."
    titles = [section.title for section in made.sections]
    assert titles[:3] == ["Participants", "Models", "Fits"]
    shown = [row for section in made.sections for table in section.tables for row in table.rows]
    assert ("age", "3", "61 ± 1", "60 to 62", "") in shown
    assert ("regional", "2", "0.3", "0.141", "2", "0", "-8", "1.41", "2", "-", "") in shown
    assert ("d_roof_mm", "2", "4", "0", "20") in shown and any("regional is strongly preferred" in row for row in shown)
    (home / SUMMARY).write_text("{}")
    with pytest.raises(InputError, match="not a study's summary"):
        study_pages.study_page(home, tmp_path)
    for path in (home / MODELS, home / SUMMARY):
        path.unlink()
    with pytest.raises(InputError, match="is this the folder of"):
        study_pages.study_page(home, tmp_path)


def test_who_is_not_done_from_these_inputs_any_more_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three, one has a bundle that cannot be read, which is its own failure; of those not chosen, the marks are judged."""
    home, table, names = tmp_path / "study", tmp_path / "p.csv", ("sub-1", "sub-2", "sub-3")
    ended = SimpleNamespace(cut=None, exit_code=0, cpu_s=1.0, wall_s=1.0, last_lines=())
    monkeypatch.setattr(study, "supervise", lambda command, **_: ended)
    for name in names:
        compared(home / name, 0.3)  # as the steps would leave it
        write_targets(tmp_path / f"{name}.toml", Targets(("d_roof_mm",), np.array([5.0]), np.array([0.2])))
    (tmp_path / "runs.csv").write_text("x")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "wall.vtu").write_text("no mesh")
    rows = [f"{name},runs.csv,{name}.toml,{'broken' if name == 'sub-3' else 'n/a'}\n" for name in names]
    table.write_text("participant_id,table,targets,bundle\n" + "".join(rows))

    def told(*only: str) -> tuple[dict[str, str], list[str], set[str]]:
        found = run_cohort(table, home, only=only)
        kept = set(pd.read_csv(home / REGIONS)["participant_id"])
        notes = [note for note in found.summary["notes"] if note.startswith("sub-")]
        return {o.participant_id: o.status for o in found.outcomes}, notes, kept

    of_all = {"sub-1": "done", "sub-2": "done", "sub-3": "failed"}
    assert told() == told("sub-1") == (of_all, [], {"sub-1", "sub-2"})
    people = pd.read_csv(home / PATIENTS).set_index("participant_id")
    assert people.loc["sub-3", "step"] == "summary" and "broken" in people.loc["sub-3", "reason"]

    given = (tmp_path / "sub-2.toml").read_text()
    (tmp_path / "sub-2.toml").write_text(given + "# another\n")
    statuses, notes, kept = told("sub-1")
    assert statuses == {"sub-1": "done", "sub-3": "failed"} and kept == {"sub-1"}
    assert len(notes) == 1 and notes[0].startswith("sub-2 was done from other inputs: run the study again.")
    # asked for, it is a failure with its reason, and no end of the others
    state = (home / "sub-2" / "status.json").read_bytes()
    assert told("sub-1", "sub-2")[0] == {"sub-1": "done", "sub-2": "failed", "sub-3": "failed"}
    people = pd.read_csv(home / PATIENTS).set_index("participant_id")
    assert people.loc["sub-2", "step"] == "kept results" and "done from another" in people.loc["sub-2", "reason"]
    assert (home / "sub-2" / "status.json").read_bytes() == state, "its inputs may come back"
    plan = run_cohort(table, home, only=("sub-1", "sub-2"), dry_run=True)
    assert [row.state.partition(":")[0] for row in plan.steps] == ["done", "done", "refused"]
    with pytest.raises(UsageError, match="done from another"):
        run_cohort(table, home, only=("sub-2",))
    (tmp_path / "sub-2.toml").write_text(given)
    assert told("sub-1")[0] == of_all

    (home / "sub-2" / "calibration" / "result.json").unlink()
    statuses, notes, kept = told("sub-1")
    assert kept == {"sub-1"} and notes[0].startswith("sub-2 is not done any more (calibrate, compare): run the study again.")
    (home / "sub-2" / "status.json").write_text("[")
    assert told("sub-1")[1][0].startswith("sub-2 has files that cannot be read")


def test_tables_are_gathered_and_written_by_one_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    table, held = tmp_path / "p.csv", list[bool]()
    for name in ("t.toml", "runs.csv"):
        (tmp_path / name).write_text("x")
    write_targets(tmp_path / "t.toml", Targets(("d_roof_mm",), np.array([5.0]), np.array([0.2])))
    table.write_text("participant_id,table,targets\nsub-1,runs.csv,t.toml\n")

    def write(*_: Any) -> tuple[tuple[Outcome, ...], dict[str, Any]]:
        with lock(tmp_path / "study" / f".lock-{SUMMARY}", "", wait=False) as got:
            held.append(not got)
        return (), {}

    monkeypatch.setattr(study, "supervise", lambda command, **_: SimpleNamespace(cut="cut", exit_code=1, last_lines=("no",)))
    monkeypatch.setattr(summaries, "write_summary", write)
    run_cohort(table, tmp_path / "study")
    assert held == [True] and not list((tmp_path / "study").glob(".lock*"))


def test_a_refused_option_is_told_without_the_frame_around_it() -> None:
    framed = ("Try 'lacli calibrate --help' for help.", "╭─ Error ╮", "│ Invalid value for '--max-runs' │", "╰───────╯")
    assert study.last_words(framed) == "Invalid value for '--max-runs'"
    assert study.last_words(("lacli: no targets.", "╰──╯", "bye")) == "no targets."
    assert study.last_words(("────", "")) == ""
