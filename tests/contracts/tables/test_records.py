"""What the pages say of files is what files hold: a run's manifest and features, a table's columns, the keys of targets."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from shapes import cut_ball

from lacli.anatomy.wall.shell import mesh_shell
from lacli.base.errors import TableError
from lacli.contracts import bundle as bundles
from lacli.contracts.features import FEATURES
from lacli.contracts.identity import identify
from lacli.contracts.scene import build_scene
from lacli.contracts.tables import records
from lacli.contracts.tables.columns import DONE, FAILED, UNFINISHED, run_states
from lacli.contracts.tables.records import Field
from lacli.contracts.targets import read_targets
from lacli.inference.runs import Outcome, RunLog
from lacli.mechanics.simulation import run_scene


def _compare(found: Collection[str], fields: tuple[Field, ...], beside: Collection[str] = ()) -> None:
    known = {field.key for field in fields}
    assert len(known) == len(fields)
    assert set(found) - set(beside) <= known, "not said on the page"
    assert {field.key for field in fields if field.always} <= set(found), "said on the page, not in the file"


def test_a_run_holds_what_is_said_of_it(tmp_path: Path, freefem: object) -> None:
    ball = mesh_shell(cut_ball(), 2.0, 9.0, order=1)
    centre = ball.points[ball.tets[:, :4]].mean(axis=1)
    fibre = np.cross([0.0, 0.0, 1.0], centre) + np.array([1e-9, 0.0, 0.0])
    bundles.save(replace(ball, fibre=fibre / np.linalg.norm(fibre, axis=1, keepdims=True)), tmp_path / "bundle")
    wanted = [
        "motion.annulus=none", "loads.vein_spring_kpa_per_um=0", "pericardium.k_peri_kpa_per_um=0", "numerics.order=1",
        "loads.edp_mmhg=2", "loads.esp_mmhg=4", "outputs.fields=none", "outputs.strain=true",
    ]  # fmt: skip
    result = run_scene(build_scene({"anatomy": {"bundle": "bundle"}}, wanted, folder=tmp_path, where="test"), tmp_path / "runs")
    assert result.status == "done", result.message
    _compare(result.manifest, records.MANIFEST)
    _compare(result.features, records.RUN, {feature.key for feature in FEATURES})
    assert "fibre_stretch_anterior" in result.features  # it was asked for


def test_a_table_has_the_columns_that_are_said(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "runs.csv", ["a"], ["y"], identify("runs", inputs=["a"], outputs=["y"]))
    outcomes = [Outcome({"y": 1.0}, errors={"y": 0.1}), Outcome({}, "failed", "timeout", message="took too long")]
    log.run(lambda inputs: iter(enumerate(outcomes)), np.array([[1.0], [2.0]]))  # type: ignore[arg-type]
    columns = log.frame(np.array([[1.0], [2.0]])).columns
    _compare([name.replace("y_disc", "<output>_disc") for name in columns], records.TABLE, {"a", "y"})


@pytest.mark.parametrize("key", [field.key for field in records.TARGET])
def test_targets_take_the_keys_that_are_said_and_no_other(key: str, tmp_path: Path) -> None:
    file = tmp_path / "targets.toml"
    entry = {"mean": "1.0", "sd": "0.1", "unit": '"mm"', "source": '"CT"'}
    file.write_text("[d_roof_mm]\n" + "".join(f"{name} = {value}\n" for name, value in entry.items()), encoding="utf-8")
    assert read_targets(file).names == ("d_roof_mm",)
    file.write_text("[d_roof_mm]\n" + "".join(f"{n} = {v}\n" for n, v in entry.items() if n != key), encoding="utf-8")
    if next(field.always for field in records.TARGET if field.key == key):
        with pytest.raises(TableError, match=key):
            read_targets(file)
    else:
        read_targets(file)
    file.write_text("[d_roof_mm]\nmean = 1.0\nsd = 0.1\nweight = 2\n", encoding="utf-8")
    with pytest.raises(TableError, match="weight"):
        read_targets(file)


def test_words_of_status_are_taken_as_the_page_says() -> None:
    said = next(field.text for field in records.TABLE if field.key == "status")
    done, failed, unfinished, refused = said.split(";")
    for text, known in ((done, DONE), (failed, FAILED), (unfinished, UNFINISHED)):
        words = re.findall("`(.*?)`", text)
        assert words and set(words) <= known
    assert "an empty cell, or any other word, is refused" in refused
    frame = pd.DataFrame({"status": ["done", "failed", "killed"]})
    states = run_states(frame, "t.csv")
    assert states is not None and [list(state) for state in states] == [[True, False, False], [False, True, False]]
    for cell in (None, "odd"):
        with pytest.raises(TableError, match=r"t\.csv: status is .* in row 2 .*Finished runs: "):
            run_states(pd.DataFrame({"status": ["done", cell]}), "t.csv")
