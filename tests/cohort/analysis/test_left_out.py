"""A displacement that was no target: what is left of the table, what the tracked motion fills, and what statistics make of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from chains import chain_of

from lacli.base.errors import TableError
from lacli.cohort.analysis.observations import read_observations
from lacli.cohort.analysis.statistics import statistics
from lacli.cohort.analysis.summary import write_summary
from lacli.cohort.analysis.transients import KEYS, at_end_systole
from lacli.cohort.files import DRAWS, REGIONS
from lacli.cohort.page import study_page
from lacli.cohort.participants import Participant
from lacli.cohort.study import Outcome
from lacli.contracts.labels import BODY_REGIONS
from lacli.inference.sampling.posterior import save_chain

SEPTUM = "septum"
OTHERS = [region for region in BODY_REGIONS if region != SEPTUM]


def finished(home: Path, targets: list[str], rng: np.random.Generator) -> None:
    """A patient who was calibrated to ``targets``, with alphas that differ."""
    (home / "calibration").mkdir(parents=True)
    means = rng.uniform(1.0, 2.0, len(BODY_REGIONS)).tolist()
    posterior = [{"input": f"alpha_{r}", "map": m, "mean": m, "sd": 0.1} for r, m in zip(BODY_REGIONS, means, strict=True)]
    fit = [{"feature": name, "target": float(rng.uniform(2, 5)), "sd": 0.2, "emulated": 3.0} for name in targets]
    (home / "calibration" / "result.json").write_text(json.dumps({"posterior": posterior, "fit": fit}))
    chain = chain_of([f"alpha_{r}" for r in BODY_REGIONS])
    chain.samples[:] = means + 0.1 * chain.samples
    save_chain(home / "calibration" / "chain.npz", chain)
    fits = [{"name": "regional", "rmse_mm": 0.5}]
    (home / "comparison.json").write_text(json.dumps({"fits": fits}))


def track(motion: Path, size: float) -> None:
    """Displacements that are ``size`` at end-systole, half way of ten frames."""
    motion.mkdir()
    time = np.arange(10) / 10
    course = size * np.sin(np.pi * time) ** 2
    columns = {"time": time, "phase": "reservoir", "volume_ml": 100 + 10 * course} | {key: course for key in KEYS[1:]}
    pd.DataFrame(columns).to_csv(motion / "transients.csv", index=False)
    document = {"phases": {"es": 0.5}, "sd": dict.fromkeys(KEYS, 0.3), "shrinkage": None}
    (motion / "tracking.json").write_text(json.dumps(document))


def study(home: Path, targets: list[str], motions: bool) -> list[str]:
    """The notes of a study of four patients."""
    rng = np.random.default_rng(0)
    people = [Participant(f"sub-{i}", {}, {}) for i in range(4)]
    for i, patient in enumerate(people):
        finished(home / patient.identifier, targets, rng)
        if motions:
            track(home / patient.identifier / "motion", 4.0 + i)
    _, summary = write_summary(home, people, [Outcome(p.identifier, "done", "", "", {}) for p in people])
    return list(summary["notes"])


def test_a_region_that_was_no_target_leaves_the_others_displacements(tmp_path: Path) -> None:
    notes = study(tmp_path / "s", [f"d_{region}_mm" for region in OTHERS], motions=False)
    assert f"regions.csv has no d_mm of {SEPTUM}: not every patient has it." in notes
    table = pd.read_csv(tmp_path / "s" / REGIONS)
    assert set(table.loc[table["d_mm"].isna(), "region"]) == {SEPTUM} and len(table) == 20
    assert "thickness_mm" not in table, "of which nothing is known at all"
    page = study_page(tmp_path / "s", tmp_path)
    of = {section.anchor: section for section in page.sections}
    assert any("d_mm is not known of septum: left out" in words for words in of["of-d_mm"].warnings)
    assert any("is circular" in words for words in of["of-d_mm"].warnings)
    assert len(of["of-d_mm"].tables[0].rows) == 6 and len(of["of-alpha"].tables[0].rows) == 10, "pairs of 4 and of 5 regions"


def test_what_was_no_target_is_of_the_tracked_motion_and_is_not_circular(tmp_path: Path) -> None:
    notes = study(tmp_path / "s", ["esv_ml"], motions=True)
    assert not any("d_mm" in note for note in notes)
    table = pd.read_csv(tmp_path / "s" / REGIONS)
    mine = table[table["participant_id"] == "sub-1"]
    assert mine["d_mm"].tolist() == pytest.approx([5.0] * 5, rel=1e-6) and mine["d_mm_sd"].tolist() == pytest.approx([0.3] * 5)
    page = study_page(tmp_path / "s", tmp_path)
    assert not any("circular" in words for section in page.sections for words in section.warnings)
    assert at_end_systole(tmp_path) == {}


def test_draws_of_a_region_that_is_left_out_are_left_out_too(tmp_path: Path) -> None:
    study(tmp_path / "s", [f"d_{region}_mm" for region in OTHERS], motions=False)
    file = tmp_path / "s" / REGIONS
    found = read_observations(file, ["d_mm", "alpha"], draws=tmp_path / "s" / DRAWS)
    assert found.regions == tuple(OTHERS) and found.draws["alpha"].shape[1:] == (4, 4)
    assert found.errors["alpha"].shape == (4, 4, 4)
    assert statistics(found, "d_mm", ["alpha"]).warnings[0] == f"d_mm is not known of {SEPTUM}: left out."
    # what one patient alone lacks is an error, in the table's own row
    table = pd.read_csv(file)
    table.loc[len(table) - 1, "d_mm"] = np.nan
    table.to_csv(file, index=False)
    with pytest.raises(TableError, match=f"d_mm, row {len(table)} is empty"):
        read_observations(file, ["d_mm", "alpha"])
