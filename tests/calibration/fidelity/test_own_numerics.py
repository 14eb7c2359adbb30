"""The numerics that a calibration's answer is of, by its identity: the scene's own, not those of the cheap runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from shapes import hollow_cube

from lacli.calibration.sequential.calibration import sequential_identity
from lacli.calibration.sequential.fidelity.companion import companion
from lacli.calibration.sequential.search import Settings
from lacli.calibration.simulator import simulator
from lacli.cohort.patient import held_against
from lacli.contracts.bundle import save
from lacli.contracts.identity import bundle_digest, of_own_runs, write_identity
from lacli.contracts.scene import load_scene
from lacli.contracts.targets import Targets
from lacli.inference.box import published_box
from lacli.inference.runs import runs_identity
from lacli.mechanics.numerics.error_correlation import correlation

NAMES = ("n_roof_mm", "n_septum_mm")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of a calibration of quadratic cells, carried by linear ones on coarser cells."""
    save(hollow_cube(), tmp_path / "la")
    save(hollow_cube(1.1), tmp_path / "coarser")
    (tmp_path / "scene.toml").write_text('[anatomy]\nbundle = "la"\n')
    scene = load_scene(tmp_path / "scene.toml")
    box = published_box()
    targets = Targets(NAMES, np.array([1.0, 2.0]), np.array([0.3, 0.4]))
    kinds = (scene, companion(scene, ["order=1", "anatomy.bundle=coarser"]))
    own, cheap = (runs_identity(simulator(one, tmp_path / "runs", 1, targets=NAMES), box.names, NAMES) for one in kinds)
    write_identity(tmp_path / "calibration.json", sequential_identity(box, targets, Settings(), cheap, own))
    write_identity(tmp_path / "alone.json", sequential_identity(box, targets, Settings(), cheap))
    return tmp_path


def test_they_are_the_reference_s(folder: Path) -> None:
    assert of_own_runs(folder / "calibration.json", "numerics.order") == 2
    assert of_own_runs(folder / "calibration.json", "bundle") == f"content {bundle_digest(folder / 'la')[:16]}"
    assert of_own_runs(folder / "alone.json", "numerics.order") == 1
    assert of_own_runs(folder / "alone.json", "bundle") == f"content {bundle_digest(folder / 'coarser')[:16]}"


def test_a_comparison_takes_their_errors_to_go_together_as_theirs_do(folder: Path) -> None:
    given = Targets(NAMES, np.array([1.0, 2.0]), np.array([0.3, 0.4]))
    held = given.widened({"n_roof_mm": 0.2, "n_septum_mm": 0.5}, correlation(NAMES, given.mean, 2))
    fit = [
        {"feature": name, "target": m, "sd": s, "own_sd": o}
        for name, m, s, o in zip(NAMES, given.mean.tolist(), held.sd.tolist(), held.own_sd.tolist(), strict=True)
    ]
    (folder / "result.json").write_text(json.dumps({"method": "sequential", "fit": fit}))
    found = held_against(folder, given)
    assert found.covariance == pytest.approx(held.covariance)
    linear = given.widened({"n_roof_mm": 0.2, "n_septum_mm": 0.5}, correlation(NAMES, given.mean, 1))
    assert found.covariance != pytest.approx(linear.covariance)
