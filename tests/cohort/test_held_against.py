"""What a study reads back of a calibration's targets and their errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lacli.base.errors import InputError
from lacli.calibration.annulus import with_annulus, write_effects
from lacli.cohort.patient import held_against
from lacli.contracts.targets import Targets
from lacli.mechanics.numerics.error_correlation import correlation


def test_a_comparison_is_held_against_what_the_calibration_was(tmp_path: Path) -> None:
    """Discretisation errors, a discrepancy stated in the targets, and one factor on both."""
    names = ("n_roof_mm", "n_septum_mm")
    given = Targets(names, np.array([1.0, 2.0]), np.array([0.3, 0.4])).widened(dict.fromkeys(names, 0.2), np.full((2, 2), 1.0))
    errors = {"n_roof_mm": 0.1, "n_septum_mm": 0.5}
    held = given.widened(errors, correlation(names, given.mean, 1)).with_errors_times(2.0)
    fit = [
        {"feature": name, "target": m, "sd": s, "own_sd": o}
        for name, m, s, o in zip(names, given.mean.tolist(), held.sd.tolist(), held.own_sd.tolist(), strict=True)
    ]
    result = {"method": "sequential", "fit": fit, "error_factor": {"value": 2.0, "low": 1.5, "high": 3.0}}
    (tmp_path / "result.json").write_text(json.dumps(result))
    (tmp_path / "calibration.json").write_text(json.dumps({"content": {"runs.numerics.order": 1}}))
    found = held_against(tmp_path, given)
    # of the roof .09 + 4 (.04 + .01), by hand
    assert found.sd[0] == pytest.approx(np.sqrt(0.29))
    assert found.covariance == pytest.approx(held.covariance)


def test_the_error_of_a_tracked_annulus_is_part_of_it(tmp_path: Path) -> None:
    """It has one sign for each target, which discretisation errors have not."""
    names, effects = ("n_roof_mm", "b_septum_mm"), {"n_roof_mm": [0.3, 0.0], "b_septum_mm": [-0.6, 0.1]}
    given = Targets(names, np.array([1.0, 2.0]), np.array([0.3, 0.4]))
    held = with_annulus(given, effects).widened({"n_roof_mm": 0.1, "b_septum_mm": 0.2}, correlation(names, given.mean, 1))
    fit = [
        {"feature": name, "target": m, "sd": s, "own_sd": o}
        for name, m, s, o in zip(names, given.mean.tolist(), held.sd.tolist(), held.own_sd.tolist(), strict=True)
    ]
    (tmp_path / "result.json").write_text(json.dumps({"method": "sequential", "fit": fit}))
    (tmp_path / "calibration.json").write_text(json.dumps({"content": {"runs.numerics.order": 1}}))
    write_effects(tmp_path, effects)
    found = held_against(tmp_path, given)
    assert found.covariance == pytest.approx(held.covariance)
    together = correlation(names, given.mean, 1)[0, 1]
    assert found.covariance is not None and found.covariance[0, 1] == pytest.approx(-0.18 + 0.02 * together)
    write_effects(tmp_path, {})
    assert held_against(tmp_path, given).covariance != pytest.approx(held.covariance), "nothing of an earlier one stays"
    for damaged in (
        '{"n_roof_mm": "much"}',
        '{"n_roof_mm": 0.3}',
        '{"n_roof_mm": [0.1], "b_septum_mm": [0.1, 0.2]}',
        '{"n_roof_mm": []}',
        "[]",
    ):
        (tmp_path / "annulus.json").write_text(damaged)
        with pytest.raises(InputError, match="as many finite numbers for each target"):
            held_against(tmp_path, given)


def test_targets_that_were_left_out_have_no_part_in_it(tmp_path: Path) -> None:
    """Of one frame no run told the states: the discretisation error there is not known, and is not 0."""
    names = ("n_roof_mm", "n_roof_mm@0.2", "n_septum_mm")
    given = Targets(names, np.ones(3), np.full(3, 0.3), 0.05 + 0.04 * np.eye(3)).widened(dict.fromkeys(names, 0.2))
    fit = [{"feature": name, "target": 1.0, "sd": 0.5, "own_sd": 0.3} for name in (names[2], names[0])]
    result = {"method": "sequential", "fit": fit, "targets_left_out": [names[1]]}
    (tmp_path / "result.json").write_text(json.dumps(result))
    (tmp_path / "calibration.json").write_text(json.dumps({"content": {"runs.numerics.order": 1}}))
    found = held_against(tmp_path, given)
    assert found.names == ("n_roof_mm", "n_septum_mm")
    # .5^2 = .3^2 + .2^2 stated + .12 of discretisation, which go together as those of one kind do
    assert found.sd == pytest.approx([0.5, 0.5])
    together = correlation(found.names, found.mean, 1)[0, 1]
    assert found.covariance is not None and found.covariance[0, 1] == pytest.approx(0.05 + 0.12 * together)


def test_what_rounding_leaves_is_no_discretisation_error(tmp_path: Path) -> None:
    """Of runs done elsewhere neither errors nor cells are known: sd is the measurement's and the stated discrepancy's alone."""
    names = tuple(f"d_{region}_mm" for region in ("roof", "septum", "lateral"))
    own, stated = np.array([0.3, 0.7, 0.1]), {names[0]: 0.1, names[1]: 0.3, names[2]: 0.1}
    given = Targets(names, np.ones(3), own).widened(stated)
    left = given.sd**2 - own**2 - np.array(list(stated.values())) ** 2
    assert 0.0 < left.max() < 1e-15, "what is tried here"
    fit = [
        {"feature": n, "target": 1.0, "sd": s, "own_sd": o}
        for n, s, o in zip(names, given.sd.tolist(), own.tolist(), strict=True)
    ]
    (tmp_path / "result.json").write_text(json.dumps({"method": "sequential", "fit": fit}))
    (tmp_path / "calibration.json").write_text(json.dumps({"content": {}}))
    found = held_against(tmp_path, given)
    assert np.array_equal(found.sd, given.sd)
