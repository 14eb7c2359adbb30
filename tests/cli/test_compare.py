"""`lacli compare` on the folder of a calibration."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import lacli
from lacli.base.errors import InputError, UsageError
from lacli.cli import main
from lacli.contracts.identity import identify, write_identity
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.tables.table import RunTable
from lacli.contracts.targets import Targets, write_targets
from lacli.inference.box import make_box
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet, save_emulators

NAMES = tuple(f"alpha_{name}" for name in BODY_REGIONS)
OUTPUTS = tuple(f"d_{name}_mm" for name in BODY_REGIONS)


def _patient(folder: Path, targets: Targets) -> Path:
    """A calibration's folder, as far as a comparison reads it."""
    box = make_box(NAMES, [0.5] * 5, [4.0] * 5)
    x = box.uniform(40, np.random.default_rng(0))
    table = RunTable(NAMES, OUTPUTS, x, 10 - 2 * x, np.zeros((40, 5)), np.empty((0, 5)))
    (folder / "wave_1").mkdir(parents=True)
    emulators = EmulatorSet(NAMES, tuple(fit_emulators(table, starts=1, may_log=np.zeros(5, bool))))
    save_emulators(folder / "wave_1" / "emulators.npz", emulators)
    write_identity(folder / "calibration.json", identify("calibration", box=box))
    rows = zip(targets.names, targets.mean, targets.sd, strict=True)
    fit = [{"feature": name, "target": float(mean), "sd": float(sd)} for name, mean, sd in rows]
    (folder / "result.json").write_text(json.dumps({"waves": [{"wave": 1}], "fit": fit}))
    return folder


@pytest.fixture
def targets() -> Targets:
    return Targets(OUTPUTS, 10 - 2 * np.array([0.8, 1.5, 2.2, 3.0, 0.8]), np.full(5, 0.2))


def test_the_models_of_a_patient(tmp_path: Path, targets: Targets) -> None:
    folder, other = _patient(tmp_path / "p", targets), _patient(tmp_path / "u", targets)
    write_targets(tmp_path / "t.toml", targets)
    call = [
        "compare",
        str(folder),
        "--targets",
        str(tmp_path / "t.toml"),
        "--tie",
        "alpha_anterior=alpha_roof",
        "--particles",
        "200",
    ]
    shown = CliRunner().invoke(main.build({"compare"}), [*call, "--other", f"uniform={other}", "--json"])
    assert shown.exit_code == 0, shown.output
    document = json.loads(shown.stdout)
    assert [(f["name"], f["free"]) for f in document["fits"]] == [
        ("regional", 5),
        ("global", 1),
        ("pooled", 7),
        ("tied", 4),
        ("uniform", 5),
    ]
    verdicts = {c["against"]: c["verdict"] for c in document["contrasts"] if c["model"] == "regional"}
    assert verdicts["global"] == "regional is strongly preferred"
    assert verdicts["uniform"] == "no contrast can be claimed"  # it is the same anatomy
    # anterior and roof are alike in truth: one number less is the better model
    assert next(c["difference"] for c in document["contrasts"] if c["against"] == "tied") < 0
    assert json.loads((folder / "comparison.json").read_text()) == document
    assert "log evidence" in CliRunner().invoke(main.build({"compare"}), [*call, "--out", str(tmp_path / "c.json")]).stdout


def test_what_does_not_belong_together_is_refused(tmp_path: Path, targets: Targets) -> None:
    folder = _patient(tmp_path / "p", targets)
    write_targets(tmp_path / "t.toml", Targets(OUTPUTS, targets.mean + 1, targets.sd))
    with pytest.raises(UsageError, match=r"was calibrated to d_anterior_mm 8\.4"):
        lacli.compare(folder, tmp_path / "t.toml")
    write_targets(tmp_path / "t.toml", targets.select(OUTPUTS[1:]))
    with pytest.raises(UsageError, match="d_anterior_mm, which the targets given lack"):
        lacli.compare(folder, tmp_path / "t.toml")
    write_targets(tmp_path / "t.toml", targets)
    with pytest.raises(UsageError, match="named global"):
        lacli.compare(folder, tmp_path / "t.toml", others={"global": folder})
    with pytest.raises(InputError, match="finished calibration"):
        lacli.compare(tmp_path, tmp_path / "t.toml")
    write_identity(folder / "calibration.json", identify("calibration"))
    with pytest.raises(InputError, match="does not say the box"):
        lacli.compare(folder, tmp_path / "t.toml")


def _left_out(folder: Path, names: set[str]) -> None:
    """The calibration's result as it is where runs do not tell these targets."""
    result = json.loads((folder / "result.json").read_text())
    fit = [row for row in result["fit"] if row["feature"] not in names]
    (folder / "result.json").write_text(json.dumps(result | {"fit": fit, "targets_left_out": sorted(names)}))


def test_targets_that_a_calibration_left_out_are_left_out_for_all_with_a_word(tmp_path: Path, targets: Targets) -> None:
    folder, other = _patient(tmp_path / "p", targets), _patient(tmp_path / "u", targets)
    write_targets(tmp_path / "t.toml", targets)
    _left_out(other, {OUTPUTS[4]})
    some = lacli.compare(folder, tmp_path / "t.toml", particles=100, others={"uniform": other})
    assert some.warnings[0] == (
        "1 targets are held against no model: the calibration of uniform left them out, as its runs do not tell them (d_roof_mm)."
    )
    # both calibrations are of one simulator: what they say of four targets is the same
    fits = {fit.name: fit for fit in some.fits}
    se = np.hypot(fits["regional"].log_evidence_se, fits["uniform"].log_evidence_se)
    assert fits["uniform"].log_evidence == pytest.approx(fits["regional"].log_evidence, abs=4 * se)
    # of each of four targets a region of its own explains all but 1 / (2 mm * 3.5); of five it would be 1.9 less
    assert fits["regional"].log_evidence == pytest.approx(-4 * np.log(2 * 3.5), abs=4 * se + 0.1) and se < 0.3
    _left_out(folder, set(OUTPUTS[:4]))
    with pytest.raises(UsageError, match="nothing is left"):
        lacli.compare(folder, tmp_path / "t.toml", others={"uniform": other})
    _left_out(other, set(OUTPUTS[:2]))
    document = json.loads((other / "result.json").read_text())
    (other / "result.json").write_text(json.dumps(document | {"targets_left_out": []}))
    with pytest.raises(UsageError, match="uniform was calibrated to other features"):
        lacli.compare(folder, tmp_path / "t.toml", others={"uniform": other})


@pytest.mark.parametrize("option", [["--tie", "alpha_roof"], ["--tie", "a="], ["--other", "uniform"], ["--other", "=x"]])
def test_options_are_read_before_anything_runs(tmp_path: Path, option: list[str]) -> None:
    shown = CliRunner().invoke(main.build({"compare"}), ["compare", str(tmp_path), "--targets", "t.toml", *option])
    assert isinstance(shown.exception, UsageError) and "write" in str(shown.exception)
