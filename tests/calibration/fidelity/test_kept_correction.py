"""Cheap runs are never told without their correction: branches, budgets, runs of the reference that tell no derivatives."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fidelity.test_two_fidelities import QUICK, SD, TRUTH, Cheap, bent, log_of, run, targets
from membranes import OUTPUTS, Membranes, box, respond

from lacli.base.documents import read_json
from lacli.base.errors import LacliError, UsageError
from lacli.calibration.sequential import branches
from lacli.calibration.sequential.branches import Branches
from lacli.calibration.sequential.calibration import _descend, _looked_at, _start, forecast_sequentially
from lacli.calibration.sequential.evidence import Evidence
from lacli.calibration.sequential.fidelity.correction import corrected, fit_correction, pairs, sound
from lacli.calibration.sequential.search import Reference, Search, Settings
from lacli.contracts.targets import Targets
from lacli.inference.runs import Outcome, RunLog, runs_identity

EARLY = ("b_roof_mm@0.1", "a_roof_mm@0.1")


def searched(folder: Path, held: Targets | None = None) -> tuple[Search, Membranes]:
    cheap, dear = Cheap(bent), Membranes()
    reference = Reference(dear, log_of(dear, folder / "runs.csv"))
    return Search(cheap, box(), held or targets(), QUICK, log_of(cheap, folder / "cheap.csv"), lambda _: None, reference), dear


def test_a_forecast_is_of_the_calibration_that_follows(tmp_path: Path) -> None:
    cheap, dear = Cheap(bent), Membranes()
    reference = Reference(dear, log_of(dear, tmp_path / "runs.csv"))
    for _ in range(2):
        given = (cheap, box(), targets(), QUICK, tmp_path, log_of(cheap, tmp_path / "runs_cheap.csv"))
        found = forecast_sequentially(*given, reference=reference)
        assert (found.runs, dear.calls, cheap.calls) == (4, 0, 4)
    assert not run(cheap, dear, tmp_path).refused
    after = forecast_sequentially(*given, reference=reference)
    assert after.expected_sd == pytest.approx(found.expected_sd)
    assert not run(cheap, dear, tmp_path).refused  # nothing was made over


def test_a_cheap_run_on_another_branch_teaches_nothing_but_stays_where_the_reference_ran(tmp_path: Path) -> None:
    search, _ = searched(tmp_path)
    z = np.random.default_rng(0).random((6, 3))
    search.run(z, "cheap")
    search.refer(z[:4], "both")
    seen: list[Evidence] = []

    def look(evidence: Evidence, _: Targets, order: object = None) -> Branches:
        seen.append(evidence)
        return Branches((), np.zeros(len(evidence.z), bool), np.zeros(len(evidence.z), bool))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(branches, "look", look)
        search.evidence()
    cheap, dear = seen
    learnt, kept, of_reference = sound(cheap, dear, (np.array([True, *[False] * 4, True]), np.array([False] * 3 + [True])))
    assert len(learnt.z) == 4  # without the first and the last
    assert len(pairs(learnt, of_reference)) == 2
    assert len(kept.z) == 5  # the reference tells of the first
    correction = fit_correction(learnt, of_reference)
    assert correction is not None
    made = corrected(kept, of_reference, correction)
    assert made.own.tolist() == [True, True, True, False, False]
    assert made.residual[0] == pytest.approx(dear.residual[0])


def test_a_frame_in_which_the_reference_jumps_goes_rather_than_the_correction(tmp_path: Path) -> None:
    """Of three runs of the reference one jumps in each direction: nothing would be left to learn from."""
    names = (*OUTPUTS[:10], *EARLY)

    class Framed(Membranes):
        def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            for index, outcome in super().__call__(inputs):
                name = dict(zip(OUTPUTS, names, strict=True))
                slopes = {(name[o], i): value for (o, i), value in outcome.gradients.items()}
                yield index, Outcome({name[o]: y for o, y in outcome.outputs.items()}, gradients=slopes, cpu_s=1.0)

    logs = [RunLog(tmp_path / f"{k}.csv", box().names, names, runs_identity(Framed(), box().names, names)) for k in "ab"]
    held = Targets(names, respond(TRUTH)[0], np.full(12, SD))
    search = Search(Framed(), box(), held, QUICK, logs[0], lambda _: None, Reference(Framed(), logs[1]))
    z = np.random.default_rng(0).random((6, 3))
    search.run(z, "cheap")

    def look(evidence: Evidence, of: Targets, order: object = None) -> Branches:
        off = np.zeros(len(evidence.z), bool)
        if len(off) == 3 and set(EARLY) <= set(of.names):
            off[:2] = True
        return Branches((), off, np.zeros(len(off), bool), (0.1,) if off.any() else ())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(branches, "look", look)
        evidence = search.refer(z[:3], "both")
    assert search.targets.names == OUTPUTS[:10]
    assert evidence.correction is not None and int(evidence.own.sum()) == 3


def test_a_correction_that_is_lost_ends_the_calibration(tmp_path: Path) -> None:
    search, _ = searched(tmp_path)
    z = np.random.default_rng(0).random((6, 3))
    search.run(z, "cheap")
    assert search.refer(z[:2], "both").correction is not None

    def look(evidence: Evidence, _: Targets, order: object = None) -> Branches:
        off = np.zeros(len(evidence.z), bool)
        off[: len(off) - 1] = len(off) == 2
        return Branches((), off, off)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(branches, "look", look)
        with pytest.raises(LacliError, match=r"of 2 runs of the reference fewer than 2 are left.*--cheap none"):
            search.evidence()


def test_a_reference_that_tells_derivatives_here_and_there_gives_an_answer(tmp_path: Path) -> None:
    """The best of its runs tells none: they are as the correction has them."""

    class Partly(Membranes):
        def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            for index, outcome in super().__call__(inputs):
                yield index, outcome if self.calls <= 2 else Outcome(outcome.outputs, cpu_s=1.0)

    found = run(Cheap(bent), Partly(), tmp_path)
    assert not found.refused
    told = read_json(tmp_path / "result.json")
    assert all(np.isfinite(row["alone_nats"]) and row["alone_nats"] > 0 for row in told["information"])
    y, _ = respond(found.map_x)
    assert [row["simulated"] for row in found.fit] == pytest.approx(y.tolist())


@pytest.mark.parametrize("most", [10, 14, 18, 26])
def test_a_small_budget_is_kept_to_and_told(most: int, tmp_path: Path) -> None:
    cheap, dear = Cheap(bent), Membranes()
    settings = Settings(mcmc=QUICK.mcmc, max_runs=most)
    found = run(cheap, dear, tmp_path, settings)
    assert len(found.x) <= most and dear.calls >= 2
    if found.change.max() > 2.0 * settings.correction_share:
        assert found.stopped.startswith(f"{most} runs were allowed")
        assert any("may still move" in note and "--max-runs" in note for note in found.notes)


def test_fewer_runs_of_the_reference_than_a_correction_needs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="at least 4 runs of the reference"):
        run(Cheap(), Membranes(), tmp_path, Settings(reference_runs=3))


def test_a_valley_that_comes_again_beside_a_cheap_run_is_looked_at_by_the_reference(tmp_path: Path) -> None:
    search, dear = searched(tmp_path)
    z = np.random.default_rng(0).random((8, 3))
    search.run(z, "cheap")
    evidence = search.refer(z[:3], "both")
    calls = dear.calls
    where = np.array([z[5] + 0.01, [0.5, 0.5, 0.99]])
    assert np.abs(z - where[1]).max(1).min() > 0.1
    found = _looked_at(search, evidence, where, "check", True)
    assert dear.calls == calls + 1
    own = found.z[found.own]
    assert np.abs(own - where[0]).max(1).min() < 1e-9 and np.abs(own - where[1]).max(1).min() > 0.1
    assert np.abs(found.z - where[1]).max(1).min() < 1e-9
    # points that are only not ruled out are for cheap runs
    _looked_at(search, found, np.array([z[6] + 0.01]), "check", False)
    assert dear.calls == calls + 1


def test_a_search_that_does_not_settle_leaves_runs_for_the_correction(tmp_path: Path) -> None:
    class Deceiving(Cheap):
        """Its derivatives point the other way: no step gains."""

        def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            for index, outcome in super().__call__(inputs):
                yield index, replace(outcome, gradients={key: -value for key, value in outcome.gradients.items()})

    for reference in (None, Reference(Membranes(), log_of(Membranes(), tmp_path / "runs.csv"))):
        settings, cheap = Settings(max_runs=10), Deceiving(bent)
        log = log_of(cheap, tmp_path / f"cheap_{reference is None}.csv")
        search = Search(cheap, box(), targets(), settings, log, lambda _: None, reference)
        _descend(search, _start(search, None))
        assert search.left == (0 if reference is None else 4)
        assert any("before it settled" in note for note in search.notes)


def test_of_runs_that_contradict_each_other_those_near_the_reference_s_best_stay(tmp_path: Path) -> None:
    """Cheap runs fit best elsewhere: their own misfit would keep the runs there."""
    search, _ = searched(tmp_path)
    z = np.array([[0.5, 0.5, 0.5 + 0.02 * k] for k in range(6)])
    search.run(z, "cheap")
    search.refer(z[4:6], "both")
    seen: list[np.ndarray | None] = []
    look = branches.look

    def kept(evidence: Evidence, held: Targets, order: np.ndarray | None = None) -> Branches:
        seen.append(order)
        return look(evidence, held, order)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(branches, "look", kept)
        made = search.evidence()
    best = made.z[made.best]
    assert seen[0] == pytest.approx(np.abs(z - best).max(1)) and seen[1] is None
    # two runs of six lie elsewhere: of each pair the one that is farther from the best goes
    cheap = made.take(np.arange(6))
    off = replace(cheap, residual=cheap.residual + 50.0 * np.array([1, 1, 1, 0, 0, 0])[:, None])
    for order, strays in ((seen[0], {0, 1, 2}), (-np.asarray(seen[0]), {3, 4, 5})):
        assert set(np.flatnonzero(look(off, targets(), order).strays)) == strays
