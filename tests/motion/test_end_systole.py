"""End-systole of targets is held against the scene's: a frame's pressure hangs on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lacli import calibrate
from lacli.api.validation import _tell_end_systole
from lacli.base.errors import TableError, UsageError
from lacli.calibration.simulator import check_end_systole, of_known_loads
from lacli.contracts.identity import flatten
from lacli.contracts.motion import Motion, save_motion
from lacli.contracts.scene import Scene
from lacli.contracts.targets import Targets, read_targets, write_targets

SceneOf = Callable[..., Scene]
FRAMES = Targets(("esv_ml", "n_roof_mm@0.3"), np.array([90.0, 2.0]), np.array([2.0, 0.3]), es_time=0.33)


@pytest.fixture
def scene_with(scene_of: SceneOf, tmp_path: Path) -> SceneOf:
    save_motion(Motion(np.array([0.0, 0.4]), np.array([0]), np.zeros((2, 1, 3)), 0.4), tmp_path / "bundle")
    return scene_of


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ((), r"is at 0\.33 of the cycle, that of .*bundle/motion\.npz, .* at 0\.4: .* Track again with --update-bundle, or"),
        (("motion.annulus=none",), r"the scene's \(motion\.es_time\) at 0\.4: .* Set motion\.es_time=0\.33\."),
        # one of ten frames is the peak: .3 is the nearest
        (("motion.annulus=axial", "motion.es_time=0.33"), r"at 0\.3: .* and motion\.frames so that it is one of them"),
    ],
)
def test_frames_of_another_end_systole_are_refused(
    scene_with: SceneOf, tmp_path: Path, overrides: tuple[str, ...], words: str
) -> None:
    scene = scene_with(*overrides)
    with pytest.raises(UsageError, match=words):
        check_end_systole(scene, FRAMES)
    for method in ("sequential", "published"):
        with pytest.raises(UsageError, match=words):
            calibrate(scene, FRAMES, tmp_path / "out", method=method)  # type: ignore[call-overload]
    with pytest.raises(UsageError, match=words):
        calibrate(scene, FRAMES, tmp_path / "out", dry_run=True)
    assert not (tmp_path / "out").exists()


def test_what_hangs_on_no_end_systole_or_on_the_same_goes_on(scene_with: SceneOf) -> None:
    scene = scene_with()
    check_end_systole(scene, replace(FRAMES, es_time=None))
    check_end_systole(scene, replace(FRAMES, es_time=0.415))
    check_end_systole(scene, FRAMES.select(["esv_ml"]))
    check_end_systole(scene_with("motion.annulus=none", "motion.es_time=0.33"), FRAMES)


def test_targets_keep_their_end_systole_and_are_the_same_with_and_without(tmp_path: Path) -> None:
    write_targets(tmp_path / "t.toml", FRAMES)
    read = read_targets(tmp_path / "t.toml")
    assert read.es_time == read.select(["esv_ml"]).es_time == read.widened({"esv_ml": 1.0}).es_time == 0.33
    assert flatten(read) == flatten(replace(read, es_time=None)) and "es_time" not in flatten(read)
    for wrong in ('"late"', "1.5", "true"):
        (tmp_path / "t.toml").write_text(f"es_time = {wrong}\n[targets.esv_ml]\nmean = 90.0\nsd = 2.0\n")
        with pytest.raises(TableError, match=r"es_time is .* between 0 and 1"):
            read_targets(tmp_path / "t.toml")


def test_a_run_of_another_end_systole_is_told(caplog: pytest.LogCaptureFixture) -> None:
    import pandas as pd

    run = pd.DataFrame({"time": [0.0, 0.2, 0.4, 0.7], "phase": ["ed", "reservoir", "reservoir", "conduit"]})
    _tell_end_systole(Path("run"), run, Path("motion"), 0.41)
    assert not caplog.records
    _tell_end_systole(Path("run"), run, Path("motion"), 0.33)
    (told,) = [record.getMessage() for record in caplog.records]
    assert told.startswith("run: end-systole is at 0.4 of the cycle, in motion at 0.33")


def test_frames_whose_pressure_is_not_known_are_not_calibrated_to(scene_with: SceneOf) -> None:
    """After end-systole the pressure falls as no input says: what the wall does then is no measure of its stiffness."""
    names = ("esv_ml", "n_roof_mm@0.3", "n_roof_mm@0.41", "n_roof_mm@0.6", "volume_ml@0.8")
    given = Targets(names, np.arange(1.0, 6.0), np.full(5, 0.3), np.diag(np.arange(1.0, 6.0)) ** 2)
    kept, said = of_known_loads(scene_with(), given)
    assert kept.names == names[:3]  # .41 shows end-systole, .4
    assert kept.covariance is not None and np.diag(kept.covariance).tolist() == [1.0, 4.0, 9.0]
    assert said == [
        "2 targets of 2 frames after end-systole are not calibrated to: how the pressure falls there is not known, and would be "
        "taken for stiffness. They are there to be foretold; with loads.transient_mmhg they count."
    ]
    assert of_known_loads(scene_with(), kept) == (kept, [])
    own = scene_with("loads.transient_mmhg=[[0, 8], [0.4, 20], [1, 8]]")
    assert of_known_loads(own, given) == (given, [])
    with pytest.raises(UsageError, match="all targets are of frames after end-systole"):
        of_known_loads(scene_with(), given.select(names[3:]))
