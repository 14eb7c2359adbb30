"""How discretisation errors go together, and what that does to targets."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lacli.contracts.targets import Targets
from lacli.mechanics.numerics import error_correlation
from lacli.mechanics.numerics.error_correlation import correlation, measured

NAMES = ("d_roof_mm@0.1", "d_roof_mm@0.2", "d_septum_mm@0.1", "n_roof_mm@0.1", "esv_ml", "volume_ml@0.1", "other")
TABLE = {
    "d d, one region, two times": 0.8, "d d, two regions, one time": 0.3, "d n, one region, one time": 0.5,
    "volume volume, one region, two times": 0.6,
}  # fmt: skip


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(error_correlation, "_table", lambda: {"1": {"groups": TABLE}, "2": {"groups": {}}})


@pytest.mark.usefixtures("table")
def test_what_was_measured_of_two_kinds_stands_between_their_features() -> None:
    found = correlation(NAMES, np.array([1.0, 2.0, 1.0, -3.0, 90.0, 70.0, 1.0]), 1)
    assert (found[0, 1], found[0, 2], found[4, 5]) == pytest.approx((0.9 * 0.8, 0.9 * 0.3, 0.9 * 0.6)), (
        "a tenth goes with nothing"
    )
    assert found[0, 3] == pytest.approx(-0.45), "an error that makes |n| larger makes n, which is negative, smaller"
    assert (found[1, 2], found[0, 4]) == pytest.approx((0.0, 0.0)), "two regions at two times, two kinds: not measured"
    assert found[6] == pytest.approx([0, 0, 0, 0, 0, 0, 1]), "what is no feature goes with nothing"
    assert correlation(NAMES, np.ones(7), 2) == pytest.approx(np.eye(7))
    assert correlation((), np.zeros(0), 1).shape == (0, 0)


@pytest.mark.usefixtures("table")
def test_targets_are_widened_by_errors_that_go_together() -> None:
    targets = Targets(NAMES[:3], np.ones(3), np.full(3, 0.1))
    wide = targets.widened({"d_roof_mm@0.1": 0.2, "d_roof_mm@0.2": 0.4}, correlation(NAMES[:3], targets.mean, 1))
    assert wide.covariance is not None
    assert wide.covariance[0] == pytest.approx([0.05, 0.72 * 0.08, 0.0])  # .01 + .04, .72 x .2 x .4
    assert wide.own_sd == pytest.approx([0.1, 0.1, 0.1]) and wide.added == pytest.approx([0.2, 0.4, 0.0])
    assert wide.select(NAMES[1:2]).own_sd == pytest.approx([0.1])
    again = wide.widened({"d_roof_mm@0.1": 0.3})
    assert again.own_sd == pytest.approx([0.1, 0.1, 0.1]) and again.sd[0] == pytest.approx(np.sqrt(0.01 + 0.04 + 0.09))


def test_correlations_come_back_from_errors_that_have_them() -> None:
    # one bias of all displacements of an anatomy, and as much noise: correlation .5; n points inwards in one region
    rng = np.random.default_rng(0)
    names = [f"{kind}_{region}_mm@{time}" for kind in "dn" for region in ("roof", "septum") for time in (0.1, 0.2)]
    values = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    samples = [(names, values, np.sign(values) * (rng.normal() + rng.normal(size=8))) for _ in range(4000)]
    found = measured(samples)
    assert len(found) == 3 + 3 + 4
    assert np.array(list(found.values())) == pytest.approx(np.full(10, 0.5), abs=0.05)


@pytest.mark.parametrize("order", [1, 2])
def test_the_built_in_ones_make_a_covariance(order: int) -> None:
    document = json.loads(error_correlation.FILE.read_text(encoding="utf-8"))
    assert set(document) == {"1", "2"} and document[str(order)]["anatomies"] >= 8
    regions = ("anterior", "posterior", "septum", "lateral", "roof")
    keys = [f"{kind}_{region}_mm" for kind in "dnab" for region in regions] + [f"area_strain_{region}" for region in regions]
    names = tuple(f"{key}{mark}" for mark in ("", "@0.1", "@0.2", "@0.3") for key in (*keys, "volume_ml", "d_global_mm"))
    found = correlation(tuple(n for n in names if n != "volume_ml"), np.ones(len(names) - 1), order)
    assert np.linalg.eigvalsh(found).min() > 0 and np.diag(found) == pytest.approx(np.ones(len(found)))
    at = {name: i for i, name in enumerate(n for n in names if n != "volume_ml")}
    assert found[at["d_roof_mm"], at["d_roof_mm@0.3"]] > 0.5, "one feature's errors at two times are nearly one"
