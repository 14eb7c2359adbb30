"""`lacli stats` at the terminal."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
from typer.testing import CliRunner

from lacli.cli import main

REGIONS = ("anterior", "posterior", "septum")


def _table(path: Path) -> Path:
    rng = np.random.default_rng(0)
    ids = np.repeat([f"sub-{i}" for i in range(6)], 3)
    frame = pd.DataFrame(
        {"participant_id": ids, "region": REGIONS * 6, "d_mm": rng.normal(5, 1, 18), "alpha": rng.normal(1, 0.5, 18)}
    )
    frame.assign(alpha_sd=0.1).to_csv(path, index=False)
    return path


def test_one_document_and_five_files(tmp_path: Path) -> None:
    call = [
        "stats",
        str(_table(tmp_path / "t.csv")),
        "--response",
        "d_mm",
        "--predictor",
        "alpha",
        "--out",
        str(tmp_path / "out"),
    ]
    shown = CliRunner().invoke(main.build({"stats"}), [*call, "--json"])
    assert shown.exit_code == 0, shown.output
    document = json.loads(shown.stdout)
    assert len(document["pairs"]) == 3 and [c["method"] for c in document["associations"][0]["carried"]] == ["structural"]
    assert all(Path(file).is_file() for file in document["files"])
    assert "circular" in shown.stderr
    shown = CliRunner().invoke(main.build({"stats"}), call)
    assert "structural" in shown.stdout and shown.exit_code == 0


def test_nothing_is_written_for_a_bad_table(tmp_path: Path) -> None:
    table = _table(tmp_path / "t.csv")
    table.write_text(table.read_text().replace("sub-3", "../sub-3"))
    shown = CliRunner().invoke(main.build({"stats"}), ["stats", str(table), "--response", "d_mm", "--out", str(tmp_path / "out")])
    assert type(shown.exception).__name__ == "TableError" and "identifier" in str(shown.exception)
    assert not (tmp_path / "out").exists()
