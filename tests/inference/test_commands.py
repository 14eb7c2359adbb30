"""The commands on plain tables of another simulator."""

import json
import warnings

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from lacli.cli.main import build
from lacli.errors import LacliError, StorageError, TableError, UsageError

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
    assert len(left) == 500 and (left["implausibility"] < 3).all()
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
