"""What the commands keep: another scene, bundle, override or table never gets what was kept of the first."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from shapes import hollow_cube
from typer.testing import CliRunner

from lacli.base.errors import LacliError, UsageError
from lacli.cli.main import build
from lacli.contracts import bundle as bundles
from lacli.contracts import identity
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene, dump_scene
from lacli.inference.matching.nroy import EmptyRegionError
from lacli.mechanics.simulation import RunResult

SceneOf = Callable[..., Scene]
INPUTS = ("--input", "edp_mmhg", "--input", "alpha_roof")


def call(*arguments: object) -> dict[str, Any]:
    words = [str(a) for a in (*arguments, "--json")]
    result = CliRunner().invoke(build({words[0]}), words, catch_exceptions=True)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    document: dict[str, Any] = json.loads(result.stdout)
    return document


class Mechanics:
    """In place of FreeFEM: displacements that follow from the scene; a run may be ended by the machine."""

    def __init__(self) -> None:
        self.runs = 0
        self.killed: list[str] = []  # kinds of the next runs

    def __call__(self, scenes: Sequence[Scene], root: Path, **_: object) -> Iterator[tuple[int, RunResult]]:
        for index, scene in enumerate(scenes):
            self.runs += 1
            if self.killed:
                yield index, RunResult(run_key(scene), root, "failed", self.killed.pop(0), "gone", {}, {})
                continue
            m, p = scene.materials, scene.loads
            stiff = m.c_kpa.roof * m.alpha.roof
            features = {
                "esv_ml": 60 + p.esp_mmhg / stiff + p.edp_mmhg, "edv_ml": 60.0, "d_global_mm": p.esp_mmhg / stiff,
                "d_roof_mm": 2 * np.sqrt(p.esp_mmhg / stiff) - 0.05 * p.edp_mmhg,
            }  # fmt: skip
            regions = {f"d_{r}_mm": features["d_global_mm"] for r in ("anterior", "posterior", "septum", "lateral")}
            yield index, RunResult(run_key(scene), root, "done", None, "", features | regions, {})


@pytest.fixture
def mechanics(monkeypatch: pytest.MonkeyPatch) -> Mechanics:
    stand_in = Mechanics()
    monkeypatch.setattr("lacli.mechanics.execute.run_scenes", stand_in)
    return stand_in


@pytest.fixture
def scene(scene_of: SceneOf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    bundles.save(hollow_cube(), tmp_path / "bundle")  # a calibration looks at the cells, to say their errors
    file = tmp_path / "scene.toml"
    file.write_text(dump_scene(scene_of()))
    return file


def with_value(scene: Path, key: str, value: float) -> None:
    lines = [f"{key} = {value}" if line.startswith(f"{key} =") else line for line in scene.read_text().splitlines()]
    scene.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("table", ["runs.csv", "runs.parquet", "runs"])
def test_a_design_run_with_another_scene_never_gets_the_first_ones_rows(
    scene: Path, mechanics: Mechanics, tmp_path: Path, table: str
) -> None:
    out = tmp_path / table
    call("design", scene, "-n", 6, *INPUTS, "--run", "--store", tmp_path / "store", "--out", out)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name.startswith("runs")}
    call("design", scene, "-n", 6, *INPUTS, "--run", "--store", tmp_path / "store", "--out", out)
    assert mechanics.runs == 6, "the same is not run again"
    scene.write_text(scene.read_text().replace("roof = 1.7", "roof = 5.0"))
    with pytest.raises(UsageError, match=rf"{table.split('.')[0]}.* materials\.c_kpa\.roof was 1\.7, is 5\. .*--fresh"):
        call("design", scene, "-n", 6, *INPUTS, "--run", "--store", tmp_path / "store", "--out", out)
    assert mechanics.runs == 6
    after = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name.startswith("runs")}
    assert after.keys() == before.keys() and all(after[name] == before[name] for name in before if ".parquet" not in name)
    for _ in range(2):  # the second time all is there
        fresh = call("design", scene, "-n", 6, *INPUTS, "--run", "--store", tmp_path / "store", "--out", out, "--fresh")
        assert Path(fresh["table"]) == tmp_path / "runs_fresh_1" / table and mechanics.runs == 12
    read = pd.read_parquet if table.endswith("parquet") else pd.read_csv
    old, new = read(out), read(fresh["table"])
    assert np.allclose(old["d_global_mm"] / new["d_global_mm"], 5.0 / 1.7)
    if table.endswith("parquet"):
        assert old.attrs["lacli_identity"]["content"]["materials.c_kpa.roof"] == 1.7


def test_fewer_points_or_points_alone_never_replace_finished_rows(scene: Path, mechanics: Mechanics, tmp_path: Path) -> None:
    out = tmp_path / "runs.csv"
    call("design", scene, "-n", 8, *INPUTS, "--run", "--out", out)
    all_rows = pd.read_csv(out)
    fewer = call("design", scene, "-n", 4, *INPUTS, "--run", "--out", out)
    assert (fewer["points"], fewer["rows"], mechanics.runs) == (4, 8, 8)
    pd.testing.assert_frame_equal(pd.read_csv(out), all_rows)
    for options in ((), ("-n", 2), ("-n", 99)):
        with pytest.raises(UsageError, match=r"runs\.csv holds 8 rows with .* which points alone would replace"):
            call("design", *options, *INPUTS, "--out", out)
    pd.testing.assert_frame_equal(pd.read_csv(out), all_rows)
    points = call("design", "-n", 2, *INPUTS, "--out", out, "--fresh")
    assert len(pd.read_csv(points["table"])) == 2 and Path(points["table"]) != out
    call("design", "-n", 3, *INPUTS, "--out", points["table"])  # points cost nothing: they may be chosen anew


def test_runs_that_the_machine_ended_are_no_rows_of_a_design(scene: Path, mechanics: Mechanics, tmp_path: Path) -> None:
    out = tmp_path / "runs.csv"
    mechanics.killed = ["killed", "out_of_memory"]
    first = call("design", scene, "-n", 6, *INPUTS, "--run", "--out", out)
    assert first["failed"] == 0 and mechanics.runs == 8
    mechanics.killed = ["killed"] * 99
    with pytest.raises(LacliError, match=r"ended by the machine 3 times"):
        call("design", scene, "-n", 8, *INPUTS, "--run", "--out", out)
    with pytest.raises(LacliError, match=r"ended by the machine 3 times"):
        call("design", scene, "-n", 8, *INPUTS, "--run", "--out", out)
    assert mechanics.runs == 8 + 2 * 3
    learnt = call("design", "-n", 4, *INPUTS, "--runs", out, "--out", tmp_path / "more.csv")
    assert "0 failed runs" in learnt["note"], "nothing is learnt from what the machine did"
    mechanics.killed = []
    again = call("design", scene, "-n", 8, *INPUTS, "--run", "--out", out, "--retry")
    assert again["failed"] == 0 and (pd.read_csv(out)["status"] == "done").all()


# --- calibrate ----------------------------------------------------------------------------------------------------------

TARGETS = "[targets.esv_ml]\nmean = 78.0\nsd = 1.0\n[targets.d_roof_mm]\nmean = 6.0\nsd = 0.3\n"
BOX = "[box]\nalpha_roof = [0.5, 2.0]\nesp_mmhg = [15.0, 25.0]\n"
OPTIONS = (
    "--targets", "targets.toml", "--box", "box.toml", "--out", "out", "--first-runs", 14, "--wave-runs", 6, "--max-waves", 1,
    "--ess", 100, "--no-figures",
)  # fmt: skip


@pytest.fixture
def calibrated(scene: Path, mechanics: Mechanics, tmp_path: Path) -> dict[str, bytes]:
    """A finished calibration in ``out``; all its files."""
    (tmp_path / "targets.toml").write_text(TARGETS)
    (tmp_path / "box.toml").write_text(BOX)
    call("calibrate", scene, *OPTIONS)
    return contents(tmp_path / "out")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def bundle_changes(tmp_path: Path, patch: pytest.MonkeyPatch) -> tuple[str, ...]:
    bundles.save(hollow_cube(31.0), tmp_path / "bundle")
    return ()


def scene_changes(tmp_path: Path, patch: pytest.MonkeyPatch) -> tuple[str, ...]:
    with_value(tmp_path / "scene.toml", "bf", 7.0)
    return ()


def targets_change(tmp_path: Path, patch: pytest.MonkeyPatch) -> tuple[str, ...]:
    (tmp_path / "targets.toml").write_text(TARGETS.replace("0.3", "0.2"))
    return ()


def box_changes(tmp_path: Path, patch: pytest.MonkeyPatch) -> tuple[str, ...]:
    (tmp_path / "box.toml").write_text(BOX.replace("25.0", "26.0"))
    return ()


def version_changes(tmp_path: Path, patch: pytest.MonkeyPatch) -> tuple[str, ...]:
    patch.setattr(identity, "__version__", "99")
    return ()


def method_changes(tmp_path: Path, patch: pytest.MonkeyPatch) -> tuple[str, ...]:
    patch.setitem(identity.METHODS, "calibration", 99)
    return ()


def scripts_change(tmp_path: Path, patch: pytest.MonkeyPatch) -> tuple[str, ...]:
    patch.setattr(identity, "solver_digest", lambda: "other")
    return ()


CHANGES: dict[str, tuple[Callable[[Path, pytest.MonkeyPatch], tuple[str, ...]], str]] = {
    "bundle": (bundle_changes, r"bundle was content"),
    "scene": (scene_changes, r"materials\.bf was 8, is 7"),
    "override": (lambda *_: ("--set", "materials.bf=7"), r"materials\.bf was 8, is 7"),
    "targets": (targets_change, r"targets\.sd\.d_roof_mm was 0\.3, is 0\.2"),
    "box": (box_changes, r"box\.upper\.esp_mmhg was 25, is 26"),
    "version": (version_changes, r"lacli was .*, is 99"),
    "method": (method_changes, rf"method was {identity.METHODS['calibration']}, is 99"),
    "scripts": (scripts_change, r"scripts was content"),
    "seed": (lambda *_: ("--seed", "1"), r"settings\.seed was 0, is 1"),
    "prior": (lambda *_: ("--prior", "box"), r"settings\.prior was nroy, is box"),
    "first runs": (lambda *_: ("--first-runs", "15"), r"settings\.first_runs was 14, is 15"),
    "wave runs": (lambda *_: ("--wave-runs", "7"), r"settings\.wave_runs was 6, is 7"),
}


def test_a_calibration_never_answers_for_another(
    calibrated: dict[str, bytes], scene: Path, mechanics: Mechanics, tmp_path: Path
) -> None:
    """Each determining input changed in turn: refused with the key's old and new value, nothing run, nothing touched."""
    files = {path: path.read_bytes() for path in (scene, *tmp_path.glob("*.toml"), *(tmp_path / "bundle").iterdir())}
    runs = mechanics.runs
    for what, (change, words) in CHANGES.items():
        with pytest.MonkeyPatch.context() as patch:
            more = change(tmp_path, patch)
            with pytest.raises(UsageError, match=rf"out holds a calibration made from something else: .*{words}.*--fresh"):
                call("calibrate", scene, *OPTIONS, *more)
        assert mechanics.runs == runs and contents(tmp_path / "out") == calibrated, what
        for path, content in files.items():
            path.write_bytes(content)
    call("calibrate", scene, *OPTIONS)
    assert mechanics.runs == runs and contents(tmp_path / "out") == calibrated, "the same is found again"


def test_budgets_may_change_and_it_goes_on(
    calibrated: dict[str, bytes], scene: Path, mechanics: Mechanics, tmp_path: Path
) -> None:
    before = mechanics.runs
    more = call("calibrate", scene, *OPTIONS, "--max-waves", 2, "--ess", 200, "--hours", 5)
    assert len(more["waves"]) == 2 and more["waves"][0] == json.loads(calibrated["result.json"])["waves"][0]
    # 6 of the second wave, the answer and 8 draws
    assert mechanics.runs - before <= 6 + 9


def test_fresh_starts_beside_and_leaves_the_first(
    calibrated: dict[str, bytes], scene: Path, mechanics: Mechanics, tmp_path: Path
) -> None:
    other = call("calibrate", scene, *OPTIONS, "--set", "materials.c_kpa=2.5", "--fresh")
    first = json.loads(calibrated["result.json"])
    values = [{row["input"]: row["mean"] for row in result["posterior"]} for result in (first, other)]
    # stiffness is c x alpha: the same motion with c 2.5 for 1.7 takes a smaller alpha
    assert values[1]["alpha_roof"] < 0.85 * values[0]["alpha_roof"]
    assert {name: content for name, content in contents(tmp_path / "out").items() if "fresh_1" not in name} == calibrated
    before = mechanics.runs
    again = call("calibrate", scene, *OPTIONS, "--set", "materials.c_kpa=2.5", "--fresh")
    assert mechanics.runs == before and again["posterior"] == other["posterior"]


def test_an_older_calibration_that_says_nothing_is_not_trusted(
    calibrated: dict[str, bytes], scene: Path, mechanics: Mechanics, tmp_path: Path
) -> None:
    (tmp_path / "out" / "calibration.json").write_text('{"box": {}, "targets": {}, "settings": {}, "given_runs": 0}')
    with pytest.raises(UsageError, match=r"holds a calibration that does not say what it was made from"):
        call("calibrate", scene, *OPTIONS)
    shutil.rmtree(tmp_path / "out" / "wave_1")
    (tmp_path / "out" / "calibration.json").unlink()
    (tmp_path / "out" / "runs.csv.identity.json").unlink()
    with pytest.raises(UsageError, match=r"runs that do(es)? not say what"):
        call("calibrate", scene, *OPTIONS)


def test_targets_that_nothing_reaches_do_not_stand_in_the_way_of_better_ones(
    scene: Path, mechanics: Mechanics, tmp_path: Path
) -> None:
    (tmp_path / "targets.toml").write_text(TARGETS.replace("78.0", "780.0"))
    (tmp_path / "box.toml").write_text(BOX)

    def nothing(*_: object, **__: object) -> None:  # what is found there, without the minute that the search takes
        raise EmptyRegionError("nothing", 9.0, np.array([1.0, 20.0]))

    with pytest.MonkeyPatch.context() as patch, pytest.raises(LacliError, match=r"no point .*esv_ml is .* the target is 780"):
        patch.setattr("lacli.calibration.calibration.match", nothing)
        call("calibrate", scene, *OPTIONS)
    (tmp_path / "targets.toml").write_text(TARGETS)
    runs = mechanics.runs
    assert call("calibrate", scene, *OPTIONS)["waves"][0]["runs"] == 14
    assert mechanics.runs - runs == 9, "the answer and its draws: the first wave's runs are kept"


def test_another_table_with_as_many_rows_is_another_calibration(calibrated: dict[str, bytes], tmp_path: Path) -> None:
    frame = pd.read_csv(tmp_path / "out" / "runs.csv")
    frame.to_csv(tmp_path / "t.csv", index=False)
    options = ("--from-table", "t.csv", *OPTIONS[:4], "--out", "table", "--ess", 100, "--no-figures")
    first = call("calibrate", *options)
    frame["d_roof_mm"] += 0.2
    frame.to_csv(tmp_path / "t.csv", index=False)
    before = contents(tmp_path / "table")
    with pytest.raises(UsageError, match=r"table holds a calibration made from something else: runs\.y was"):
        call("calibrate", *options)
    assert contents(tmp_path / "table") == before
    other = call("calibrate", *options, "--fresh")
    assert other["posterior"] != first["posterior"]


def test_a_row_changed_by_hand_is_learnt_anew(calibrated: dict[str, bytes], scene: Path, tmp_path: Path) -> None:
    """Emulators, region and chain of a wave are those of its rows, whatever became of them."""
    file = tmp_path / "out" / "runs.csv"
    frame = pd.read_csv(file)
    frame["d_roof_mm"] += 0.2
    frame.to_csv(file, index=False)
    changed = call("calibrate", scene, *OPTIONS)
    assert changed["posterior"] != json.loads(calibrated["result.json"])["posterior"]


def test_retry_reaches_the_runs_of_known_parameters(scene: Path, mechanics: Mechanics, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def verify(*given: object) -> None:
        asked.append(given[-1])
        raise LacliError("enough is seen")

    monkeypatch.setattr("lacli.calibration.synthetic_truth.verify", verify)
    for words in ((), ("--retry",)):
        with pytest.raises(LacliError, match="enough is seen"):
            call("calibrate", scene, "--synthetic-truth", "--out", "out", *words)
    assert asked == [False, True] and mechanics.runs == 0
