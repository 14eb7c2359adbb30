"""Figures over patients, and what a methods paragraph cites."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from lacli.contracts.labels import BODY_REGIONS, REGION_COLOURS
from lacli.contracts.scene import build_scene
from lacli.report.cohort_figures import Atrium, gallery_figure, regions_figure, scatter_figure
from lacli.report.page import methods
from lacli.report.page.references import SHORT, bibtex

VALUES = np.arange(15.0).reshape(3, 5) + 1.0


def test_a_marker_a_patient_in_its_region_s_colour(tmp_path: Path, drawn: list[Figure]) -> None:
    files = [tmp_path / f"r.{suffix}" for suffix in ("png", "pdf", "svg")]
    regions_figure(VALUES, BODY_REGIONS, "stiffness alpha", files)
    assert [f.read_bytes()[:4] for f in files][:2] == [b"\x89PNG", b"%PDF"]
    axis = drawn[0].axes[0]
    assert axis.get_ylabel() == "stiffness alpha"
    assert [t.get_text() for t in axis.get_xticklabels()] == list(BODY_REGIONS)
    marked = [line for line in axis.lines if line.get_marker() == "o"]
    for j, (line, region) in enumerate(zip(marked, BODY_REGIONS, strict=True)):
        assert to_hex(line.get_color()).upper() == REGION_COLOURS[region].upper()
        assert np.asarray(line.get_ydata()).tolist() == VALUES[:, j].tolist()


def test_pairs_that_differ_are_marked_above_all(tmp_path: Path, drawn: list[Figure]) -> None:
    stars = {
        (BODY_REGIONS[0], BODY_REGIONS[4]): "**",
        (BODY_REGIONS[1], BODY_REGIONS[2]): "*",
        (BODY_REGIONS[0], BODY_REGIONS[1]): "",
    }
    regions_figure(VALUES, BODY_REGIONS, "d (mm)", [tmp_path / "r.png"], stars)
    axis = drawn[0].axes[0]
    assert [(text.get_text(), text.get_position()[0]) for text in axis.texts] == [("*", 1.5), ("**", 2.0)]
    assert min(text.get_position()[1] for text in axis.texts) > VALUES.max()


def test_the_gallery_has_one_view_one_scale_and_stars(tmp_path: Path, drawn: list[Figure]) -> None:
    corners = np.random.default_rng(0).normal(size=(20, 3, 3)) * 20
    large = Atrium("a", corners, ["#ff0000"] * 20, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    gallery_figure([large, dataclasses.replace(large, name="b", corners=corners / 2)], ["a"], [tmp_path / "g.png"])
    first, second = drawn[0].axes[:2]
    assert [axis.get_title() for axis in (first, second)] == ["a *", "b"]
    assert np.ptp(first.get_xlim()) == pytest.approx(np.ptp(second.get_xlim())), "one scale, though b is half as large"
    assert np.ptp(np.asarray(first.lines[0].get_xdata())) == pytest.approx(20.0)
    spans = [np.ptp(np.concatenate([p.vertices for p in a.collections[0].get_paths()]), axis=0) for a in (first, second)]
    assert spans[0] == pytest.approx(2 * spans[1])


def test_a_scatter_has_the_posterior_s_sd_as_bars(tmp_path: Path, drawn: list[Figure]) -> None:
    sd = np.full_like(VALUES, 0.25)
    scatter_figure(VALUES, VALUES + 1.0, BODY_REGIONS, ("thickness (mm)", "alpha"), sd, [tmp_path / "s.png"])
    axis = drawn[0].axes[0]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("thickness (mm)", "alpha")
    first = axis.containers[0]
    (bars,) = first.lines[2]
    segment = bars.get_segments()[0]
    assert segment[1][0] - segment[0][0] == pytest.approx(0.5)  # 2 x .25
    assert [t.get_text() for t in axis.get_legend().get_texts()] == list(BODY_REGIONS)


def test_the_methods_say_what_was_modelled_and_cite_it(tmp_path: Path) -> None:
    def of(*settings: str) -> tuple[str, list[str]]:
        scene = build_scene({"anatomy": {"bundle": "la"}}, list(settings), folder=tmp_path, where="test")
        return methods.of_run(scene, {"lacli": "1.2.3", "freefem": "4.9"})

    text, keys = of("loads.edp_mmhg=8", "loads.esp_mmhg=18", "numerics.order=2")
    assert "lacli 1.2.3 and FreeFEM 4.9" in text and "tetrahedra of order 2" in text
    assert "from 8 mmHg at end-diastole to 18 mmHg at end-systole" in text and "prestrain" in text
    assert keys == ["Hecht2012", "Roney2019", "Guccione1991"]
    other, keys = of("materials.law=neo_hookean", "numerics.unloading=backward", "loads.edp_mmhg=8")
    assert "law neo_hookean" in other and "backward displacement (Bols et al. 2013)" in other
    assert keys == ["Hecht2012", "Roney2019", "Bols2013"]
    result = {"waves": [{"runs": 200}, {"runs": 300}], "posterior": [{"input": "alpha_roof"}], "fit": [1, 2], "samples": 5000}
    text, keys = methods.of_calibration(result)
    assert "2 features" in text and "2 waves" in text and "300 runs" in text and "5000 samples" in text
    assert keys == ["Vernon2010", "ForemanMackey2013"]


def test_a_study_cites_what_was_done() -> None:
    text, keys = methods.of_study("1.2.3", [])
    assert keys == ["Holm1979", "Lindstrom1988", "Firth1993"] and "lacli 1.2.3" in text and "evidence" not in text
    text, keys = methods.of_study("1.2.3", ["regional", "global", "pooled"])
    assert keys[3:] == ["DelMoral2006", "Vehtari2017", "Gelman2006"]
    assert "(regional, global, pooled)" in text and all(SHORT[key] in text for key in keys)


def test_every_key_that_can_be_cited_has_an_entry() -> None:
    keys = [key for key in SHORT if key != "lacli"]
    text = bibtex(keys, "1.2.3")
    for key in keys:
        assert f"@article{{{key},\n" in text
    assert text.count("@") == len(keys) + 1 and "version = {1.2.3}" in text
    assert text.count("{") == text.count("}")
    # Holm's journal gave none in 1979
    assert text.count("doi = {10.") == len(keys) - 1 and "doi = {}" not in text
