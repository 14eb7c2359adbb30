"""One patient's calibration as a study reads it: refused where it was made to something else."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lacli.base.errors import InputError, UsageError
from lacli.cohort.patient import IDENTITY, RESULT, read_model, read_result
from lacli.contracts.tables.table import combine
from lacli.contracts.targets import Targets
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet, save_emulators

TARGETS = Targets(("d_roof_mm", "esv_ml"), np.array([5.0, 90.0]), np.array([0.2, 4.0]))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    import pandas as pd

    x = np.random.default_rng(0).random((25, 2))
    inputs = pd.DataFrame(x, columns=["alpha_roof", "esp_mmhg"])
    outputs = pd.DataFrame({"d_roof_mm": 5 + x[:, 0], "esv_ml": 90 + x.sum(1)})
    table = combine(inputs, outputs)
    (tmp_path / "wave_1").mkdir()
    save_emulators(tmp_path / "wave_1" / "emulators.npz", EmulatorSet(table.inputs, tuple(fit_emulators(table))))
    fit = [{"feature": n, "target": m, "sd": s} for n, m, s in zip(TARGETS.names, TARGETS.mean, TARGETS.sd, strict=True)]
    (tmp_path / RESULT).write_text(json.dumps({"waves": [{}], "fit": fit}))
    content = {"box.names": ["alpha_roof", "esp_mmhg"], "box.lower.alpha_roof": 0.1, "box.lower.esp_mmhg": 10.0,
               "box.upper.alpha_roof": 4.0, "box.upper.esp_mmhg": 30.0}  # fmt: skip
    (tmp_path / IDENTITY).write_text(json.dumps({"content": content}))
    return tmp_path


def test_emulators_and_box_are_those_of_the_last_wave(folder: Path) -> None:
    model = read_model(folder, TARGETS)
    assert model.box.names == ("alpha_roof", "esp_mmhg") and model.box.upper.tolist() == [4.0, 30.0]
    assert model.emulators.predict_mean(np.array([[0.5, 0.25]]))[0] == pytest.approx([5.5, 90.75], abs=0.02)


@pytest.mark.parametrize(
    ("targets", "words"),
    [
        (Targets(("esv_ml",), np.array([90.0]), np.array([4.0])), "calibrated to d_roof_mm, which the targets given lack"),
        (Targets(TARGETS.names, np.array([5.0, 91.0]), TARGETS.sd), "esv_ml 90 ± 4, the targets given say 91 ± 4"),
        (Targets(TARGETS.names, TARGETS.mean, np.array([0.3, 4.0])), "d_roof_mm 5 ± 0.2, the targets given say 5 ± 0.3"),
    ],
)
def test_other_targets_are_refused_by_name(folder: Path, targets: Targets, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        read_model(folder, targets)


def test_what_is_no_calibration_or_damaged_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is this the folder of a finished calibration"):
        read_result(tmp_path / "nowhere")
    (folder / IDENTITY).write_text(json.dumps({"content": {"box.names": ["alpha_roof"]}}))
    with pytest.raises(InputError, match="does not say the box"):
        read_model(folder, TARGETS)
    (folder / RESULT).write_text("[]")
    with pytest.raises(InputError, match="not a calibration's result"):
        read_result(folder)
