"""What is circular: a stiffness against what it was calibrated to, whatever the columns and targets are named."""

from __future__ import annotations

import pytest

from lacli.cohort.analysis.statistics import circularity

EARLY = ["d_roof_mm@0.4", "n_roof_mm@0.4"]


@pytest.mark.parametrize(
    ("response", "predictor", "targets", "told"),
    [
        ("d_mm", "alpha", None, "circular"),
        ("displacement_mm", "alpha", None, "circular"),
        ("d_es_mm", "alpha", None, "circular"),
        ("alpha", "d_mm", None, "circular"),
        ("d_mm", "stiffness_kpa", None, "circular"),
        ("d_mm", "log_alpha", None, "circular"),
        ("d_mm", "c1_kpa", None, "circular"),
        ("d_mm", "log_c", None, "circular"),
        ("d_mm", "mean_stiffness", None, "circular"),
        ("d_mm", "alpha", ["d_global_mm"], "circular"),
        ("d_mm", "alpha", ["n_roof_mm"], "circular"),
        ("n_mm", "alpha", None, "circular"),
        ("n_mm", "alpha", ["n_septum_mm", "n_roof_mm"], "circular"),
        ("n_mm@0.25", "alpha", ["n_septum_mm@0.25"], "circular"),
        ("d_mm@0.4", "alpha", EARLY, "circular"),
        ("d_mm", "alpha", EARLY, "nearly circular"),
        ("d_mm@0.25", "alpha", None, "nearly circular"),
        ("volume_ml@0.25", "alpha", ["esv_ml"], "nearly circular"),
        ("esv_ml", "alpha", ["esv_ml"], "circular"),
        ("d_mm", "alpha", ["esv_ml"], ""),
        ("d_mm", "thickness_mm", None, ""),
        ("alpha", "thickness_mm", None, ""),
        ("d_mm", "core_temp_c", None, ""),
        ("area_strain", "alpha", ["area_strain_roof"], "circular"),
    ],
)
def test_what_is_circular(response: str, predictor: str, targets: list[str] | None, told: str) -> None:
    found = circularity(response, [predictor], targets)
    assert [words.partition(": ")[0] for words in found] == ([f"{response} against {predictor} is {told}"] if told else [])
