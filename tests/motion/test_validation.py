"""Simulated against tracked transients: differences, which frames were used, tables, figure, bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from lacli.api.validation import validate
from lacli.base.errors import InputError, UsageError
from lacli.cli.main import build
from lacli.motion.check.validation import compare

TIMES = np.arange(10) / 10


def course(shift: float = 0.0, times: np.ndarray = TIMES) -> pd.DataFrame:
    """Volume and three features as cubics of time, which a cubic spline between states reproduces exactly."""
    t = times
    return pd.DataFrame({
        "time": t, "volume_ml": 80.0 + 100 * t - 90 * t**2 + (shift if times is TIMES else 5.0),
        "d_roof_mm": 4 * t + shift * (t > 0), "n_roof_mm": 2 * t**3, "n_septum_mm": t - t**2, "phase": "x",
    })  # fmt: skip


def test_differences_and_what_was_used_by_hand() -> None:
    simulated = course(times=np.array([0.0, 0.15, 0.35, 0.55, 0.62]))
    found = compare(simulated, course(shift=0.3), {"d_roof_mm": 0.1, "n_roof_mm": 0.2}, ["esv_ml", "n_roof_mm@0.2", "mine"], 0.41)
    assert found.times == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]) and found.left_out == 3
    frame, kind = found.by_frame(), found.by_kind().set_index("kind")
    # d_roof is off by .3 in each frame, the others not at all; volumes are compared by their change, so 5 mL more do not count
    assert frame["d"].to_numpy() == pytest.approx(np.full(6, 0.3))
    assert frame["n"].to_numpy() == pytest.approx(np.zeros(6), abs=1e-12)
    assert frame["volume"].to_numpy() == pytest.approx(np.zeros(6), abs=1e-9)
    assert frame["in_sd"].to_numpy() == pytest.approx(np.full(6, np.sqrt((3.0**2 + 0.0) / 2)))  # of the two with an sd
    # ES (.41) has the frame at .4 for its own, and the volume there was used; n_roof at .2
    assert frame["used"].tolist() == [False, True, False, True, False, False]
    assert kind.loc["volume", "values_used"] == 1 and kind.loc["n", "values_used"] == 1 and kind.loc["n", "values"] == 12
    assert np.isnan(kind.loc["d", "used"]) and kind.loc["d", "not_used"] == pytest.approx(0.3)


def folders(tmp_path: Path) -> tuple[Path, Path]:
    run, motion = tmp_path / "run", tmp_path / "motion"
    run.mkdir()
    motion.mkdir()
    course(times=np.linspace(0, 0.7, 8)).to_csv(run / "transients.csv", index=False)
    course(shift=0.3).to_csv(motion / "transients.csv", index=False)
    (motion / "tracking.json").write_text(json.dumps({"sd": {"d_roof_mm": 0.1}, "phases": {"es": 0.4}}))
    (motion / "targets.toml").write_text("[targets.esv_ml]\nmean = 90.0\nsd = 2.0\n")
    return run, motion


def test_tables_and_figure_are_written(tmp_path: Path) -> None:
    run, motion = folders(tmp_path)
    found = validate(run, motion, out=tmp_path / "out")
    assert pd.read_csv(tmp_path / "out" / "validation.csv")["time"].to_numpy() == pytest.approx(found.times)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["validation.csv", "validation.png", "validation_kinds.csv"]


def test_bad_input_is_one_message(tmp_path: Path) -> None:
    run, motion = folders(tmp_path)
    with pytest.raises(UsageError, match="their own folder"):
        validate(run, motion, out=motion)
    (motion / "tracking.json").write_text("{}")
    with pytest.raises(InputError, match="no sd or phases"):
        validate(run, motion)
    (run / "transients.csv").unlink()
    with pytest.raises(InputError, match=r"run/transients.csv: no such file"):
        validate(run, motion)
    short = course(times=np.array([0.0, 0.05]))
    for simulated, words in ((short, "no tracked frame"), (course().drop(columns="time"), "a column time"),
                             (course()[["time", "phase"]], "share no feature")):  # fmt: skip
        with pytest.raises(InputError, match=words):
            compare(simulated, course(), {})
    damaged = course()
    damaged.loc[3, "d_roof_mm"] = np.nan
    with pytest.raises(InputError, match="not finite"):
        compare(damaged, course(), {})


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[1, 2]", "no sd or phases"),
        ('"text"', "no sd or phases"),
        ({"sd": {"d_roof_mm": "wide"}}, r"sd\.d_roof_mm is 'wide', not a number"),
        ({"sd": {"d_roof_mm": None}}, r"sd\.d_roof_mm is None, not a number"),
        ({"sd": {"d_roof_mm": [0.1]}}, r"sd\.d_roof_mm is \[0\.1\], not a number"),
        ({"phases": {"es": True}}, "no sd or phases"),
        ({"shrinkage": {"d": {"sd": 0.1}}}, "shrinkage is damaged"),
        ({"shrinkage": {"d": {"sd": 0.1, "share": "half"}}}, "shrinkage is damaged"),
    ],
)
def test_a_tracking_that_holds_something_else_is_one_message(tmp_path: Path, content: object, words: str) -> None:
    run, motion = folders(tmp_path)
    whole = json.loads((motion / "tracking.json").read_text())
    text = content if isinstance(content, str) else json.dumps(whole | content)  # type: ignore[operator]
    (motion / "tracking.json").write_text(text)
    with pytest.raises(InputError, match=rf"tracking\.json: .*{words}.*track again"):
        validate(run, motion)


@pytest.mark.parametrize("column", ["time", "d_roof_mm"])
@pytest.mark.parametrize("whose", ["simulated", "tracked"])
def test_a_word_among_the_numbers_is_told_with_its_place(tmp_path: Path, column: str, whose: str) -> None:
    run, motion = folders(tmp_path)
    file = (run if whose == "simulated" else motion) / "transients.csv"
    frame = pd.read_csv(file, dtype=str)
    frame.loc[2, column] = "oops"
    frame.to_csv(file, index=False)
    with pytest.raises(InputError, match=rf"run against .*: the {whose} transients: column {column}, row 3 holds 'oops'"):
        validate(run, motion)


def at_terminal(*arguments: str) -> str:
    result = CliRunner().invoke(build({"validate"}), ["validate", *arguments], catch_exceptions=False)
    assert result.exit_code == 0
    return result.stdout


def test_the_command_writes_and_shows_both_tables(tmp_path: Path) -> None:
    run, motion = folders(tmp_path)
    call = [str(run), "--motion", str(motion), "--out", str(tmp_path / "out")]
    shown = json.loads(at_terminal(*call, "--json"))
    # the simulation ends at .7 of ten frames, so .8 and .9 are left; d_roof is .3 off in each of seven, three sd of .1
    assert [row["time"] for row in shown["frames"]] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    assert shown["frames_left_out"] == 2
    assert [row["d"] for row in shown["frames"]] == pytest.approx([0.3] * 7)
    assert [row["in_sd"] for row in shown["frames"]] == pytest.approx([3.0] * 7)
    assert [row["used"] for row in shown["frames"]] == [False, False, False, True, False, False, False]
    kinds = {row["kind"]: row for row in shown["kinds"]}
    assert kinds["d"]["used"] is None and kinds["volume"]["values_used"] == 1
    text = at_terminal(*call)
    assert "by frame" in text and "by kind" in text and "validation.png" in text
    with pytest.raises(InputError, match="no such file"):
        at_terminal(str(tmp_path / "none"), "--motion", str(motion), "--out", str(tmp_path / "other"))
    assert not (tmp_path / "other").exists()
