"""The folder of a sequential calibration, as the comparison of models and the patient's page read it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from membranes import INPUTS, OUTPUTS, Membranes, box, respond

from lacli.api import study
from lacli.base.errors import InputError, UsageError
from lacli.calibration.sequential.calibration import calibrate_sequentially
from lacli.calibration.sequential.outputs import features_of
from lacli.calibration.sequential.search import Settings
from lacli.contracts.targets import Targets, write_targets
from lacli.inference.runs import RunLog, runs_identity
from lacli.inference.sampling.posterior import Settings as Sampling

TRUTH = np.array([1.4, 1.5, 8.9])


@pytest.fixture(scope="module")
def patient(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Targets]:
    folder = tmp_path_factory.mktemp("patient")
    targets = Targets(OUTPUTS, respond(TRUTH)[0], np.full(len(OUTPUTS), 0.1))
    simulator = Membranes()
    log = RunLog(folder / "runs.csv", INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS))
    settings = Settings(mcmc=Sampling(ess=400, rhat=1.05, max_steps=1000))
    calibrate_sequentially(simulator, box(), targets, settings, folder, log)
    write_targets(folder / "targets.toml", targets)
    return folder, targets


def test_its_emulator_foretells_the_features_in_their_units(patient: tuple[Path, Targets]) -> None:
    folder, targets = patient
    made = features_of(folder / "runs.csv", box(), targets).select(("f3", "f0"))
    x = TRUTH + np.random.default_rng(0).standard_normal((20, 3)) * 0.05
    exact = np.array([respond(point)[0][[3, 0]] for point in x])
    mean, variance = made.predict(x)
    assert mean == pytest.approx(exact, abs=0.01)
    assert (variance > 0).all() and (variance < 0.05**2).all()


def test_models_are_compared_without_a_run(patient: tuple[Path, Targets]) -> None:
    folder, _ = patient
    found = study.compare(folder, folder / "targets.toml", particles=200)
    # 1.4 and 1.5 are nearly one stiffness: the simpler model is not rejected
    assert {fit.name for fit in found.fits} == {"regional", "global", "pooled"}
    assert abs(found.fits[0].log_evidence - found.fits[1].log_evidence) < 6.0


def test_its_page_tells_runs_and_what_the_emulator_leaves(patient: tuple[Path, Targets], tmp_path: Path) -> None:
    folder, _ = patient
    study.write_report(folder, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "to the most probable point" in text
    assert "Morris et al. 1993" in text
    assert "no other mode" in text


def test_other_targets_are_refused(patient: tuple[Path, Targets], tmp_path: Path) -> None:
    folder, targets = patient
    write_targets(tmp_path / "other.toml", replace(targets, mean=targets.mean + 1.0))
    with pytest.raises(UsageError, match="was calibrated to f0"):
        study.compare(folder, tmp_path / "other.toml")


def test_runs_without_derivatives_are_told(tmp_path: Path) -> None:
    simulator = Membranes(told=False)
    targets = Targets(OUTPUTS, respond(TRUTH)[0], np.full(len(OUTPUTS), 0.1))
    log = RunLog(tmp_path / "runs.csv", INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS))
    log.run(simulator, box().from_unit(np.random.default_rng(0).random((6, 3))))
    with pytest.raises(InputError, match="no run in it tells derivatives"):
        features_of(tmp_path / "runs.csv", box(), targets)
