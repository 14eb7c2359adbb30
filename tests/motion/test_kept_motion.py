"""What tracking leaves: the same numbers come back by the readers, and no other files are overwritten."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import pyvista as pv
from shapes import hollow_cube

import lacli
from lacli.anatomy.surface_features import Endocardium
from lacli.base.errors import StorageError, TableError
from lacli.contracts.priors import read_prior_file
from lacli.contracts.targets import read_targets
from lacli.motion.errors.ring import AnnulusError
from lacli.motion.errors.uncertainty import ErrorModel
from lacli.motion.measured import write
from lacli.motion.patient import Tracked
from lacli.motion.store import COVARIANCE, check_replaceable, write_covaried, write_series
from lacli.motion.targets import Course, measured
from lacli.report import motion_figures
from lacli.synthetic.atrium import synthesize

TIMES = np.array([0.0, 0.2, 0.4, 0.6, 0.8])
STRETCH = 1.0 + 0.1 * np.sin(np.pi * TIMES / 0.8)


@pytest.fixture(scope="module")
def course() -> Course:
    bundle = hollow_cube()
    return Course.of(Endocardium.of(bundle), TIMES, (STRETCH[:, None, None] - 1.0) * bundle.points)


def test_targets_come_back_with_their_covariance(course: Course, tmp_path: Path) -> None:
    keys = tuple(course.features[0])
    model = ErrorModel(keys, np.linspace(0.1, 0.3, len(keys)), np.eye(len(keys)), 0.3, 20)
    found = measured(course, model)
    write_covaried(tmp_path, found, course.phases, "greedy")
    back = read_targets(tmp_path / "targets.toml")
    assert back.names == found.targets.names
    assert back.mean == pytest.approx(found.targets.mean) and back.sd == pytest.approx(found.targets.sd)
    assert back.covariance == pytest.approx(found.covariance)
    assert isinstance(Tracked(course, model, [], None, None, AnnulusError(0.0, 0.0, 0.1)).course, Course)


def test_what_is_known_of_pressures_stands_in_the_targets(course: Course, tmp_path: Path) -> None:
    file = tmp_path / "priors.toml"
    file.write_text("[priors.edp_mmhg]\nmean = 8.0\nsd = 1.5\n[priors.pth]\nlower = 0.6\nupper = 0.85\n")
    keys = tuple(course.features[0])
    found = measured(course, ErrorModel(keys, np.linspace(0.1, 0.3, len(keys)), np.eye(len(keys)), 0.3, 20))
    write_covaried(tmp_path, found.knowing(read_prior_file(file)), course.phases, "greedy")
    priors = read_targets(tmp_path / "targets.toml").priors
    assert priors is not None and [(one.name, one.distribution) for one in priors] == [("edp_mmhg", "normal"), ("pth", "uniform")]
    assert (priors[0].mean, priors[0].sd, priors[1].lower, priors[1].upper) == (8.0, 1.5, 0.6, 0.85)
    with pytest.raises(TableError, match="no such file of priors"):  # before anything else is read
        lacli.track([tmp_path], tmp_path / "no_bundle", tmp_path / "out", priors=tmp_path / "absent.toml")


def test_the_series_has_every_frame_s_displacement(course: Course, tmp_path: Path) -> None:
    bundle = hollow_cube()
    series = write_series(tmp_path / "frames", bundle, course.surface, TIMES, course.positions)
    listed = re.findall(r'timestep="([\d.]+)" file="(.+?)"', series.read_text(encoding="utf-8"))
    assert [float(t) for t, _ in listed] == pytest.approx(TIMES.tolist())
    for (_, name), stretch in zip(listed, STRETCH, strict=True):
        frame = pv.read(series.parent / name)
        at = np.asarray(frame.point_data["wall_point"])
        assert np.asarray(frame.points) == pytest.approx(stretch * bundle.points[at], abs=1e-4)
        assert np.asarray(frame.point_data["displacement"]) == pytest.approx((stretch - 1.0) * bundle.points[at], abs=1e-6)
    assert pd.DataFrame(course.features)["volume_ml"].to_numpy() == pytest.approx(
        course.features[0]["volume_ml"] * STRETCH**3, rel=1e-9
    )


def test_only_what_tracking_wrote_is_replaced(tmp_path: Path) -> None:
    check_replaceable(tmp_path)
    (tmp_path / COVARIANCE).write_bytes(b"somebody's")
    with pytest.raises(StorageError, match=f"holds {COVARIANCE} that `lacli track` did not write"):
        check_replaceable(tmp_path)
    (tmp_path / "tracking.json").write_text("{}")
    check_replaceable(tmp_path)


def test_pictures_of_a_former_motion_do_not_stay_beside_a_new_one(tmp_path: Path) -> None:
    bundle, _ = synthesize(1, 40.0, cell_size_mm=9.0)
    course = Course.of(Endocardium.of(bundle), TIMES, (STRETCH[:, None, None] - 1.0) * bundle.points)
    keys = tuple(course.features[0])
    model = ErrorModel(keys, np.full(len(keys), 0.2), np.eye(len(keys)), 0.3, 5)
    info = {"engine": "greedy", "error_normal_mm": 0.2, "error_tangential_mm": 0.2}
    tracked = Tracked(course, model, [], None, None, AnnulusError(0.0, 0.0, 0.1), info)
    folder = tmp_path / "motion"
    folder.mkdir()
    (folder / "slices.png").write_bytes(b"somebody's")
    for kept in (True, False):  # what stood there before the first motion is not tracking's
        write(folder, tmp_path / "bundle", bundle, tracked, measured(course, model), {}, False)
        assert (folder / "slices.png").exists() == kept
        (folder / "notes.txt").write_text("mine")
    assert (folder / "notes.txt").exists() and (folder / "frames" / "series.pvd").exists()


def test_frames_are_drawn_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    for number in (100, 11, 9, 10):
        pv.PolyData(np.array([[float(number), 0.0, 0.0]])).save(tmp_path / "frames" / f"frame_{number:02d}.vtp")
    assert [mesh.points[0, 0] for mesh in motion_figures._series(tmp_path)] == [9.0, 10.0, 11.0, 100.0]
