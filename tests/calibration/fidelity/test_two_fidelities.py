"""Cheap runs corrected by few of a reference, on simulators with known answers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from membranes import INPUTS, OUTPUTS, Membranes, box, respond

from lacli.base.errors import InputError, LacliError, UsageError
from lacli.calibration.sequential.calibration import calibrate_sequentially
from lacli.calibration.sequential.evidence import Evidence, gather
from lacli.calibration.sequential.fidelity.bridge import bridge
from lacli.calibration.sequential.fidelity.corrected import Corrected, emulate
from lacli.calibration.sequential.fidelity.correction import Correction, corrected, fit_correction
from lacli.calibration.sequential.outputs import CHEAP, features_of
from lacli.calibration.sequential.result import Sequential
from lacli.calibration.sequential.scale import Scale
from lacli.calibration.sequential.search import Reference, Search, Settings
from lacli.contracts.targets import Targets
from lacli.inference.runs import Outcome, RunLog, runs_identity
from lacli.inference.sampling.posterior import Settings as Sampling

QUICK = Settings(mcmc=Sampling(ess=600, rhat=1.05, max_steps=2000))
TRUTH = np.array([1.4, 1.5, 8.9])
SD = 0.1
Difference = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def linear(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """delta (12,) at z (3,), up to nine standard deviations of a target, and its derivatives (12, 3)."""
    j = np.arange(12)
    slope = np.stack([0.3 * np.cos(j), 0.2 * np.sin(2.0 * j), 0.1 * np.cos(3.0 * j + 1.0)], axis=1)
    return 0.5 * np.sin(j + 0.5) + slope @ z, slope


def bent(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same and a bend, which moves it by some standard deviations over the box."""
    value, slope = linear(z)
    by = np.cos(np.arange(12) + 0.3)[:, None] * np.array([0.5, 0.3, 0.2])
    return value + (by * np.sin(4.0 * z)).sum(1) / 2.0, slope + 2.0 * by * np.cos(4.0 * z)


class Cheap(Membranes):
    """The membranes less a difference: membranes = rho cheap + difference."""

    def __init__(self, difference: Difference = linear, rho: float = 1.0, **given: Any) -> None:
        super().__init__(**given)
        self.difference, self.rho = difference, rho

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        scale = Scale.of(box())
        for index, outcome in super().__call__(inputs):
            if outcome.status != "done":
                yield index, outcome
                continue
            x = inputs[list(INPUTS)].to_numpy(float)[index]
            y, slope = respond(x)
            off, steep = self.difference(scale.to_z(x[None])[0])
            steep = steep / scale.slope(x[None])[0]
            y, slope = (y - off) / self.rho, (slope - steep) / self.rho
            gradients = {(o, i): float(slope[j, k]) for j, o in enumerate(OUTPUTS) for k, i in enumerate(INPUTS)}
            yield index, Outcome(dict(zip(OUTPUTS, y.tolist(), strict=True)), gradients=gradients if self.told else {}, cpu_s=0.1)

    def determined_by(self, inputs: Sequence[str]) -> Mapping[str, Any]:
        return {"model": f"cheap membranes, {self.difference.__name__}, {self.rho}"}


def log_of(simulator: Membranes, file: Path) -> RunLog:
    return RunLog(file, INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS))


def targets() -> Targets:
    noise = SD * np.random.default_rng(4).standard_normal(len(OUTPUTS))
    return Targets(OUTPUTS, respond(TRUTH)[0] + noise, np.full(len(OUTPUTS), SD))


def run(cheap: Membranes, dear: Membranes, folder: Path, settings: Settings = QUICK) -> Sequential:
    reference = Reference(dear, log_of(dear, folder / "runs.csv"))
    return calibrate_sequentially(cheap, box(), targets(), settings, folder, log_of(cheap, folder / CHEAP), reference=reference)


def both(cheap: Membranes, dear: Membranes, z: np.ndarray, count: int, folder: Path) -> tuple[Evidence, Evidence]:
    """Cheap runs at all of z (n, 3), dear ones at the first ``count``."""
    scale = Scale.of(box())
    found = []
    for name, simulator, at in (("cheap", cheap, z), ("dear", dear, z[:count])):
        log, x = log_of(simulator, folder / f"{name}.csv"), scale.to_x(at)
        log.run(simulator, x)
        found.append(gather(log, x, targets(), scale))
    return found[0], found[1]


def test_a_linear_difference_is_found_exactly_from_two_runs(tmp_path: Path) -> None:
    z = np.random.default_rng(0).random((30, 3))
    cheap, dear = both(Cheap(), Membranes(), z, 2, tmp_path)
    correction = fit_correction(cheap, dear)
    assert correction is not None
    assert correction.rho == pytest.approx(1.0, abs=1e-4)
    there = corrected(cheap, dear, correction)
    whole, _ = both(Membranes(), Membranes(), z, 2, tmp_path / "whole")
    assert there.residual == pytest.approx(whole.residual, abs=0.01)  # of a target's standard deviation
    assert there.jacobian == pytest.approx(whole.jacobian, abs=0.05)
    assert there.own.tolist() == [True] * 2 + [False] * 28
    # nothing is left to know of the difference
    made = emulate(there)
    assert isinstance(made, Corrected)
    assert made.own.max() * made.delta.share(z).max() < 1e-3


def test_the_factor_between_the_fidelities_is_learnt(tmp_path: Path) -> None:
    z = np.random.default_rng(0).random((30, 3))
    cheap, dear = both(Cheap(rho=0.8), Membranes(), z, 6, tmp_path)
    correction = fit_correction(cheap, dear)
    assert correction is not None
    assert correction.rho == pytest.approx(0.8, abs=0.02)
    there = corrected(cheap, dear, correction)
    whole, _ = both(Membranes(), Membranes(), z, 2, tmp_path / "whole")
    assert np.sqrt(np.mean((there.residual - whole.residual) ** 2)) < 0.3


def test_what_is_not_known_grows_away_from_the_reference_s_runs_and_covers_the_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    z = np.vstack([0.5 + 0.2 * (rng.random((6, 3)) - 0.5), rng.random((60, 3))])
    cheap, dear = both(Cheap(bent), Membranes(), z, 6, tmp_path)
    correction = fit_correction(cheap, dear)
    assert correction is not None
    share = correction.delta.share(z)
    away = np.abs(z - 0.5).max(1)
    order = np.argsort(away)
    assert share[order[:10]].mean() < 0.1 * share[order[-10:]].mean()
    truth = np.array([(bent(point)[0]) / SD for point in z[6:]])
    at_zero = corrected(cheap, dear, correction)
    off = at_zero.residual[6:] - (cheap.residual[6:] + truth)
    mean, variance = correction.delta.predict(z[6:])
    assert np.mean(off**2) < 2.0 * np.mean(variance.sum(1) / 12)
    assert mean.shape == off.shape
    # the likelihood has that error: the corrected emulator's variance is the larger one
    made, plain = emulate(at_zero), emulate(cheap)
    assert (made.predict(z[order[-5:]])[1].sum(1) > plain.predict(z[order[-5:]])[1].sum(1)).all()
    assert isinstance(made, Corrected)
    few = made.reduced()
    assert (few.predict(z)[0] ** 2).sum(1) == pytest.approx((made.predict(z)[0] ** 2).sum(1), rel=1e-4, abs=1e-2)
    assert few.predict(z)[1].sum(1) == pytest.approx(made.predict(z)[1].sum(1), rel=1e-2, abs=1e-3)


def test_too_few_pairs_are_no_correction(tmp_path: Path) -> None:
    z = np.random.default_rng(0).random((8, 3))
    assert fit_correction(*both(Cheap(), Membranes(), z, 1, tmp_path)) is None
    assert fit_correction(*both(Cheap(), Membranes(told=False), z, 4, tmp_path / "untold")) is None


@pytest.mark.parametrize("difference", [linear, bent])
def test_the_posterior_is_the_reference_s(tmp_path: Path, difference: Difference) -> None:
    cheap, dear = Cheap(difference), Membranes()
    found = run(cheap, dear, tmp_path)
    alone = Membranes()
    whole = calibrate_sequentially(
        alone, box(), targets(), QUICK, tmp_path / "whole", log_of(alone, tmp_path / "whole" / "runs.csv")
    )
    flat, exact = found.chain.flat(), whole.chain.flat()
    assert np.abs((flat.mean(0) - exact.mean(0)) / exact.std(0)).max() < 0.2
    assert np.abs(flat.std(0) / exact.std(0) - 1.0).max() < 0.2
    assert dear.calls <= 10
    assert found.fidelity is not None
    assert found.fidelity.runs == dear.calls
    assert found.runs == dear.calls + cheap.calls
    assert not found.refused
    assert found.cpu_s == pytest.approx(dear.calls + 0.1 * cheap.calls)
    # what is said of the answer is of the reference's run there
    y, _ = respond(found.map_x)
    assert [row["simulated"] for row in found.fit] == pytest.approx(y.tolist())
    # the cheap runs alone would be somewhere else
    z = Scale.of(box()).to_z(found.map_x[None])[0]
    added = np.array([found.fidelity.added_sd[name] for name in OUTPUTS])
    assert added == pytest.approx(difference(z)[0] / SD, abs=1e-6)
    assert np.abs(added).max() > 3.0
    assert any("runs of the scene's own numerics" in note for note in found.notes)


def test_an_interrupted_calibration_ends_the_same_and_repeats_no_run(tmp_path: Path) -> None:
    whole = run(Cheap(bent), Membranes(), tmp_path / "whole")
    assert whole.fidelity is not None

    class Interrupted(Membranes):
        def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            for item in super().__call__(inputs):
                if self.calls > 2:
                    raise KeyboardInterrupt
                yield item

    with pytest.raises(KeyboardInterrupt):
        run(Cheap(bent), Interrupted(), tmp_path / "parts")
    dear = Membranes()
    ended = run(Cheap(bent), dear, tmp_path / "parts")
    assert dear.calls + 2 == whole.fidelity.runs
    assert np.array_equal(ended.chain.flat(), whole.chain.flat())
    assert ended.stages == whole.stages


def test_another_cheap_simulator_is_another_calibration(tmp_path: Path) -> None:
    run(Cheap(), Membranes(), tmp_path)
    with pytest.raises(UsageError, match="Choose another --out"):
        run(Cheap(bent), Membranes(), tmp_path)
    with pytest.raises(UsageError, match="Choose another --out"):
        calibrate_sequentially(Cheap(), box(), targets(), QUICK, tmp_path, log_of(Cheap(), tmp_path / CHEAP))


def test_more_runs_of_the_reference_are_a_budget(tmp_path: Path) -> None:
    few = Settings(mcmc=QUICK.mcmc, reference_runs=4)
    found = run(Cheap(bent), Membranes(), tmp_path, few)
    assert found.fidelity is not None
    assert found.fidelity.runs <= 4
    again = run(Cheap(bent), Membranes(), tmp_path)
    assert again.fidelity is not None
    assert again.fidelity.runs >= found.fidelity.runs


def test_a_reference_that_fails_is_said(tmp_path: Path) -> None:
    with pytest.raises(LacliError, match=r"give no correction \(failed\).*--cheap none"):
        run(Cheap(), Membranes(fail=lambda x: True), tmp_path)


def test_a_reference_that_fails_here_and_there_is_gone_around(tmp_path: Path) -> None:
    calls = iter(range(1000))
    found = run(Cheap(), Membranes(fail=lambda x: next(calls) in (0, 2)), tmp_path)
    assert not found.refused
    assert found.failed == 2


def test_the_emulator_of_the_folder_is_the_corrected_one(tmp_path: Path) -> None:
    run(Cheap(bent), Membranes(), tmp_path)
    made = features_of(tmp_path / "runs.csv", box(), targets()).select(("f3", "f0"))
    x = TRUTH + np.random.default_rng(0).standard_normal((20, 3)) * 0.05
    mean, variance = made.predict(x)
    assert mean == pytest.approx(np.array([respond(point)[0][[3, 0]] for point in x]), abs=0.03)
    assert (variance < 0.05**2).all()
    few = pd.read_csv(tmp_path / "runs.csv").iloc[:1]
    few.to_csv(tmp_path / "runs.csv", index=False)
    with pytest.raises(InputError, match="too few runs"):
        features_of(tmp_path / "runs.csv", box(), targets())


def test_a_correction_tells_its_slope(tmp_path: Path) -> None:
    z = np.random.default_rng(0).random((8, 3))
    correction = fit_correction(*both(Cheap(bent), Membranes(), z, 8, tmp_path))
    assert isinstance(correction, Correction)
    at, h = np.array([0.4, 0.5, 0.6]), 1e-5
    ends = [(correction.mean((at + h * e)[None]) - correction.mean((at - h * e)[None]))[0] / (2 * h) for e in np.eye(3)]
    assert correction.slope(at) == pytest.approx(np.stack(ends, axis=1), abs=1e-4)


class Lost(Membranes):
    """A reference whose runs all fail."""

    def __init__(self) -> None:
        super().__init__(fail=lambda _: True)


def test_a_reference_that_never_finishes_gives_no_correction_and_says_so(tmp_path: Path) -> None:
    simulator, reference = Cheap(), Lost()
    targets = Targets(OUTPUTS, respond(TRUTH)[0], np.full(len(OUTPUTS), SD))
    search = Search(
        simulator, box(), targets, QUICK, log_of(simulator, tmp_path / "runs_cheap.csv"), lambda _: None,
        Reference(reference, log_of(reference, tmp_path / "runs.csv")),
    )  # fmt: skip
    evidence = search.run(np.vstack([TRUTH, TRUTH * 1.1, TRUTH * 0.9, TRUTH * 0.95]), "start")
    with pytest.raises(LacliError, match=r"give no correction .*fewer than 2 finished with derivatives"):
        bridge(search, evidence)
