"""What targets can teach, by hand: one input, one feature, and groups."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from membranes import INPUTS, OUTPUTS, Membranes, box, respond

from lacli.calibration.sequential.draw.information import by_group, forecast, group_of
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.targets import Targets
from lacli.inference.runs import RunLog, runs_identity


@pytest.mark.parametrize(
    ("name", "group"),
    [
        ("esv_ml", "volumes"),
        ("volume_ml@0.2", "volumes in frames"),
        ("d_roof_mm", "magnitudes"),
        ("n_roof_mm@0.1", "normal components in frames"),
        ("b_septum_mm", "tangential components"),
        ("area_strain_roof", "strains"),
        ("fibre_strain_roof@0.3", "strains in frames"),
        ("f3", "others"),
    ],
)
def test_groups_of_targets(name: str, group: str) -> None:
    assert group_of(name) == group


def test_a_forecast_is_that_of_the_linear_model(tmp_path: Path) -> None:
    simulator, x = Membranes(), np.array([[1.0, 2.0, 6.0]])
    log = RunLog(tmp_path / "runs.csv", INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS))
    log.run(simulator, x)
    targets = Targets(("f2",), np.array([3.0]), np.array([0.1]))
    found = forecast(log, x, targets, Scale.of(box()))
    slope = respond(x[0])[1][2]
    prior = (box().upper - box().lower) / np.sqrt(12.0)
    # one measurement: Sherman and Morrison's formula for the variances
    pull = prior**2 * slope
    expected = np.sqrt(prior**2 - pull**2 / (0.1**2 + slope @ pull))
    assert found.prior_sd == pytest.approx(prior)
    assert found.expected_sd == pytest.approx(expected, rel=1e-9)
    (row,) = by_group(targets, respond(x[0])[1][2:3], box())
    # one measurement: 1/2 log(1 + its variance before over its error's)
    assert row["alone_nats"] == pytest.approx(0.5 * np.log(1.0 + slope @ pull / 0.1**2), rel=1e-9)
    assert row["lost_without_nats"] == row["alone_nats"]
