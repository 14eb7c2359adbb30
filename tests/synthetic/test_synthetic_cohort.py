"""Synthetic cohorts: what is drawn in each arm, and a patient written from a finer mesh than that of its calibration."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.api import anatomy
from lacli.base.errors import AnatomyError, UsageError
from lacli.cohort.participants import read_participants
from lacli.contracts.bundle import load
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.scene import load_scene
from lacli.contracts.targets import read_targets
from lacli.inference.box import published_box
from lacli.synthetic import cohort
from lacli.synthetic.cohort import ARMS, drawn_parameters, varying


@pytest.mark.parametrize("arm", ARMS)
def test_only_one_arm_has_regions_that_differ(arm: cohort.Arm) -> None:
    box = published_box()
    for seed in range(200):
        drawn = drawn_parameters(seed, arm)
        alpha = [drawn[f"alpha_{region}"] for region in BODY_REGIONS]
        assert (len(set(alpha)) > 1) == (arm == "heterogeneous")
        for name, low, high in zip(box.names, box.lower, box.upper, strict=True):
            assert low < drawn[name] < high, name
    assert drawn_parameters(1, arm) == drawn_parameters(1, arm) != drawn_parameters(2, arm)


def test_the_wall_is_thin_here_and_thick_there() -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(-40, 40, 30)] * 3), axis=-1).reshape(-1, 3)
    thickness = varying(3)(grid)
    assert 1.2 <= thickness.min() < 1.3 and 3.1 < thickness.max() <= 3.2


def test_what_cannot_be_made_is_told_first(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="one of heterogeneous, control, thickness"):
        anatomy.synthesize(tmp_path / "c", cohort=2, arm="regional")
    with pytest.raises(UsageError, match="one of published, motion, course"):
        anatomy.synthesize(tmp_path / "c", cohort=2, arm="control", targets="all")
    with pytest.raises(UsageError, match="--cohort how many"):
        anatomy.synthesize(tmp_path / "c", arm="control")
    with pytest.raises(UsageError, match="leave --gated"):
        anatomy.synthesize(tmp_path / "c", cohort=2, arm="control", gated=True)
    (tmp_path / "c" / "sub-01").mkdir(parents=True)
    (tmp_path / "c" / "sub-01" / "mine.txt").write_text("thesis")
    with pytest.raises(AnatomyError, match="no patient of a synthetic cohort"):
        anatomy.synthesize(tmp_path / "c", cohort=1, arm="control")
    assert (tmp_path / "c" / "sub-01" / "mine.txt").read_text() == "thesis"


def test_a_patient_with_other_targets_is_not_kept_whichever_came_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def write(folder: Path, *_: object) -> dict[str, object]:
        folder.mkdir(parents=True)
        (folder / "targets.toml").write_text("some")
        return {"parameters": {}, "edv_ml": 60.0, "truth_cpu_s": 1.0}

    monkeypatch.setattr(cohort, "_write", write)
    for targets in cohort.TARGETS:
        home = tmp_path / targets
        for _ in range(2):
            anatomy.synthesize(home, cohort=1, arm="control", targets=targets)
        for other in set(cohort.TARGETS) - {targets}:
            with pytest.raises(AnatomyError, match="was made from another arm or other options"):
                anatomy.synthesize(home, cohort=1, arm="control", targets=other)


@pytest.mark.slow
def test_a_patient_is_what_a_study_reads(tmp_path: Path) -> None:
    home = tmp_path / "c"
    options = {"cohort": 1, "arm": "thickness", "cell_size_mm": 10.0, "order": 1}
    anatomy.synthesize(home, **options)  # type: ignore[arg-type]
    (patient,) = read_participants(home / "participants.csv")
    assert patient.identifier == "sub-01" and patient.others["arm"] == "thickness"
    bundle, targets = load(patient.paths["bundle"]), read_targets(patient.paths["targets"])
    scene = load_scene(patient.paths["scene"])
    assert Path(scene.anatomy.bundle) == patient.paths["bundle"] and bundle.order == 1 == scene.numerics.order
    truth = json.loads((home / "sub-01" / "truth.json").read_text())
    errors = (targets.mean - [truth["features"][name] for name in targets.names]) / targets.sd
    assert np.abs(errors).max() < 4 and np.abs(errors).min() > 0  # seven draws of a normal
    sd = dict(zip(targets.names, targets.sd, strict=True))
    assert sd["d_roof_mm"] == 0.35 and sd["esv_ml"] == pytest.approx(0.01 * truth["features"]["edv_ml"])
    truths = pd.read_csv(home / "truths.csv")
    # what the loads are drawn from is stated with the targets; of stiffness nothing is
    assert targets.priors is not None
    assert {p.name: (p.lower, p.upper) for p in targets.priors} == {
        "edp_mmhg": (5.0, 9.0), "esp_mmhg": (17.0, 24.0), "k_peri_kpa_per_um": (0.0005, 0.002), "pth": (0.6, 0.85)
    }  # fmt: skip
    assert all(p.lower <= truths.loc[0, p.name] <= p.upper for p in targets.priors)
    assert truths.loc[0, "alpha_roof"] == drawn_parameters(1, "thickness")["alpha_roof"]
    assert not (home / "sub-01" / "truth_bundle").exists()  # what is calibrated knows nothing of it
    written = (home / "sub-01" / "targets.toml").stat().st_mtime_ns
    anatomy.synthesize(home, **options)  # type: ignore[arg-type]
    assert (home / "sub-01" / "targets.toml").stat().st_mtime_ns == written
    with pytest.raises(AnatomyError, match="another arm"):
        anatomy.synthesize(home, **{**options, "arm": "control"})  # type: ignore[arg-type]


@pytest.mark.slow
def test_targets_of_motion_have_the_published_ones_first(tmp_path: Path) -> None:
    options = {"cohort": 1, "arm": "control", "cell_size_mm": 12.0, "order": 1}
    anatomy.synthesize(tmp_path / "p", **options)  # type: ignore[arg-type]
    anatomy.synthesize(tmp_path / "m", targets="motion", **options)  # type: ignore[arg-type]
    few, many = (read_targets(tmp_path / name / "sub-01" / "targets.toml") for name in ("p", "m"))
    assert many.names[:7] == few.names and many.mean[:7] == pytest.approx(few.mean)
    # three components and the area strain of five regions
    assert len(many.names) == 7 + 4 * 5 and many.sd[many.names.index("area_strain_roof")] == cohort.SD_STRAIN
    with pytest.raises(AnatomyError, match="other options"):
        anatomy.synthesize(tmp_path / "p", targets="motion", **options)  # type: ignore[arg-type]
    anatomy.synthesize(tmp_path / "c", targets="course", **options)  # type: ignore[arg-type]
    most = read_targets(tmp_path / "c" / "sub-01" / "targets.toml")
    # 21 features in three frames beside the 27 at end-systole
    assert most.names[:27] == many.names and len(most.names) == 27 + 3 * 21
    truth = json.loads((tmp_path / "c" / "sub-01" / "truth.json").read_text())["features"]
    volumes = [truth[name] for name in ("edv_ml", "volume_ml@0.1", "volume_ml@0.2", "volume_ml@0.3", "esv_ml")]
    assert volumes == sorted(volumes), "the atrium fills"
    assert most.sd[most.names.index("volume_ml@0.2")] == pytest.approx(0.01 * truth["edv_ml"])
