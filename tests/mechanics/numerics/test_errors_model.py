"""Discretisation errors where none were measured: the model's form, what it scales with, and where each error comes from."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from shapes import hollow_cube

from lacli.contracts.bundle import save
from lacli.contracts.features import FEATURES, family
from lacli.contracts.scene import build_scene
from lacli.contracts.targets import Targets
from lacli.mechanics.numerics import accuracy, error_model
from lacli.mechanics.numerics.error_model import Resolution, model_errors, moved_mm, resolution, scale
from lacli.mechanics.numerics.stated import MEASURED, MODEL, said_of, stated_errors, with_discretisation

WHERE = Resolution(1, 4.0, 100.0, 2.0, 0.3)


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model with round coefficients: typical errors are 8 h / L of the scale for d_roof, 16 h / L for volumes."""
    features = {"d_roof_mm": math.log(8.0), "volume_ml": math.log(16.0), "area_strain_roof": 0.0}
    order = {"size": 1.0, "t": 1.0, "features": features, "factor": 3.0, "early": 0.5}
    monkeypatch.setattr(error_model, "_model", lambda: {"1": order, "2": {**order, "size": 3.0}})


@pytest.mark.usefixtures("plain")
def test_errors_scale_with_the_motion_the_cells_and_the_wall() -> None:
    # moved 5 mm, h / L = .04, t / h = .5: 5 x 8 x .04 x .5 x 3 = 2.4 mm; 5 x 100^2 / 1000 x 16 x .04 x .5 x 3 = 48 mL
    features = {"d_global_mm": 5.0, "d_roof_mm": 7.0, "esv_ml": 90.0, "area_strain_roof": 0.2, "cpu_s": 3.0}
    found = model_errors(features, WHERE)
    assert found == pytest.approx({"d_roof_mm": 2.4, "esv_ml": 48.0, "area_strain_roof": 5.0 / 100.0 * 0.04 * 0.5 * 3.0})
    finer = model_errors(features, Resolution(1, 2.0, 100.0, 1.0, 0.3))
    assert finer["d_roof_mm"] == pytest.approx(1.2)
    assert model_errors(features, Resolution(2, 2.0, 100.0, 1.0, 0.1))["d_roof_mm"] == pytest.approx(
        5.0 * 8.0 * 0.1**3 * 0.5 * 3.0
    )


@pytest.mark.usefixtures("plain")
def test_errors_at_a_time_scale_with_the_motion_at_that_time() -> None:
    features = {"d_roof_mm@0.1": 1.0, "d_septum_mm@0.1": 3.0, "d_roof_mm@0.2": 0.0}
    found = model_errors(features, WHERE)
    # no motion of the whole at 0.1: the mean of the regions', 2 mm
    assert found["d_roof_mm@0.1"] == pytest.approx(2.0 * 8.0 * 0.04 * 0.5 * 3.0)
    assert found["d_roof_mm@0.2"] == 0.0
    assert "d_roof_mm@0.3" not in found


def test_the_motion_is_told_by_d_of_the_whole_the_regions_or_the_components() -> None:
    assert moved_mm({"d_global_mm": 4.0, "d_roof_mm": 9.0}) == {"": 4.0}
    assert moved_mm({"d_roof_mm@0.2": 9.0, "d_septum_mm@0.2": 5.0}) == {"0.2": 7.0}
    assert moved_mm({"n_roof_mm": 2.0, "a_roof_mm": -3.0, "b_roof_mm": 6.0, "n_septum_mm": 1.0}) == {"": 7.0}  # sqrt(4 + 9 + 36)
    assert moved_mm({"esv_ml": 80.0, "d_roof_mm": math.nan}) == {}


def test_scales_are_in_the_features_units() -> None:
    assert scale("d_roof_mm@0.3", 5.0, WHERE) == 5.0
    assert scale("esv_ml", 5.0, WHERE) == 50.0  # 5 mm x 10,000 mm2, in mL
    assert scale("fibre_strain_roof", 5.0, WHERE) == 0.05


def test_a_cube_s_resolution() -> None:
    # outer side 3 x 10 mm cells of a hollow cube: its cavity and wall are known in closed form
    bundle = hollow_cube()
    cavity = bundle.triangles[bundle.tags == 1][:, :3]
    found = resolution(bundle, 2)
    sides = np.linalg.norm(bundle.points[cavity] - np.roll(bundle.points[cavity], 1, axis=1), axis=2)
    # right triangles on square faces: two sides a, one a sqrt 2
    a = sides.min()
    assert found.h_mm == pytest.approx(a * (2 + math.sqrt(2)) / 3)
    assert found.l_mm**2 == pytest.approx(len(cavity) * a**2 / 2)
    assert found.order == 2 and found.t_mm > 0
    # of the pairs of triangles at an edge those at the cavity's twelve edges turn by a right angle, the others not at all
    pairs = 1.5 * len(cavity)
    at_edges = 12 * np.ptp(bundle.points[cavity].reshape(-1, 3), axis=0)[0] / a
    assert found.turn == pytest.approx(math.pi / 2 * math.sqrt(at_edges / pairs))


def test_quadratic_cells_err_by_how_the_wall_turns_and_finer_cells_turn_less() -> None:
    smooth = Resolution(2, 4.0, 100.0, 2.0, 0.2)
    rough = dataclasses.replace(smooth, turn=0.3)
    features = {"d_global_mm": 6.0, "d_roof_mm": 5.0, "edv_ml": 90.0}
    more = {
        name: rough_error / model_errors(features, smooth)[name] for name, rough_error in model_errors(features, rough).items()
    }
    assert set(more) == set(features)
    power = error_model._model()["2"]["size"]
    assert list(more.values()) == pytest.approx([1.5**power] * 3) and power > 1.0
    assert smooth.finer(0.5).h_mm == 2.0 and 0.1 <= smooth.finer(0.5).turn < 0.2
    still = {"d_global_mm": 0.1, "edv_ml": 90.0}
    assert model_errors(still, smooth)["edv_ml"] == model_errors(features, smooth)["edv_ml"], "the image's volume moves nowhere"


def test_the_built_in_model_knows_every_feature_and_falls_with_finer_cells() -> None:
    for order in (1, 2):
        known = error_model._model()[str(order)]
        assert {family(f.key) for f in FEATURES} <= set(known["features"]), "a feature without an error"
        assert known["size"] > 0, "errors that grow under refinement"
        assert known["coverage"] >= 0.85 and known["anatomies"] >= 8
    features = {"d_global_mm": 6.0, **{f.key: 1.0 for f in FEATURES}}
    linear, quadratic = (model_errors(features, Resolution(order, 4.0, 100.0, 2.0, 0.19)) for order in (1, 2))
    assert set(linear) == {f.key for f in FEATURES}
    assert all(0 < quadratic[name] < linear[name] for name in ("d_global_mm", "esv_ml", "d_roof_mm"))


@pytest.mark.usefixtures("plain")
def test_what_was_measured_comes_first_and_the_source_is_told(tmp_path: Path) -> None:
    bundle = hollow_cube()
    save(bundle, tmp_path / "b")
    scene = build_scene({"anatomy": {"bundle": "b"}}, ["numerics.order=1"], folder=tmp_path, where="test")
    features = {"d_global_mm": 5.0, "d_roof_mm": 7.0, "esv_ml": 90.0}
    assert set(stated_errors(scene, bundle, features).source.values()) == {MODEL}
    accuracy.record(scene, {"d_roof_mm": 0.25}, scene)
    stated = stated_errors(scene, bundle, features)
    assert stated.source == {"d_roof_mm": MEASURED, "esv_ml": MODEL}
    assert stated.errors["d_roof_mm"] == 0.25

    targets = Targets(("esv_ml", "d_roof_mm", "n_roof_mm"), np.array([90.0, 7.0, 3.0]), np.array([4.0, 0.2, 0.2]))
    wide, told = with_discretisation(targets, scene)
    assert wide.sd[1] == pytest.approx(math.hypot(0.2, 0.25))
    assert wide.sd[2] == 0.2 and "n_roof_mm" not in told.errors
    rest, _ = with_discretisation(targets, scene, but=MEASURED)
    assert rest.sd[1] == 0.2 and rest.sd[0] == wide.sd[0] > 4.0
    said = said_of(targets.names, told)
    assert "1 of 3 targets (esv_ml) is a model's estimate" in said[0]
    assert "1 of 3 targets (n_roof_mm) is not known" in said[1]
    assert said_of(("d_roof_mm",), told) == []


def test_errors_fall_slower_than_the_motion() -> None:
    where, early = error_model.Resolution(1, 4.0, 120.0, 2.0, 0.2), error_model._model()["1"]["early"]
    assert 0.0 < early < 1.2, "errors that grow towards end-diastole, or faster than the motion falls"
    features = {"d_global_mm": 8.0, "d_roof_mm": 7.0, "d_global_mm@0.1": 2.0, "d_roof_mm@0.1": 1.0}
    found = error_model.model_errors(features, where)
    # a quarter of the motion: 2 / 8 x 4^e of the error
    assert found["d_roof_mm@0.1"] == pytest.approx(0.25 * 4.0**early * found["d_roof_mm"])
    alone = error_model.model_errors({k: v for k, v in features.items() if "@" in k}, where)
    assert alone["d_roof_mm@0.1"] == pytest.approx(0.25 * found["d_roof_mm"]), "nothing is known of end-systole"


def test_the_model_s_file_is_what_the_benchmark_writes() -> None:
    document = json.loads(error_model.FILE.read_text())
    assert set(document) == {"held", "finest_mm", "orders"} and set(document["orders"]) == {"1", "2"}
