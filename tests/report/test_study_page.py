"""The page of a study, from made-up tables."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import lacli
from lacli.base.errors import InputError
from lacli.cohort.page import study_page
from lacli.contracts.labels import BODY_REGIONS


def _study(folder: Path, patients: int) -> Path:
    rng = np.random.default_rng(0)
    ids = [f"sub-{i}" for i in range(patients)]
    folder.mkdir()
    (folder / "summary.json").write_text(
        json.dumps({"patients": patients, "done": patients, "failed": [], "models": [], "notes": ["<i>a note</i>"]})
    )
    pd.DataFrame({"participant_id": ids, "status": "done", "age": 60}).to_csv(folder / "patients.csv", index=False)
    n = 5 * patients
    frame = pd.DataFrame({"participant_id": np.repeat(ids, 5), "region": BODY_REGIONS * patients})
    frame = frame.assign(d_mm=rng.normal(5, 1, n), alpha=rng.normal(1, 0.3, n), alpha_sd=0.05, thickness_mm=2.0)
    frame.to_csv(folder / "regions.csv", index=False)
    return folder


def test_the_page_of_a_study(tmp_path: Path) -> None:
    made = lacli.write_report(_study(tmp_path / "s", 6), tmp_path / "s.html")
    text = made.page.read_text(encoding="utf-8")
    assert made.kind == "study"
    assert "&lt;i&gt;a note" in text and "6 of 6 participants done" in text
    assert text.count("<img") == 3  # displacement and stiffness by region, one against the other
    assert "structural" in text and "circular" in text
    assert "@article{Holm1979," in text and "DelMoral2006" not in text  # no models are compared
    assert "d_mm ~ region + predictor" in text and "alpha ~ region" not in text  # the thickness is one number
    assert {f.name for f in made.figures.glob("d_mm*")} == {
        f"{n}.{s}" for n in ("d_mm", "d_mm_alpha") for s in ("png", "pdf", "svg")
    }


def test_slopes_take_how_the_regions_err_together(tmp_path: Path) -> None:
    """An error that all regions of a patient share is the intercept's, and thins no slope; alone, the same sd would."""
    study = _study(tmp_path / "s", 6)
    frame = pd.read_csv(study / "regions.csv").assign(alpha_sd=0.2)
    frame.to_csv(study / "regions.csv", index=False)
    alone = _structural(study, tmp_path / "alone")
    shared = 0.2 * np.random.default_rng(1).normal(size=(200, 6))
    shared -= shared.mean(axis=0)
    draws = pd.concat([frame[["participant_id", "region", "alpha"]].assign(draw=k) for k in range(200)])
    draws["alpha"] += np.repeat(shared, 5, axis=1).ravel()
    draws.to_csv(study / "draws.csv", index=False)
    told = lacli.stats(study / "regions.csv", "d_mm", ["alpha"], draws=study / "draws.csv").associations[0]
    together = _structural(study, tmp_path / "together")
    assert together[2] == f"{told.carried[0].estimate:.3g}"
    assert float(together[2]) == pytest.approx(told.plain.of("alpha").estimate, rel=0.3)
    assert abs(float(alone[2])) > 1.3 * abs(float(together[2]))
    # a study of which nothing of alpha is told has no use for them
    frame.drop(columns=["alpha", "alpha_sd"]).to_csv(study / "regions.csv", index=False)
    study_page(study, tmp_path / "without")


def _structural(study: Path, pictures: Path) -> list[str]:
    rows = [row for part in study_page(study, pictures).sections for table in part.tables for row in table.rows]
    (found,) = [list(map(str, row)) for row in rows if "structural" in row]
    return found


@pytest.mark.parametrize(("patients", "words"), [(1, "need at least 2"), (2, "Paired t-tests")])
def test_few_patients_are_said(tmp_path: Path, patients: int, words: str) -> None:
    text = lacli.write_report(_study(tmp_path / "s", patients), tmp_path / "s.html").page.read_text(encoding="utf-8")
    assert words in text and "structural</td>" not in text


def test_a_damaged_summary_is_told(tmp_path: Path) -> None:
    study = _study(tmp_path / "s", 2)
    (study / "summary.json").write_text("{}")
    with pytest.raises(InputError, match="not a study's summary"):
        lacli.write_report(study, tmp_path / "s.html")
