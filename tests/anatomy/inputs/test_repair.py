"""Surfaces as they come: every damage is repaired and said, or refused with a reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from shapes import icosphere

from lacli.anatomy.inputs import repair, voxels
from lacli.anatomy.inputs.meshes import surfacefile
from lacli.base.errors import AnatomyError, InputError

EXACT_ML = 4 / 3 * np.pi * 20**3 / 1000


def sphere() -> tuple[np.ndarray, np.ndarray]:
    ball = icosphere(20.0, 4)
    return ball.points.copy(), ball.triangles.copy()


def test_a_clean_sphere_is_left_alone() -> None:
    points, triangles = sphere()
    done = repair.repair(points, triangles)
    assert done.notes == ()
    assert len(done.surface.triangles) == len(triangles)
    assert done.surface.volume_ml() == pytest.approx(EXACT_ML, rel=0.01)


def test_turned_doubled_scaled_and_extra_parts_are_put_right() -> None:
    points, triangles = sphere()
    rng = np.random.default_rng(0)
    mixed = np.where((rng.random(len(triangles)) < 0.4)[:, None], triangles[:, ::-1], triangles)
    small, extra = icosphere(2.0, 1).points + 40.0, icosphere(2.0, 1).triangles
    soup = np.vstack([points, points, small]) * 1000.0  # micrometres, every point twice
    cells = np.vstack([mixed[::2], mixed[1::2] + len(points), extra + 2 * len(points), mixed[:10]])
    done = repair.repair(soup, cells)
    assert done.scale == 1e-3
    assert done.surface.is_closed()
    assert done.surface.volume_ml() == pytest.approx(EXACT_ML, rel=0.01)
    said = " ".join(done.notes)
    for word in ("micrometres", "duplicate points", "degenerate or duplicate", "unconnected", "turned"):
        assert word in said


def test_holes_are_filled_and_openings_kept() -> None:
    points, triangles = sphere()
    middle = points[triangles].mean(axis=1)
    keep = middle[:, 2] < 17.0  # an opening of 2 pi sqrt(20^2 - 17^2) = 66 mm
    for direction in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]):  # as many rims as an atrium has
        keep &= np.linalg.norm(middle - 20.0 * np.array(direction), axis=1) > 1.5
    done = repair.repair(points, triangles[keep])
    assert done.surface.is_closed()
    assert "caps" not in " ".join(done.notes)
    assert len([r for r in done.rims if np.pi * r.diameter_mm > 50]) == 1
    rim = done.rims[0]
    assert np.pi * rim.diameter_mm == pytest.approx(66, abs=5)
    assert rim.direction[2] > 0.99
    # the cap of height 3 over the plane z = 17 is missing: pi h^2 (3 r - h) / 3 = 0.537 mL
    assert done.surface.volume_ml() == pytest.approx(EXACT_ML - 0.537, rel=0.02)


def test_a_soup_is_rebuilt_from_voxels() -> None:
    points, triangles = sphere()
    rng = np.random.default_rng(1)
    corners = points[triangles] + rng.normal(0, 0.05, (len(triangles), 1, 3))
    apart = np.arange(3 * len(triangles)).reshape(-1, 3)
    done = repair.repair(corners.reshape(-1, 3), apart)
    assert done.surface.is_closed()
    assert "rebuilt from voxels" in " ".join(done.notes)
    assert done.surface.volume_ml() == pytest.approx(EXACT_ML, rel=0.06)


def test_what_is_no_atrium_is_refused() -> None:
    points, triangles = sphere()
    with pytest.raises(AnatomyError, match="units wide"):
        surfacefile.unit_scale(np.array([[0.0, 0, 0], [900, 0, 0]]))
    with pytest.raises(AnatomyError, match="unconnected parts"):
        repair.repair(np.vstack([points, points + 50.0]), np.vstack([triangles, triangles + len(points)]))
    with pytest.raises(AnatomyError, match="finite"):
        repair.repair(np.full_like(points, np.nan), triangles)
    with pytest.raises(AnatomyError, match="no cavity"):
        plane = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0]), -1).reshape(-1, 3)
        i, j = np.meshgrid(np.arange(39), np.arange(39))
        a = (i * 40 + j).ravel()
        voxels.from_voxels(plane, np.vstack([np.column_stack([a, a + 1, a + 40]), np.column_stack([a + 1, a + 41, a + 40])]))


@pytest.mark.parametrize("ending", ["stl", "ply", "vtp", "vtk", "obj"])
def test_formats_are_read_and_damage_is_named(tmp_path: Path, ending: str) -> None:
    import pyvista as pv

    points, triangles = sphere()
    file = tmp_path / f"ball.{ending}"
    pv.PolyData(points, np.column_stack([np.full(len(triangles), 3), triangles]).ravel()).save(file)
    got, cells = surfacefile.read(file)
    assert repair.repair(got, cells).surface.volume_ml() == pytest.approx(EXACT_ML, rel=0.01)
    (tmp_path / f"empty.{ending}").write_bytes(b"")
    with pytest.raises(InputError, match="empty"):
        surfacefile.read(tmp_path / f"empty.{ending}")
