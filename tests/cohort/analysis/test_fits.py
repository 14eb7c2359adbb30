"""What the calibrations of a cohort say together: features, waves, models; and the gallery of its atria."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

import lacli
from lacli.cohort.analysis.fits import over_contrasts, over_features, over_waves, read_anatomy
from lacli.cohort.gallery import atria, with_fibrillation
from lacli.report.cohort_figures import gallery_figure


def test_features_over_patients() -> None:
    fits = {
        "a": {"fit": [{"feature": "d_roof_mm", "target": 5.0, "sd": 0.5, "emulated": 9.0, "simulated": 6.0}]},
        "b": {"fit": [{"feature": "d_roof_mm", "target": 5.0, "sd": 0.5, "emulated": 2.0, "simulated": None},
                      {"feature": "esv_ml", "target": 5.0, "sd": 0.5, "emulated": None}]},
    }  # fmt: skip
    (row,) = over_features(fits)
    # +1 and -3: sqrt((1 + 9) / 2); sd of 1 and 3 is sqrt 2; half-millimetre errors
    assert row == {
        "feature": "d_roof_mm", "patients": 2, "rmse": pytest.approx(5.0**0.5), "sd": pytest.approx(2.0**0.5),
        "rmse_in_sd": pytest.approx(20.0**0.5),
    }  # fmt: skip
    assert over_features({"a": fits["a"]})[0]["sd"] is None


def test_the_worst_emulator_of_a_wave_is_named() -> None:
    wave = {"wave": 1, "runs": 40, "failed": 2, "share": 0.2, "r2": {"d_roof_mm": 0.9, "esv_ml": 0.99, "d_global_mm": None}}
    (row,) = over_waves({"a": {"waves": [wave]}, "b": {"method": "sequential"}})
    assert (row["participant_id"], row["least_r2"], row["of"], row["nroy_share"]) == ("a", 0.9, "d_roof_mm", 0.2)


def test_evidence_adds_over_patients() -> None:
    def one(difference: float, verdict: str) -> list[dict[str, object]]:
        return [{"model": "regional", "against": "global", "difference": difference, "se": 0.5, "verdict": verdict}]

    found = over_contrasts({"a": one(-2.0, "no contrast can be claimed"), "b": one(-5.0, "global is strongly preferred")})
    assert found[0]["log_evidence"] == -7.0 and found[0]["se"] == pytest.approx(0.5**0.5)
    assert (found[0]["prefer_model"], found[0]["prefer_against"]) == (0, 1)
    assert found[0]["verdict"] == "global is strongly preferred"
    # 3 + 2 * .5 is not reached
    assert over_contrasts({"a": one(3.9, "x")})[0]["verdict"] == "no contrast can be claimed"


def test_the_gallery_shows_who_is_there(tmp_path: Path) -> None:
    lacli.synthesize(tmp_path / "a", cell_size_mm=12.0, order=1)
    anatomy = read_anatomy(tmp_path / "a", "a")
    assert anatomy is not None and anatomy.cavity_ml == pytest.approx(99.8, abs=1.0)
    assert read_anatomy(tmp_path / "none", "b") is None
    # a wall of 2 mm, whichever way it is measured
    assert anatomy.laplace_mm["roof"] == pytest.approx(2.0, abs=0.15) and anatomy.median_difference_mm < 0.15
    table = pd.DataFrame({"participant_id": ["a", "b"], "bundle": ["a", "gone"]})
    shown, lacking = atria(table, tmp_path)
    assert [one.name for one in shown] == ["a"] and lacking[0].startswith("b is not shown")
    assert len(shown[0].colours) == len(shown[0].corners)
    gallery_figure(shown, ["a"], [tmp_path / "g.png", tmp_path / "g.svg"])
    assert (tmp_path / "g.png").stat().st_size > 5000
    assert with_fibrillation({"af": "1.0"}), "a column of 0 and 1 with gaps"
    assert with_fibrillation({"af": "Yes"}) and not with_fibrillation({"af": "no"}) and not with_fibrillation({})
