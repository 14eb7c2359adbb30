"""Fat of known volume on a thin wall round a ball of blood; the blur found; the distance that the synthetic truth counts by."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from shapes import icosphere

from lacli.anatomy.inputs import image
from lacli.anatomy.inputs.image import Image
from lacli.anatomy.wall import fat
from lacli.synthetic import image as synthetic_image

BLOOD_MM, WALL_MM, OUTER_MM = 15.0, 2.0, 23.0
STEP, BLUR_MM = 0.8, 0.5


@pytest.fixture(scope="module")
def ct() -> Image:
    """Blood 350 HU to 15 mm, wall 100 HU to 17 mm, fat -100 HU to 23 mm where x > 0, tissue 40 HU; noise of 25 HU."""
    fine = STEP / 2
    size = 128
    axis = (np.arange(size) - (size - 1) / 2) * fine
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    radius = np.sqrt(x**2 + y**2 + z**2)
    hu = np.where(radius < BLOOD_MM, 350.0, np.where(radius < BLOOD_MM + WALL_MM, 100.0, 40.0))
    hu[(radius >= BLOOD_MM + WALL_MM) & (radius < OUTER_MM) & (x > 0)] = -100.0
    hu = ndimage.gaussian_filter(hu, BLUR_MM / fine)
    hu = hu.reshape(size // 2, 2, size // 2, 2, size // 2, 2).mean(axis=(1, 3, 5))
    hu += np.random.default_rng(5).normal(0.0, 25.0, hu.shape)
    first = axis[0] + fine / 2
    return Image(hu.astype(np.float32), np.full(3, STEP), np.full(3, first), np.eye(3))


@pytest.mark.parametrize("window", ["standard", "alternative"])
def test_fat_on_a_thin_wall_is_measured_in_either_window(ct: Image, window: str) -> None:
    found = fat.segment(ct, icosphere(BLOOD_MM, 5), None, window)
    # half a shell from 17 to 20 mm (5 mm from the blood): 2/3 pi (20^3 - 17^3) = 6.465 mL
    assert found.volume_ml == pytest.approx(2 / 3 * np.pi * (20.0**3 - 17.0**3) / 1000, rel=0.03)
    # the window alone loses voxels mixed with wall: -30 HU of -100 .. 100 is 0.21 mm inside the edge (0.55 mm blur), on
    # 2 pi 17^2 mm2 that is 0.38 mL, 6 %; with the alternative window more
    assert found.window_ml < 0.96 * found.volume_ml


def test_the_blur_of_the_blood_is_found_and_none_where_there_is_no_contrast(ct: Image) -> None:
    dense = ndimage.median_filter(ct.array, 3) < -30
    height = fat._heights(ct, icosphere(BLOOD_MM, 5), dense, 5.0)
    edge = fat.blood_edge(ct.array.astype(float), height, dense)
    assert edge is not None
    assert edge.blood_hu == pytest.approx(350, abs=10)
    # the Gaussian and a voxel's box: sqrt(0.5^2 + 0.8^2 / 12) = 0.55 mm
    assert edge.blur_mm == pytest.approx(0.55, abs=0.08)
    assert edge.shift_mm == pytest.approx(0.0, abs=0.1)
    assert edge.blood_share(np.array([-9.0, edge.shift_mm, 9.0])) == pytest.approx([1.0, 0.5, 0.0], abs=1e-9)
    assert fat.blood_edge(np.minimum(ct.array, 60).astype(float), height, dense) is None


def test_signed_distance_to_a_ball() -> None:
    points = np.array([[12.0, 0, 0], [0, 18.0, 0], [0, 0, -19.9], [0, 20.3, 0]])
    distance = fat._signed_distance(points, icosphere(BLOOD_MM, 5), 5.0)
    assert distance[:3] == pytest.approx([-3.0, 3.0, 4.9], abs=0.03)
    assert np.isinf(distance[3])


def test_the_truth_counts_by_distance_not_by_the_shape_s_own_measure() -> None:
    # a measure that is nine tenths of the distance to a ball of 12 mm: where it says 4.5 mm it is 5 mm
    grid = synthetic_image.Grid(np.full(3, -20.0), np.ones(3), np.full(3, 41))
    radius = np.linalg.norm(np.stack([grid.points(k) for k in range(41)]), axis=2).reshape(41, 41, 41)
    measure = 0.9 * (radius - 12.0)
    bias = synthetic_image._bias(measure, grid)
    near = np.abs(measure - 4.5) < 0.2
    assert (measure + bias)[near] == pytest.approx((radius - 12.0)[near], abs=0.1)
    assert bias[20, 20, 20] == 0.0


def test_the_command_writes_surface_voxels_and_figures(ct: Image, tmp_path: Path) -> None:
    import meshio
    from typer.testing import CliRunner

    from lacli.cli.main import build as application

    index = np.argwhere(np.ones(ct.array.shape, dtype=bool))
    radius = np.linalg.norm(ct.to_world(index[:, ::-1]), axis=1).reshape(ct.array.shape)
    image.write(ct, tmp_path / "ct.nrrd")
    image.write(ct.with_array(np.where(radius < BLOOD_MM, 2, 0).astype(np.int16)), tmp_path / "labels.nrrd")
    words = f"fat {tmp_path}/ct.nrrd --labels {tmp_path}/labels.nrrd --la 2 --out {tmp_path}/fat --json"
    run = CliRunner().invoke(application({"fat"}), words)
    assert run.exit_code == 0, run.output
    windows = json.loads(run.stdout)["windows"]
    for window in ("standard", "alternative"):
        assert windows[window]["fat_ml"] == pytest.approx(2 / 3 * np.pi * (20.0**3 - 17.0**3) / 1000, rel=0.03)
    assert sorted(p.name for p in (tmp_path / "fat").iterdir()) == ["fat.json", "fat.vtp", "fat.vtu"]
    cells = meshio.read(tmp_path / "fat" / "fat.vtu").cells_dict["hexahedron"]
    assert len(cells) * STEP**3 / 1000 == pytest.approx(windows["standard"]["voxels_in_window_ml"])
