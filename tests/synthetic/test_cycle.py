"""The synthetic cycle: parameters within the study's ranges, a scene that goes up and down again, places spread out."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy.surface_features import Endocardium
from lacli.base.errors import AnatomyError
from lacli.contracts.parameters import parameter_box
from lacli.mechanics.pressure import Pressure
from lacli.synthetic import cycle, gated, gated_case
from lacli.synthetic.atrium import synthesize
from lacli.synthetic.atrium_folder import _finished

BOX = parameter_box()


def test_every_seed_s_patient_is_within_the_ranges_and_its_own() -> None:
    found = [cycle.draw_parameters(seed) for seed in range(30)]
    assert found[3] == cycle.draw_parameters(3)
    assert len({json.dumps(p) for p in found}) == 30
    for parameters in found:
        for name, value in parameters.items():
            low, high = BOX[name]
            assert low < value < high, name
    alpha = np.array([[p[f"alpha_{r}"] for r in ("anterior", "posterior", "septum", "lateral", "roof")] for p in found])
    assert (np.ptp(np.log(alpha), axis=1) > 0.05).all(), "stiffness differs between regions"


def test_the_cycle_s_pressure_rises_to_end_systole_and_returns(tmp_path: Path) -> None:
    parameters = cycle.draw_parameters(1)
    scene = cycle.cycle_scene(tmp_path / "la", parameters, 0.4, 1)
    assert scene.numerics.order == 1 and scene.outputs.conduit
    mmhg = [Pressure(scene.loads, scene.motion.es_time).kpa(t) / 0.133322 for t in np.linspace(0.0, 1.0, 101)]
    assert mmhg[0] == pytest.approx(parameters["edp_mmhg"], rel=1e-3) and mmhg[-1] == pytest.approx(mmhg[0], rel=1e-3)
    assert max(mmhg) == pytest.approx(parameters["esp_mmhg"], rel=1e-3)
    assert int(np.argmax(mmhg)) == 40
    assert min(mmhg) > 0


def test_points_spread_over_a_box() -> None:
    grid = cycle._box(np.zeros(3), np.ones(3), 0.25)
    assert len(grid) == 5**3 - 3**3
    chosen = cycle.farthest_points(grid, 8)
    assert len(set(chosen.tolist())) == 8
    apart = np.linalg.norm(grid[chosen][:, None] - grid[chosen][None], axis=2) + 9.0 * np.eye(8)
    assert apart.min() >= 0.7 and apart[0, 1] == pytest.approx(np.sqrt(3.0)), "the second is the opposite corner"
    assert len(cycle.farthest_points(grid[:3], 8)) == 3


def test_spline_weights_reproduce_cubics() -> None:
    index = np.array([3.25, 4.5, 6.75])
    weights = cycle._spline_weights(12, index)
    values = np.arange(12.0) ** 2 - 3.0 * np.arange(12.0)
    assert np.asarray(weights @ values).ravel() == pytest.approx(index**2 - 3.0 * index, abs=0.05)
    outside = cycle._spline_weights(12, np.array([-1.0, 12.5]))
    assert np.abs(np.asarray(outside @ values)).max() == 0.0


def test_texture_has_its_strength_whatever_the_voxels() -> None:
    for spacing in (1.0, 0.6):
        made = gated.texture((40, 40, 40), np.full(3, spacing), np.random.default_rng(0))
        assert made.shape == (40, 40, 40)
        assert made.std() == pytest.approx(gated.TEXTURE_HU, rel=0.25)
    assert abs(float(np.corrcoef(made[:-1].ravel(), made[1:].ravel())[0, 1])) > 0.5, "lumps, not white noise"


def test_a_folder_of_something_else_is_never_replaced(tmp_path: Path) -> None:
    assert gated_case.finished(tmp_path / "new", {"seed": 1}) is None
    assert _finished(tmp_path / "new", {"seed": 1}) is None
    for finished in (gated_case.finished, _finished):
        place = tmp_path / finished.__module__
        place.mkdir()
        assert finished(place, {"seed": 1}) is None, "empty"
        (place / "mine.txt").write_text("of the user's")
        with pytest.raises(AnatomyError, match="choose another folder or remove it"):
            finished(place, {"seed": 1})
        assert (place / "mine.txt").exists()
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / gated_case.DESCRIPTION).write_text('{"seed": 1, "options": {"voxel_mm": 1.0}}')
    assert gated_case.finished(tmp_path / "p", {"seed": 1}) is not None
    with pytest.raises(AnatomyError, match="made from other options"):
        gated_case.finished(tmp_path / "p", {"seed": 2})


def test_a_patient_of_another_heart_rate_is_not_kept(tmp_path: Path) -> None:
    acquisition = gated.Acquisition()
    made_from = {"seed": 1, "atrium": {}, "acquisition": asdict(acquisition), "parameters": cycle.draw_parameters(1)}
    (tmp_path / gated_case.DESCRIPTION).write_text(json.dumps({**made_from, "heart_rate_bpm": 65.0, "method": gated_case.METHOD}))
    again = gated_case.write_patient(tmp_path, 1, {}, {}, acquisition, 65.0, lambda *_: None)
    assert again["heart_rate_bpm"] == 65.0
    with pytest.raises(AnatomyError, match="made from other options"):
        gated_case.write_patient(tmp_path, 1, {}, {}, acquisition, 80.0, lambda *_: None)
    (tmp_path / gated_case.DESCRIPTION).write_text(json.dumps({**made_from, "heart_rate_bpm": 65.0}))
    with pytest.raises(AnatomyError, match="made from other options"):  # by an earlier method
        gated_case.write_patient(tmp_path, 1, {}, {}, acquisition, 65.0, lambda *_: None)


def test_the_images_move_as_the_wall_was_simulated() -> None:
    """The motion of all of space at the wall's points, those that it was not fitted to among them."""
    bundle, _ = synthesize(3, cell_size_mm=8.0, order=1)
    x = bundle.points
    middle = x.mean(axis=0)
    # swells by half a centimetre, in folds of 15 mm, and back
    reach = np.linalg.norm(x - middle, axis=1, keepdims=True)
    swollen = (x - middle) / reach * (4.0 + 2.0 * np.sin(2.0 * np.pi * x[:, 2:] / 15.0)) + np.array([0.0, 0.0, -3.0])
    moved = cycle.Cycle(np.array([0.0, 0.4, 1.0]), np.stack([np.zeros_like(x), swollen, np.zeros_like(x)]))
    imaged = cycle.SpaceMotion.extend(moved, x).at(0.4)(x)
    off = np.linalg.norm(imaged - swollen, axis=1)
    assert np.sqrt((off**2).mean()) < 0.03 * np.sqrt((swollen**2).sum(axis=1).mean())
    surface = Endocardium.of(bundle)
    still, true, shown = (surface.features(at)["volume_ml"] for at in (x, x + swollen, x + imaged))
    assert shown - still == pytest.approx(true - still, rel=0.01)
