"""What calibration and comparison of a patient warned of reaches the study: notes, sums that hold what is not to be trusted."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest
from chains import chain_of

from lacli.base.errors import TableError
from lacli.cohort.analysis.fits import Doubts, doubts, over_contrasts, over_models
from lacli.cohort.analysis.summary import write_summary
from lacli.cohort.comparison import EXTRAPOLATED
from lacli.cohort.files import CONTRASTS, PATIENTS, STATE
from lacli.cohort.page import study_page
from lacli.cohort.participants import read_participants
from lacli.cohort.study import Outcome
from lacli.contracts.labels import BODY_REGIONS
from lacli.inference.sampling.posterior import save_chain

FAR = f"global: {EXTRAPOLATED}: 98.0% of its posterior is where no run has been."
PREFERRED = "regional is strongly preferred"


def comparison(k: float = 0.3, warnings: tuple[str, ...] = ()) -> dict[str, object]:
    """Regional 8 nats above global, and the latter's Pareto k."""
    same = {"rmse_mm": 0.5, "log_evidence": -3.0, "log_evidence_se": 0.1, "elpd": -4.0, "elpd_se": 1.0, "p_loo": 2.0}
    fits = [{"name": n, "worst_k": worst, **same} for n, worst in (("regional", 0.2), ("global", k))]
    contrast = {"model": "regional", "against": "global", "difference": 8.0, "se": 0.3, "verdict": PREFERRED}
    return {"fits": fits, "contrasts": [contrast], "warnings": list(warnings)}


def test_doubts_are_of_the_models_that_they_are_about() -> None:
    good = {"converged": True, "verdict": {"plausible": True, "warnings": ["alpha_roof is at its end."]}}
    bad = {"converged": False, "verdict": {"plausible": False, "warnings": []}, "notes": ["few runs."]}
    assert doubts({"": good}, comparison()) == Doubts(("alpha_roof is at its end.",))
    told = doubts({"": good}, comparison(0.9, (FAR, "global: PSIS-LOO is not to be trusted")))
    assert (told.evidence, told.elpd) == ({"global"}, {"global"}) and FAR in told.words
    assert doubts({"": good}, comparison(0.9)).evidence == set(), "a target that alone decides says nothing of the evidence"
    assert doubts({"": bad}, comparison()) == Doubts(
        ("The sampler did not converge.", "few runs."), frozenset({"regional", "global"}), frozenset({"regional", "global"})
    )
    other = comparison()
    other["fits"] = [*other["fits"], {"name": "uniform"}]  # type: ignore[misc]
    of_uniform = doubts({"": good, "uniform": bad}, other)
    assert of_uniform.evidence == {"uniform"} and "uniform: The sampler did not converge." in of_uniform.words


def test_who_is_not_to_be_trusted_is_left_out_of_the_sum_and_named() -> None:
    contrasts = {name: comparison()["contrasts"] for name in ("a", "b")}
    (row,) = over_contrasts(contrasts, {"b": Doubts((), frozenset({"global"}))})  # type: ignore[arg-type]
    assert (row["patients"], row["log_evidence"], row["not_trusted"], row["prefer_model"]) == (1, 8.0, "b", 1)
    assert row["verdict"] == f"{PREFERRED} (without b, whose evidence is not to be relied on)"
    # with nobody left, or where those who are left do not tell, nothing is claimed
    (row,) = over_contrasts(contrasts, {p: Doubts((), frozenset({"global"})) for p in "ab"})  # type: ignore[arg-type]
    assert (row["patients"], row["log_evidence"]) == (0, 0.0)
    assert row["verdict"] == "no contrast can be claimed (without a, b, whose evidence is not to be relied on)"
    vague = {"a": [{**contrasts["a"][0], "difference": 2.0}], "b": [{**contrasts["b"][0], "difference": 90.0, "se": 6.1}]}  # type: ignore[index]
    (row,) = over_contrasts(vague)
    assert (row["log_evidence"], row["not_trusted"]) == (2.0, "b") and row["verdict"].startswith("no contrast can be claimed (")
    (row,) = over_contrasts({**vague, "b": [{**vague["b"][0], "se": float("nan")}]})
    assert row["not_trusted"] == "b"
    (row,) = over_contrasts(contrasts, {"b": Doubts((), frozenset({"pooled"}))})  # type: ignore[arg-type]
    assert (row["not_trusted"], row["verdict"]) == ("", PREFERRED)


def test_elpd_is_summed_over_those_who_have_all_models() -> None:
    def fit(patient: str, name: str, k: float, elpd: float) -> dict[str, object]:
        return {"participant_id": patient, "name": name, "rmse_mm": 0.5, "p_loo": 2.0, "elpd": elpd, "elpd_se": 3.0, "worst_k": k}

    rows = [fit("a", "regional", 0.1, -4.0), fit("a", "uniform", 0.8, -5.0), fit("b", "regional", 0.9, -400.0)]
    regional, uniform = over_models(rows, {"a": Doubts((), elpd=frozenset({"uniform"}))})
    # b has no uniform wall: its -400 would make the regional model the worse one
    assert (regional["elpd"], regional["elpd_se"], regional["elpd_patients"], regional["worst_k"]) == (-4.0, 3.0, 1, 0.1)
    assert (uniform["elpd"], uniform["worst_k"], uniform["elpd_not_trusted"]) == (-5.0, 0.8, "a")
    assert (regional["patients"], regional["elpd_not_trusted"]) == (2, "")


def patient_folder(folder: Path, result: dict[str, object], compared: dict[str, object]) -> None:
    (folder / "calibration").mkdir(parents=True)
    posterior = [{"input": f"alpha_{r}", "map": 1.0, "mean": 0.0, "sd": 1.0} for r in BODY_REGIONS]
    fit = [{"feature": f"d_{r}_mm", "target": 5.0, "sd": 0.2, "emulated": 5.0} for r in BODY_REGIONS]
    (folder / "calibration" / "result.json").write_text(json.dumps({"posterior": posterior, "fit": fit, **result}))
    save_chain(folder / "calibration" / "chain.npz", chain_of([f"alpha_{r}" for r in BODY_REGIONS]))
    (folder / "comparison.json").write_text(json.dumps(compared))


def test_the_study_and_its_page_tell_what_a_patient_s_calibration_warned_of(tmp_path: Path) -> None:
    (tmp_path / "t.toml").write_text("x")
    lines = "".join(f"sub-{i},t.toml,t.toml\n" for i in range(4))
    (tmp_path / "p.csv").write_text(f"participant_id,targets,table\n{lines}")
    home = tmp_path / "study"
    patient_folder(home / "sub-0", {"converged": True}, comparison())
    patient_folder(home / "sub-1", {"converged": False}, comparison(0.9, (FAR,)))
    done = [Outcome(f"sub-{i}", "done", "", "", {}) for i in range(2)]
    _, summary = write_summary(home, read_participants(tmp_path / "p.csv"), done)
    assert summary["patients"] == 4, "those of the table, whoever was asked for"
    assert f"sub-1: The sampler did not converge. {FAR}" in summary["notes"]
    assert not any(note.startswith("sub-0") for note in summary["notes"])
    people = pd.read_csv(home / PATIENTS).set_index("participant_id")["warnings"]
    assert people.isna().tolist() == [True, False] and FAR in people["sub-1"]
    assert pd.read_csv(home / CONTRASTS)["not_trusted"].tolist() == ["sub-1"]
    page = study_page(home, tmp_path)
    assert page.lead == "2 of 4 participants done."
    (told,) = (section for section in page.sections if section.anchor == "warnings")
    assert any(FAR in words for words in told.text) and all(words.startswith("sub-") for words in told.text)
    assert any(told.title in words for words in page.sections[0].warnings)
    assert "warnings" not in page.sections[0].tables[-1].columns
    models = next(section for section in page.sections if section.anchor == "models")
    row = next(row for row in models.tables[0].rows if row[0] == "global")
    assert row[-3:] == ("2", "0.9", "sub-1")
    assert "worst_k" in models.tables[-1].columns and "without sub-1, whose" in str(models.tables[1].rows)


@pytest.mark.parametrize("name", STATE)
def test_no_column_of_a_participant_s_own_takes_the_study_s_place(tmp_path: Path, name: str) -> None:
    (tmp_path / "t.toml").write_text("x")
    (tmp_path / "p.csv").write_text(f"participant_id,targets,table,{name}\nsub-1,t.toml,t.toml,5\n")
    with pytest.raises(TableError, match=f"the study writes {name} of each participant itself"):
        read_participants(tmp_path / "p.csv")
