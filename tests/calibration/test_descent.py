"""The search for the most probable point: starts share it, and it ends where runs do not get lower, whatever their slopes say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from lacli.calibration.sequential import descent
from lacli.calibration.sequential.descent import Incumbent
from lacli.calibration.sequential.evidence import Evidence

LOWEST = np.array([0.4, 0.6])
Run = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def evidence_of(run: Run, z: np.ndarray) -> Evidence:
    residual, jacobian = (np.array(part) for part in zip(*(run(point) for point in z), strict=True))
    return Evidence(z, z, residual, jacobian, np.zeros((0, 2)), residual.shape[1], np.zeros(residual.shape))


def descend(run: Run, z: np.ndarray, rounds: int = 40) -> tuple[Evidence, list[int]]:
    """All runs, and how many each round made; as the calibration goes."""
    evidence, made, components = evidence_of(run, z), [], None
    incumbents = [Incumbent(point) for point in z]
    for _ in range(rounds):
        components = descent.emulate(evidence, components)
        tried = descent.trials(evidence, incumbents, components)
        if not tried:
            return evidence, made
        known = len(evidence.z)
        evidence = evidence_of(run, np.unique(np.vstack([evidence.z, *(t.z[None] for t in tried)]), axis=0))
        made.append(len(evidence.z) - known)
        incumbents = descent.advance(evidence, descent.kept(evidence, incumbents), tried)
    raise AssertionError(f"not settled after {rounds} rounds and {len(evidence.z)} runs")


def bowl(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.append(10.0 * (z - LOWEST), 7.8), np.vstack([10.0 * np.eye(2), [[0.0, 0.0]]])


def deceived(slope: float) -> Run:
    """The same, of which derivatives promise a decrease of chi^2 that no run keeps: (7.8 slope)^2 / (100 + slope^2)."""
    return lambda z: (bowl(z)[0], np.vstack([10.0 * np.eye(2), [[slope, 0.0]]]))


STARTS = np.array([[0.5, 0.5], [0.1, 0.2], [0.9, 0.7], [0.3, 0.9]])


def test_a_bowl_is_settled_in_few_runs() -> None:
    evidence, made = descend(bowl, STARTS)
    assert np.abs(evidence.z[np.argmin(evidence.misfit)] - LOWEST).max() < 0.01
    assert sum(made) <= 4


# 0.60 is more than a settled point may expect, and 1.7 a little less than what two idle rounds make incredible
@pytest.mark.parametrize("slope", [1.0, 1.7])
def test_a_decrease_that_no_run_keeps_is_not_run_after(slope: float) -> None:
    evidence, made = descend(deceived(slope), STARTS)
    assert evidence.misfit.min() < 7.8**2 + 2.0  # what a point that two rounds did not lower may still expect
    assert sum(made) <= 12


def test_a_start_that_has_come_to_the_best_one_s_place_is_not_run_again() -> None:
    """Two starts beside the best, which still expects a lot, and one elsewhere: the second place goes to that one."""
    best, elsewhere = np.array([0.5, 0.5]), np.array([0.9, 0.1])
    z = np.vstack([best, best + 0.004, best - 0.006, elsewhere])
    evidence = evidence_of(bowl, z)
    tried = descent.trials(evidence, [Incumbent(point) for point in z], descent.emulate(evidence, None))
    order = np.argsort(evidence.misfit)
    assert [trial.start for trial in tried] == [int(order[0]), 3]


def test_large_promises_are_followed_however_often_they_failed() -> None:
    z = np.array([[0.5, 0.5]])
    evidence = evidence_of(deceived(3.0), z)  # promises 5.0 more than it keeps
    assert descent.trials(evidence, [Incumbent(z[0], idle=5)], None)
    components = descent.emulate(evidence_of(deceived(3.0), STARTS), None)
    assert descent.trials(evidence_of(deceived(3.0), STARTS), [Incumbent(STARTS[0], idle=5)], components)
