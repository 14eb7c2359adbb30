"""What is told of states that are no stable equilibria."""

from __future__ import annotations

import math

import pytest

from lacli.mechanics.numerics import stability


@pytest.mark.parametrize("features", [{}, {"ed_unstable_modes": 0, "es_unstable_modes": 0}, {"ed_unstable_modes": math.nan}])
def test_stable_or_unknown_states_are_not_spoken_of(features: dict[str, float]) -> None:
    assert stability.said_of(features) == ""


def test_each_unstable_state_is_told_with_its_ways_out() -> None:
    said = stability.said_of({"ed_unstable_modes": 22, "es_unstable_modes": 1, "unstable_frames": {"0.2": 3}})
    assert "22 ways out" in said and "may be twice those stated" in said and "pericardium.dents" in said
    assert "End-systole is no stable equilibrium: 1 ways" in said and "3 at 0.2 RR" in said
    assert "End-systole" not in stability.said_of({"ed_unstable_modes": 2, "es_unstable_modes": 0})
