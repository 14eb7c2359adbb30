"""The commands on plain tables of another simulator."""

import json
import shutil
import warnings

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from lacli.base.errors import InputError, LacliError, StorageError, TableError, UsageError
from lacli.calibration.from_table import _box_of as table_inputs
from lacli.cli.main import build
from lacli.contracts.scene import dump_scene
from lacli.contracts.targets import Targets
from lacli.inference.matching import matching
from lacli.inference.runs import Outcome

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import arviz  # noqa: F401  (announces its next version once, at import)


def call(*arguments):
    words = [str(a) for a in arguments]
    result = CliRunner().invoke(build({words[0]}), words, catch_exceptions=True)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.stdout


def document(*arguments):
    return json.loads(call(*arguments, "--json"))


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """60 runs of v = 50 + 10 / a + 5 c and two displacements; targets at (1, 2, 0.4)."""
    folder = tmp_path_factory.mktemp("tables")
    rng = np.random.default_rng(0)
    x = rng.uniform([0.2, 0.2, 0.0], [4.0, 4.0, 1.0], (60, 3))
    a, b, c = x.T
    pd.DataFrame(x, columns=["a", "b", "c"]).to_csv(folder / "x.csv", index=False)
    y = np.c_[50 + 10 / a + 5 * c, 3 / np.sqrt(a) + c, 4 / b + 0.5 * c]
    pd.DataFrame(y, columns=["v_ml", "d_one_mm", "d_two_mm"]).to_csv(folder / "y.csv", index=False)
    (folder / "t.toml").write_text(
        "".join(
            f"[targets.{n}]\nmean = {m}\nsd = {s}\n"
            for n, m, s in (("v_ml", 62, 0.6), ("d_one_mm", 3.4, 0.1), ("d_two_mm", 2.2, 0.1))
        )
    )
    return folder


def test_derivatives_in_a_table_are_no_inputs(tables, tmp_path):
    """Of a table whose box is its own: its inputs are those that vary, neither errors nor derivatives of any output."""
    x, y = pd.read_csv(tables / "x.csv"), pd.read_csv(tables / "y.csv")
    frame = pd.concat([x, y[["v_ml"]]], axis=1).assign(**{"v_ml_error": 0.1, "dv_ml/da": -10 / x["a"] ** 2, "dv_ml/dc": x["a"]})
    frame.to_csv(tmp_path / "t.csv", index=False)
    assert table_inputs(tmp_path / "t.csv", frame, Targets(("v_ml",), np.array([62.0]), np.array([0.6]))).names == ("a", "b", "c")


def test_starts_that_do_nothing_are_told(tmp_path):
    """Of a table with derivatives, whose fit has one start; without them they count."""
    x = np.linspace(0.0, 1.0, 9)
    pd.DataFrame({"a": x}).to_csv(tmp_path / "x.csv", index=False)
    pd.DataFrame({"y": x**2, "dy/da": 2 * x}).to_csv(tmp_path / "y.csv", index=False)
    words = ["emulate", "--inputs", str(tmp_path / "x.csv"), "--outputs", str(tmp_path / "y.csv"), "--no-figures"]
    words += ["--out", str(tmp_path / "e.npz")]
    for more, told in (([], False), (["--starts", "2"], True), (["--starts", "2", "--no-gradients"], False)):
        result = CliRunner().invoke(build({"emulate"}), [*words, *more], catch_exceptions=False)
        assert result.exit_code == 0 and ("--starts does nothing where a table has derivatives" in result.stderr) == told


@pytest.fixture(scope="module")
def emulated(tables):
    result = document(
        "emulate", "--inputs", tables / "x.csv", "--outputs", tables / "y.csv", "--out", tables / "e.npz", "--starts", 1
    )
    return tables, result


def test_emulate(emulated):
    folder, result = emulated
    assert set(result["outputs"]) == {"v_ml", "d_one_mm", "d_two_mm"}
    for scores in result["outputs"].values():
        assert set(scores) == {"r2", "ise", "nlpd", "train_cpu_s"}
        assert scores["r2"] > 0.99 and 0.85 < scores["ise"] <= 1
    assert (folder / "e.npz").is_file() and (folder / "e.png").stat().st_size > 10_000


def test_sensitivity(emulated):
    folder, _ = emulated
    result = document("sensitivity", "--emulators", folder / "e.npz", "--out", folder / "s", "-n", 256, "--draws", 8)
    assert {r["input"] for r in result["ranking"][:2]} == {"a", "b"}
    of_b = {r["output"]: r["total"] for r in result["indices"] if r["input"] == "b"}
    assert of_b["v_ml"] < 0.01 < 0.9 < of_b["d_two_mm"]
    assert (folder / "s" / "ranking.png").is_file() and (folder / "s" / "second_order.csv").is_file()
    with pytest.raises(UsageError, match="power of two"):
        call("sensitivity", "--emulators", folder / "e.npz", "-n", 100)


def test_match_and_posterior(emulated):
    folder, _ = emulated
    found = document(
        "match", "--emulators", folder / "e.npz", "--targets", folder / "t.toml", "--out", folder / "m", "-n", 500, "--next", 12
    )
    assert 0 < found["share"] < 0.2
    left = pd.read_csv(folder / "m" / "nroy.csv")
    assert found["threshold"] == 3.5, "a first wave's"
    assert len(left) == 500 and 3 < left["implausibility"].max() < 3.5
    assert len(pd.read_csv(folder / "m" / "next.csv")) == 12
    options = ("--emulators", folder / "e.npz", "--targets", folder / "t.toml", "--out", folder / "p", "--ess", 1000)
    first = document("posterior", *options)
    for row, truth in zip(first["inputs"], (1.0, 2.0, 0.4), strict=True):
        assert row["low95"] < truth < row["high95"]
    assert first["converged"] and first["ess"] >= 1000
    again = document("posterior", *options)  # nothing left to do
    assert again["steps"] == first["steps"] and again["inputs"] == first["inputs"]
    assert all((folder / "p" / name).is_file() for name in ("corner.png", "trace.png", "posterior.nc", "summary.csv"))


def test_calibrate_from_a_table(tables):
    frame = pd.concat([pd.read_csv(tables / "x.csv"), pd.read_csv(tables / "y.csv")], axis=1)
    frame.assign(status="done", wave=1).to_parquet(tables / "runs.parquet", index=False)
    result = document(
        "calibrate",
        "--from-table",
        tables / "runs.parquet",
        "--targets",
        tables / "t.toml",
        "--out",
        tables / "c",
        "--no-figures",
    )
    assert result["stopped"] == "runs from a table" and [r["input"] for r in result["posterior"]] == ["a", "b", "c"]
    for row, truth in zip(result["posterior"], (1.0, 2.0, 0.4), strict=True):
        assert row["low95"] < truth < row["high95"]


def test_design(tmp_path):
    result = document("design", "-n", 20, "--out", tmp_path / "d.csv")
    frame = pd.read_csv(tmp_path / "d.csv")
    assert result["points"] == 20 and list(frame) == result["inputs"] and len(result["inputs"]) == 9
    assert frame["edp_mmhg"].between(1, 12).all() and frame["k_peri_kpa_per_um"].between(0.0001, 0.005).all()
    assert len(document("design", "-n", 8, "--all-inputs", "--out", tmp_path / "d.parquet")["inputs"]) == 14
    frame["status"] = np.where(frame["edp_mmhg"] > 8, "failed", "done")
    frame.to_csv(tmp_path / "runs.csv", index=False)
    steered = document("design", "-n", 40, "--runs", tmp_path / "runs.csv", "--out", tmp_path / "d2.csv")
    assert "runs failed" in steered["note"]
    assert (pd.read_csv(tmp_path / "d2.csv")["edp_mmhg"] > 8).mean() < 0.2


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("emulate",), UsageError, "give --inputs and --outputs"),
        (("emulate", "--inputs", "absent.csv", "--outputs", "absent.csv"), TableError, "no such table"),
        (("design", "--method", "grid"), UsageError, "sobol, lhs, maximin"),
        (("design", "--run"), UsageError, "needs a scene"),
        (("design", "--input", "beta"), UsageError, "no published range for beta"),
        (("calibrate", "--targets", "t.toml"), UsageError, "give a SCENE"),
        (("calibrate", "scene.toml"), UsageError, "either --targets or --synthetic-truth"),
        (("match", "--emulators", "absent.npz", "--targets", "absent.toml"), LacliError, "no such"),
        (("posterior", "--emulators", "e.npz", "--targets", "t.toml", "--prior", "flat"), UsageError, "nroy or box"),
    ],
)
def test_wrong_calls_give_one_clear_message(arguments, error, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error, match=message):
        call(*arguments)


def test_names_with_brackets_are_shown_as_they_are(tables, tmp_path):
    """Units in brackets, which Rich would take for its own marks; dollars, which matplotlib would take for formulas."""
    x, y = pd.read_csv(tables / "x.csv"), pd.read_csv(tables / "y.csv")
    x.columns = ["E [kPa]", "rate [/s]", "c :mag: $^$"]
    x.to_csv(tmp_path / "x.csv", index=False)
    y.columns = ["V [mL] $_$", "d [/mm] $", "still [/]"]
    y.assign(**{"still [/]": 1.0}).to_csv(tmp_path / "y.csv", index=False)
    folder = tmp_path / "[/out]"
    text = call(
        "emulate", "--inputs", tmp_path / "x.csv", "--outputs", tmp_path / "y.csv", "--out", folder / "e.npz", "--starts", 1
    )
    assert "V [mL]" in text and "d [/mm]" in text and "[/out]" in text
    text = call("sensitivity", "--emulators", folder / "e.npz", "--out", folder / "s", "-n", 16, "--draws", 0)
    assert all(name in text for name in x.columns)
    text = call("design", "-n", 4, "--box", box_file(tmp_path, x.columns), "--out", folder / "d.csv")
    assert all(name in text for name in x.columns)


def box_file(folder, names):
    (folder / "box.toml").write_text("[box]\n" + "".join(f'"{name}" = [0, 1]\n' for name in names))
    return folder / "box.toml"


def test_a_damaged_emulator_file_is_told(emulated, tmp_path):
    whole = (emulated[0] / "e.npz").read_bytes()
    middle = len(whole) // 2
    np.save(tmp_path / "array.npy", np.arange(3))
    np.savez(tmp_path / "list.npz", format=np.arange(3))
    for name, content in {
        "empty.npz": b"",
        "half.npz": whole[:middle],
        "spoilt.npz": whole[:middle] + bytes(200) + whole[middle + 200 :],
        "array.npz": (tmp_path / "array.npy").read_bytes(),
        "list.npz": (tmp_path / "list.npz").read_bytes(),
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=rf"{name}: not an emulator file, or a damaged one"):
            call("sensitivity", "--emulators", tmp_path / name, "--out", tmp_path / "s")


def test_emulators_of_an_earlier_wave_need_the_same_outputs(emulated, tmp_path):
    folder, _ = emulated
    tables = ("--inputs", folder / "x.csv", "--outputs", folder / "y.csv", "--output", "v_ml")
    call("emulate", *tables, "--out", tmp_path / "v.npz", "--starts", 1, "--no-figures")
    with pytest.raises(UsageError, match=r"v\.npz: no emulator of d_one_mm, d_two_mm; there are v_ml"):
        call(
            "match", "--emulators", folder / "e.npz", "--targets", folder / "t.toml", "--earlier", tmp_path / "v.npz",
            "--out", tmp_path / "m",
        )  # fmt: skip


def test_the_waves_have_the_thresholds_of_a_calibration(emulated, tmp_path, monkeypatch):
    """3.5 in the first wave, 3 after; what is said of this wave, or of all earlier ones, stands."""
    folder, _ = emulated
    seen = []
    wave = matching.Wave
    monkeypatch.setattr(matching, "Wave", lambda *of: seen.append(of[2]) or wave(*of))
    earlier = ("--earlier", folder / "e.npz", "--earlier", folder / "e.npz")
    for options, thresholds in (
        ((), [3.5]), (("--threshold", 2.5), [2.5]), (earlier[:2], [3.5, 3.0]), (earlier, [3.5, 3.0, 3.0]),
        ((*earlier, "--earlier-threshold", 4, "--threshold", 2.8), [4.0, 4.0, 2.8]),
    ):  # fmt: skip
        seen.clear()
        call(
            "match", "--emulators", folder / "e.npz", "--targets", folder / "t.toml", "-n", 20, "--next", 0, "--no-figures",
            "--out", tmp_path / "m", *options,
        )  # fmt: skip
        assert seen == thresholds


def test_a_box_where_an_input_has_no_logarithm_is_refused(emulated, tmp_path):
    folder, _ = emulated
    (tmp_path / "box.toml").write_text("[box]\na = [-1, 4]\nb = [0.2, 4]\nc = [0, 1]\n")
    with pytest.raises(UsageError, match=r"box\.toml: a starts at -1; .* logarithm"):
        call("sensitivity", "--emulators", folder / "e.npz", "--box", tmp_path / "box.toml", "--out", tmp_path / "s")


@pytest.mark.parametrize(("value", "words"), [("", "a has no finite value in row 2"), ("oops", "row 2 holds 'oops'")])
def test_earlier_runs_need_numbers(value, words, tmp_path):
    rows = [f"0.{i},0.5,{'failed' if i < 4 else 'done'}" for i in range(1, 9)]
    rows[1] = f"{value},0.5,failed"
    (tmp_path / "runs.csv").write_text("\n".join(["a,b,status", *rows]))
    (tmp_path / "box.toml").write_text("[box]\na = [0, 1]\nb = [0, 1]\n")
    with pytest.raises(TableError, match=rf"runs\.csv: .*{words}"):
        call("design", "-n", 4, "--runs", tmp_path / "runs.csv", "--box", tmp_path / "box.toml", "--out", tmp_path / "d.csv")


def test_a_design_that_was_looked_at_first_is_run(tmp_path, monkeypatch):
    """The points alone are written where the runs will be: they are no finished runs."""
    asked = []

    class Simulator:
        def determined_by(self, inputs):
            return {}

        def __call__(self, inputs):
            asked.append(len(inputs))
            yield from ((i, Outcome({"esv_ml": 90.0})) for i in range(len(inputs)))

    (tmp_path / "scene.toml").write_text('[anatomy]\nbundle = "la"\n')
    monkeypatch.setattr("lacli.calibration.simulator.simulator", lambda *_, **__: Simulator())
    call("design", "-n", 4, "--out", tmp_path / "d.csv")
    for _ in range(2):  # the second time all are known
        result = document("design", tmp_path / "scene.toml", "-n", 4, "--run", "--out", tmp_path / "d.csv")
        assert asked == [4] and result["failed"] == 0
        frame = pd.read_csv(tmp_path / "d.csv")
        assert (frame["status"] == "done").all() and (frame["esv_ml"] == 90).all()


def test_runs_are_not_added_to_a_table_of_something_else(tmp_path, scene_of):
    (tmp_path / "other.csv").write_text("price,sort\n1,2\n")
    (tmp_path / "scene.toml").write_text(dump_scene(scene_of()))
    with pytest.raises(UsageError, match=r"other\.csv holds .* no column alpha_anterior.* another --out"):
        call("design", "-n", 4, "--run", tmp_path / "scene.toml", "--out", tmp_path / "other.csv")
    with pytest.raises(UsageError, match=r"other\.csv holds 1 rows with price, sort"):
        call("design", "-n", 4, "--out", tmp_path / "other.csv")
    assert (tmp_path / "other.csv").read_text() == "price,sort\n1,2\n"


@pytest.mark.parametrize(
    "words",
    [
        "emulate --inputs x.csv --outputs y.csv",
        "sensitivity --emulators e.npz",
        "match --emulators e.npz --targets t.toml",
        "posterior --emulators e.npz --targets t.toml",
        "design -n 4",
    ],
)
def test_an_output_that_cannot_be_made_is_refused_before_the_work(words, tables, tmp_path, monkeypatch):
    monkeypatch.chdir(tables)
    (tmp_path / "file").write_text("x")
    # the tables of runs and the emulators are not even looked at
    with pytest.raises(StorageError, match=r"file: cannot be written, .* is a file|file is a file"):
        call(*words.split(), "--out", tmp_path / "file" / "deeper")
    with pytest.raises(StorageError, match=r"is a file|a folder of that name"):
        call(*words.split(), "--out", tmp_path if words.startswith(("emulate", "design")) else tmp_path / "file")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_targets_outside_all_runs_are_told(emulated):
    folder, _ = emulated
    (folder / "far.toml").write_text("[targets.v_ml]\nmean = 900\nsd = 1\n")
    with pytest.raises(LacliError, match=r"nothing is left: .* v_ml is .* where the target is 900"):
        call("match", "--emulators", folder / "e.npz", "--targets", folder / "far.toml", "--out", folder / "far")


def test_a_chain_of_other_targets_is_not_gone_on_with(emulated, tmp_path):
    folder, _ = emulated
    options = ("--emulators", folder / "e.npz", "--out", tmp_path / "p", "--ess", 100, "--no-figures")
    first = document("posterior", "--targets", folder / "t.toml", *options)
    chain = (tmp_path / "p" / "chain.npz").read_bytes()
    (tmp_path / "t.toml").write_text((folder / "t.toml").read_text().replace("sd = 0.6", "sd = 0.5"))
    with pytest.raises(UsageError, match=r"holds a chain .*targets\.sd\.v_ml was 0\.6, is 0\.5.*--fresh"):
        call("posterior", "--targets", tmp_path / "t.toml", *options)
    other = document("posterior", "--targets", tmp_path / "t.toml", *options, "--fresh")
    assert other["inputs"] != first["inputs"] and (tmp_path / "p" / "fresh_1" / "chain.npz").is_file()
    assert (tmp_path / "p" / "chain.npz").read_bytes() == chain


def test_a_folder_of_results_shows_one_call(emulated, tmp_path):
    """Figures and proposals of an earlier call do not stay beside the results of another."""
    folder, _ = emulated
    out = tmp_path / "m"
    options = ("--emulators", folder / "e.npz", "--targets", folder / "t.toml", "--out", out, "-n", 500)
    call("match", *options, "--next", 5)
    assert {"next.csv", "region.png", "outputs.png", "nroy.csv", "identity.json"} == {path.name for path in out.iterdir()}
    call("match", *options, "--next", 0, "--threshold", 2.5, "--no-figures")
    assert {"nroy.csv", "identity.json"} == {path.name for path in out.iterdir()}
    assert json.loads((out / "identity.json").read_text())["content"]["region.waves.1.threshold"] == 2.5
    call("sensitivity", "--emulators", folder / "e.npz", "--out", tmp_path / "s", "-n", 16, "--draws", 0)
    call("sensitivity", "--emulators", folder / "e.npz", "--out", tmp_path / "s", "-n", 32, "--draws", 0, "--no-figures")
    assert {"indices.csv", "second_order.csv", "identity.json"} == {path.name for path in (tmp_path / "s").iterdir()}
    shutil.copy(folder / "e.npz", tmp_path / "e.npz")
    (tmp_path / "e.png").write_bytes(b"of other emulators")
    tables = ("--inputs", folder / "x.csv", "--outputs", folder / "y.csv", "--output", "v_ml")
    call("emulate", *tables, "--out", tmp_path / "e.npz", "--starts", 1, "--no-figures")
    assert not (tmp_path / "e.png").exists()
