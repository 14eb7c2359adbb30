"""The log of runs: rows found by their inputs among runs of the same; what the machine ended is run again."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from lacli.base.errors import LacliError, TableError, UsageError
from lacli.contracts.failures import MACHINE, MOST_ATTEMPTS, SCENE
from lacli.contracts.identity import beside
from lacli.inference.runs import Outcome, RunLog, runs_identity

INPUTS, OUTPUTS = ("a", "b"), ("v_ml",)
X = np.array([[1.0, 0.1], [2.0, 0.2], [3.0, 0.3]])


class Simulator:
    """v = scale x a; ends a run with the kind of the next of ``troubles`` where a is 2, as long as there are some."""

    def __init__(self, scale: float = 1.0, troubles: Sequence[str] = ()) -> None:
        self.scale, self.troubles, self.asked = scale, list(troubles), list[float]()

    def determined_by(self, inputs: Sequence[str]) -> Mapping[str, Any]:
        return {"scale": self.scale}

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        for index, a in enumerate(inputs["a"]):
            self.asked.append(a)
            if a == 2.0 and self.troubles:
                yield index, Outcome({}, "failed", self.troubles.pop(0), message="It took 812 MB.")
            else:
                yield index, Outcome({"v_ml": self.scale * a}, peak_memory_mb=330.0)


def log(folder: Path, simulator: Simulator, retry: bool = False) -> RunLog:
    return RunLog(folder / "runs.csv", INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS), retry)


def test_rows_are_found_again_and_not_those_of_another_simulator(tmp_path: Path) -> None:
    one = Simulator(1.0)
    log(tmp_path, one).run(one, X)
    again = Simulator(1.0)
    log(tmp_path, again).run(again, X)
    assert again.asked == []
    before = (tmp_path / "runs.csv").read_bytes()
    with pytest.raises(UsageError, match=r"runs\.csv holds runs made from something else: scale was 1, is 5\."):
        log(tmp_path, Simulator(5.0))
    assert (tmp_path / "runs.csv").read_bytes() == before


@pytest.mark.parametrize("spoil", ["missing", "edited"])
def test_a_table_that_does_not_say_what_it_is_made_from_is_not_trusted(tmp_path: Path, spoil: str) -> None:
    one = Simulator()
    log(tmp_path, one).run(one, X)
    file = beside(tmp_path / "runs.csv")
    if spoil == "missing":
        file.unlink()
    else:
        document = json.loads(file.read_text())
        document["content"]["scale"] = 5.0
        file.write_text(json.dumps(document))
    with pytest.raises(UsageError, match="does not say what it was made from"):
        log(tmp_path, Simulator(5.0))
    assert len(RunLog(tmp_path / "runs.csv", INPUTS, OUTPUTS, None).rows) == 3  # named as a table, it is read


def test_other_outputs_are_other_runs(tmp_path: Path) -> None:
    """Rows without the new output would count as failures."""
    one = Simulator()
    log(tmp_path, one).run(one, X)
    more = (*OUTPUTS, "d_mm")
    with pytest.raises(UsageError, match="outputs was"):
        RunLog(tmp_path / "runs.csv", INPUTS, more, runs_identity(one, INPUTS, more))


@pytest.mark.parametrize("kind", sorted(MACHINE))
def test_what_the_machine_ended_is_run_again(tmp_path: Path, kind: str) -> None:
    one = Simulator(troubles=[kind])
    one_log = log(tmp_path, one)
    one_log.run(one, X)
    assert one.asked == [1.0, 2.0, 3.0, 2.0], "after the others"
    assert (one_log.frame(X)["status"] == "done").all()


class Interrupted(Simulator):
    """Ends with Ctrl-C after the run that the machine ended."""

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        for index, outcome in super().__call__(inputs):
            yield index, outcome
            if outcome.lost:
                raise KeyboardInterrupt


def test_attempts_are_counted_through_restarts_and_end_with_the_reason(tmp_path: Path) -> None:
    asked = 0
    for _ in range(MOST_ATTEMPTS - 1):
        cut = Interrupted(troubles=["out_of_memory"])
        with pytest.raises(KeyboardInterrupt):
            log(tmp_path, cut).run(cut, X)
        asked += cut.asked.count(2.0)
    assert pd.read_csv(tmp_path / "runs.csv")["attempts"].max() == MOST_ATTEMPTS - 1
    last = Simulator(troubles=["out_of_memory"] * 9)
    reason = r"1 of the runs were ended by the machine 3 times or more, the first at a 2, b 0\.2: out_of_memory .*812 MB.*--retry"
    with pytest.raises(LacliError, match=reason):
        log(tmp_path, last).run(last, X)
    assert asked + last.asked.count(2.0) == MOST_ATTEMPTS
    assert last.asked.count(3.0) == 1, "the others are run"
    stuck = Simulator()
    with pytest.raises(LacliError, match=r"took up to 330 MB; \d+ of \d+ MB of memory are free here"):
        log(tmp_path, stuck).run(stuck, X)
    assert stuck.asked == [], "no loop"
    freed = Simulator()
    kept = log(tmp_path, freed, retry=True)
    kept.run(freed, X)
    assert freed.asked == [2.0] and (kept.frame(X)["status"] == "done").all()


def test_an_outcome_that_was_tried_often_enough_is_not_tried_more(tmp_path: Path) -> None:
    class Patient(Simulator):
        def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            self.asked += inputs["a"].tolist()
            yield from ((i, Outcome({}, "failed", "killed", attempts=MOST_ATTEMPTS)) for i in range(len(inputs)))

    one = Patient()
    with pytest.raises(LacliError, match="3 of the runs were ended by the machine"):
        log(tmp_path, one).run(one, X)
    assert one.asked == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("kind", sorted(SCENE))
def test_failures_of_the_scene_are_results(tmp_path: Path, kind: str) -> None:
    one = Simulator(troubles=[kind])
    log(tmp_path, one).run(one, X)
    assert one.asked == [1.0, 2.0, 3.0]
    again = Simulator()
    log(tmp_path, again).run(again, X)
    assert again.asked == []


def test_a_simulator_that_says_nothing_is_no_endless_loop(tmp_path: Path) -> None:
    class Silent(Simulator):
        def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            yield from ()

    with pytest.raises(LacliError, match="without a word"):
        log(tmp_path, Silent()).run(Silent(), X)


@pytest.mark.parametrize("kind", sorted(MACHINE))
def test_tables_of_others_teach_nothing_by_what_the_machine_ended(tmp_path: Path, kind: str) -> None:
    """12 finished runs, 4 that failed, 4 that the machine ended: those are neither failures nor results."""
    a = np.linspace(1, 4, 20)
    frame = pd.DataFrame({"a": a, "b": a**2 % 1, "v_ml": 2 * a, "status": "done", "kind": ""})
    frame.loc[:3, ["status", "kind"]] = ["failed", "inverted_element"]
    frame.loc[4:7, ["status", "kind"]] = ["failed", kind]
    frame.to_csv(tmp_path / "t.csv", index=False)
    given = RunLog(tmp_path / "t.csv", INPUTS, OUTPUTS, None)
    table = given.table(frame[["a", "b"]].to_numpy(), OUTPUTS)
    assert (table.runs, len(table.failed_x)) == (12, 4)
    assert table.failed_x[:, 0].max() == a[3]


def test_a_table_from_elsewhere_needs_its_columns(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a,v_ml\n1,2\n")
    with pytest.raises(TableError, match=r"no column b; the columns are a, v_ml"):
        RunLog(tmp_path / "t.csv", INPUTS, OUTPUTS, None)


def test_the_rows_asked_for_come_first_and_others_stay(tmp_path: Path) -> None:
    one = Simulator()
    kept = log(tmp_path, one)
    kept.run(one, X)
    frame = kept.arrange(X[[2, 1]])
    assert frame["a"].tolist() == [3.0, 2.0, 1.0] == pd.read_csv(tmp_path / "runs.csv")["a"].tolist()
