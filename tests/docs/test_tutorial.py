"""Every command of the tutorial is run, in its order, with the files that it says to write."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tutorial.md"
BLOCK = re.compile(r"(?:Write `(?P<file>[\w.]+)`[^`]*)?```(?P<kind>sh|toml)\n(?P<text>.*?)```", re.DOTALL)


def _targets(folder: Path) -> str:
    """Targets that one of the runs reached: the tutorial's own are an example."""
    run = pd.read_csv(folder / "runs.csv").query("status == 'done'").iloc[0]
    names = ("d_global_mm", "d_roof_mm", "d_posterior_mm")
    return "".join(f"[targets.{name}]\nmean = {run[name]}\nsd = 0.2\n" for name in names)


@pytest.mark.slow
def test_the_tutorial_is_true(tmp_path: Path, freefem: object) -> None:
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    blocks = list(BLOCK.finditer(PAGE.read_text(encoding="utf-8")))
    assert sum(block["kind"] == "toml" for block in blocks) == 3
    for block in blocks:
        if block["kind"] == "toml":
            text = _targets(tmp_path) if block["file"] == "targets.toml" else block["text"]
            (tmp_path / block["file"]).write_text(text)
            continue
        for line in block["text"].strip().splitlines():
            done = subprocess.run(
                ["sh", "-c", line], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900, check=False
            )
            assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    summary = pd.read_csv(tmp_path / "posterior" / "summary.csv")
    truth = pd.read_csv(tmp_path / "runs.csv").query("status == 'done'").iloc[0]
    assert set(summary["input"]) == {"alpha_roof", "alpha_posterior"}
    for row in summary.itertuples():
        assert row.low95 <= truth[row.input] <= row.high95
    assert (tmp_path / "calibration" / "result.json").is_file()
