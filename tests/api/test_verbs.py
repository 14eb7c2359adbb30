"""Verbs as a script calls them: cancelled before they begin they leave nothing, and what cannot be is refused first."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from chains import chain_of
from shapes import hollow_cube

from lacli.api import anatomy, calibration, design, mechanics, motion, posterior, segmentation
from lacli.api.progress import Progress
from lacli.base.errors import AnatomyError, Cancelled, LacliError, UsageError
from lacli.contracts.bundle import save
from lacli.contracts.scene import build_scene
from lacli.contracts.tables.table import combine
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet


def unwanted() -> bool:
    return True


def test_a_design_is_its_points_or_nothing(tmp_path: Path) -> None:
    box = make_box(("alpha_roof", "esp_mmhg"), (0.5, 12.0), (2.0, 30.0))
    table = tmp_path / "d.csv"
    with pytest.raises(Cancelled):
        design.design(table, count=8, box=box, cancel=unwanted)
    assert list(tmp_path.iterdir()) == []
    made = design.design(table, count=8, box=box, method="lhs", seed=3)
    frame = pd.read_csv(table)
    assert list(frame.columns) == ["alpha_roof", "esp_mmhg"] and len(frame) == 8
    assert box.contains(frame.to_numpy()).all() and (frame.to_numpy() == made.x).all()
    strata = np.floor((frame["esp_mmhg"].to_numpy() - 12.0) / 18.0 * 8).astype(int)
    assert sorted(strata.tolist()) == list(range(8)), "a Latin hypercube"
    with pytest.raises(UsageError, match="--method grid: must be one of"):
        design.design(table, count=8, box=box, method="grid")


def test_a_simulation_that_is_not_wanted_is_not_begun(tmp_path: Path) -> None:
    save(hollow_cube(), tmp_path / "la")
    scene = build_scene({"anatomy": {"bundle": "la"}}, [], folder=tmp_path, where="test")
    with pytest.raises(Cancelled):
        mechanics.simulate(scene, store=tmp_path / "runs", cancel=unwanted)
    assert not (tmp_path / "runs").exists()
    with pytest.raises(AnatomyError, match="not an anatomy bundle"):
        mechanics.tradeoff(scene, finer=tmp_path / "none", store=tmp_path / "runs")


def test_the_solver_s_phases_become_stages() -> None:
    heard: list[Progress] = []
    listen = mechanics._listener(heard.append, None)
    for phase, load in (("prestrain", 0.5), ("prestrain", 1.0), ("reservoir", float("nan"))):
        listen(SimpleNamespace(phase=phase, load=load))  # type: ignore[arg-type]
    assert [(e.stage, e.done, e.total) for e in heard] == [
        ("prestrain", 0.5, 1.0),
        ("prestrain", 1.0, 1.0),
        ("reservoir", 0.0, 1.0),
    ]


def test_a_calibration_takes_a_scene_or_a_table(tmp_path: Path) -> None:
    targets = Targets(("esv_ml",), np.array([90.0]), np.array([4.0]))
    with pytest.raises(UsageError, match="either a scene to simulate, or a table"):
        calibration.calibrate(None, targets, tmp_path / "c")
    with pytest.raises(UsageError, match="--prior flat: must be nroy or box"):
        posterior.check_prior("flat")
    assert not (tmp_path / "c").exists()


def test_a_posterior_s_box_is_that_of_its_emulators(tmp_path: Path) -> None:
    x = np.random.default_rng(1).random((25, 2)) + 0.5
    table = combine(pd.DataFrame(x, columns=["alpha_roof", "w"]), pd.DataFrame({"y_mm": x[:, 0] + x[:, 1]}))
    emulators = EmulatorSet(table.inputs, tuple(fit_emulators(table)))
    targets = Targets(("y_mm",), np.array([2.0]), np.array([0.1]))
    box = make_box(("w", "alpha_roof"), (0.5, 0.5), (1.5, 1.5))
    with pytest.raises(UsageError, match="exactly the inputs alpha_roof, w, in this order"):
        posterior.posterior(emulators, targets, tmp_path / "p", box=box)
    with pytest.raises(Cancelled):
        posterior.posterior(emulators, targets, tmp_path / "p", cancel=unwanted)
    assert not (tmp_path / "p").exists()
    assert chain_of(("a",)).flat().shape[1] == 1


def test_motion_that_cannot_be_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--axes xyz: lps"):
        motion.track([tmp_path / "a.nrrd"], tmp_path / "la", tmp_path / "out", axes="xyz")
    with pytest.raises(UsageError, match="needs --error-mm"):
        motion.track([tmp_path / "a.vtp"], tmp_path / "la", tmp_path / "out", motion="surfaces")
    assert list(tmp_path.iterdir()) == []


def test_options_of_a_mesh_are_checked_before_the_file_is_read(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--cell-size-mm is 0\.1 mm; it must be 0\.2 to 10 mm"):
        anatomy.mesh(tmp_path / "none.nrrd", tmp_path / "out", cell_size_mm=0.1)
    for wave in (-1.0, 31.0, float("nan")):
        with pytest.raises(UsageError, match=r"--wave-mm is .* mm; it must be 0 \(nothing is evened\) to 30 mm"):
            anatomy.mesh(tmp_path / "none.nrrd", tmp_path / "out", wave_mm=wave)
    with pytest.raises(LacliError, match=r"none\.nrrd: no such file"):
        anatomy.mesh(tmp_path / "none.nrrd", tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "stem"), [("a.nii.gz", "a"), ("a.b.nrrd", "a.b"), ("LABELS.NII", "LABELS"), ("x.mha", "x")])
def test_what_stands_beside_a_label_map_has_its_stem(name: str, stem: str) -> None:
    assert segmentation.stem(Path(name)) == stem
