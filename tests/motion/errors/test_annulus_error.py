"""The mitral annulus, which moves simulations: the share of its motion that registration loses is undone, and its error said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy.surface_features import Endocardium
from lacli.base.documents import read_json
from lacli.contracts.motion import load_motion
from lacli.motion.annulus import annulus_points
from lacli.motion.errors.ring import AnnulusError, annulus_error
from lacli.motion.errors.uncertainty import ErrorModel
from lacli.motion.patient import Tracked
from lacli.motion.store import write_all
from lacli.motion.targets import Course, measured
from lacli.synthetic.atrium import synthesize


def test_the_share_and_what_is_left_by_hand() -> None:
    # one point; slope (-.8 - .8) / (4 + 16) = -.08; left (-.4 + .16, .3) and (-.2 + .32, -.3), one of two motions for the share
    found = annulus_error(
        [np.array([[-0.4, 0.3, 0.0]]), np.array([[-0.2, -0.3, 0.0]])], [np.array([[2.0, 0, 0]]), np.array([[4.0, 0, 0]])]
    )
    assert found.share == pytest.approx(-0.08)
    left = np.array([[-0.24, 0.3], [0.12, -0.3]])
    assert found.noise_mm == pytest.approx(np.sqrt(2.0 * (left**2).sum() / 2))
    # by motion -.48 and .48; the half of the share is for what known motions do not tell
    assert found.sd == pytest.approx(np.sqrt(2.0 * 2 * 0.48**2 / 20**2 + 0.04**2))


def test_undone_positions_are_what_was_true_and_their_error_grows_with_the_motion() -> None:
    rest = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    true = np.stack([rest, rest + np.array([0.0, 0.0, 8.0])])
    error = AnnulusError(-0.1, 0.05, 0.27)
    assert error.undone(rest + 0.9 * (true - rest)) == pytest.approx(true)
    assert error.at(np.zeros((2, 3))) == pytest.approx(0.3)
    assert error.at(true[1] - rest) == pytest.approx(np.hypot(0.3, 0.05 * 8.0 / 0.9))


def test_a_simulation_s_annulus_goes_all_of_its_way_and_the_file_says_how_sure_that_is(tmp_path: Path) -> None:
    bundle, _ = synthesize(1, 40.0, cell_size_mm=9.0)
    times = np.arange(6) / 6
    # what registration finds of a growth by a fifth: nine tenths
    lost = 0.9 * 0.2 * np.sin(np.pi * times)[:, None, None] ** 2 * bundle.points
    course = Course.of(Endocardium.of(bundle), times, lost)
    keys = tuple(course.features[0])
    model = ErrorModel(keys, np.full(len(keys), 0.2), np.eye(len(keys)), 0.3, 5)
    info = {"engine": "greedy", "error_normal_mm": 0.2, "error_tangential_mm": 0.2}
    tracked = Tracked(course, model, [], None, None, AnnulusError(-0.1, 0.05, 0.2), info)
    said = write_all(tmp_path, bundle, tracked, measured(course, model), {})["annulus"]
    motion = load_motion(tmp_path)
    ring = bundle.points[annulus_points(bundle)]
    assert motion.positions[3] == pytest.approx(1.2 * ring), "the middle of the cycle"
    assert motion.positions[0] == pytest.approx(ring)
    length = 0.2 * np.linalg.norm(ring, axis=1)
    assert said["es_displacement_mm"] == pytest.approx(length.mean())
    assert said["es_error_mm"] == pytest.approx(np.hypot(0.2, 0.05 * np.sqrt((length**2).mean())) / 0.9)
    assert read_json(tmp_path / "tracking.json")["annulus"] == pytest.approx(said)
    with np.load(tmp_path / "motion.npz") as file:
        assert float(file["annulus_share"]) == -0.1 and float(file["annulus_error_mm"]) == pytest.approx(said["es_error_mm"])
        assert file["endo_positions"] == pytest.approx(course.positions[:, file["endo_point"]]), "as tracked"
