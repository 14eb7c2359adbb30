"""A surface from voxels without the voxels' own waves: as curved as the truth, where it was, of the same volume."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import cut_ball

from lacli.anatomy.inputs import extraction, ripples
from lacli.anatomy.inputs.image import Image
from lacli.geometry.surface import Surface

RADIUS = 22.0


def voxels_of_ball(voxel_mm: float) -> Image:
    axis = np.arange(-30.0, 30.0, voxel_mm) + 0.31
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    return Image(x**2 + y**2 + z**2 <= RADIUS**2, np.full(3, voxel_mm), np.full(3, axis[0]), np.eye(3))


@pytest.mark.parametrize("grid_mm", [0.4, 0.8])
@pytest.mark.parametrize(
    ("wave_mm", "kept"), [(5.0, (-0.05, 0.05)), (6.5, (0.0, 0.2)), (8.2, (0.35, 0.65)), (12.0, (0.9, 1.05)), (24.0, (0.98, 1.02))]
)
def test_short_waves_go_and_long_ones_stay(grid_mm: float, wave_mm: float, kept: tuple[float, float]) -> None:
    """Of a ball with waves of a tenth of a millimetre around its equator; its own voxels' waves are those without them."""
    way = extraction.surface_of(voxels_of_ball(1.5), None, grid_mm)
    unit = way.points / np.linalg.norm(way.points, axis=1)[:, None]
    near = np.abs(unit[:, 2]) < 0.15
    wave = np.cos(round(2.0 * np.pi * RADIUS / wave_mm) * np.arctan2(unit[:, 1], unit[:, 0]))
    ball, rough = (Surface((RADIUS + height * wave)[:, None] * unit, way.triangles, way.label) for height in (0.0, 0.1))
    left, without = (np.linalg.norm(ripples.evened(one, 8.0).points, axis=1)[near] for one in (rough, ball))
    amplitude = float((left - without) @ wave[near] / (wave[near] @ wave[near]))
    assert kept[0] < amplitude / 0.1 < kept[1]


@pytest.mark.parametrize("voxel_mm", [0.75, 1.5])
def test_what_voxels_leave_is_less(voxel_mm: float) -> None:
    made = extraction.surface_of(voxels_of_ball(voxel_mm), None, 0.8)
    even = ripples.evened(made, ripples.wave_of(voxel_mm))
    before, after = (np.linalg.norm(one.points, axis=1) for one in (made, even))
    assert after.std() < before.std() and np.abs(after - RADIUS).max() < 0.3 * voxel_mm
    assert even.volume_ml() == pytest.approx(made.volume_ml(), rel=1e-5)
    assert (even.triangles == made.triangles).all()


def test_rims_and_planes_stay() -> None:
    ball = cut_ball()
    plane = np.unique(ball.triangles[ball.label != 0])
    moved = Surface(ball.points + np.random.default_rng(0).normal(0.0, 0.05, ball.points.shape), ball.triangles, ball.label)
    even = ripples.evened(moved, 8.0)
    assert (even.points[plane] == moved.points[plane]).all()
    rest = np.setdiff1d(np.arange(len(ball.points)), plane)
    assert (even.points[rest] != moved.points[rest]).any()


def test_no_triangle_is_turned_over() -> None:
    made = extraction.surface_of(voxels_of_ball(1.5), None, 0.8)
    spiky = made.points.copy()
    spiky[::97] *= 1.05  # spikes of a millimetre, which the filter pulls in
    rough = Surface(spiky, made.triangles, made.label)
    even = ripples.evened(rough, 12.0)
    assert ((even.normals() * rough.normals()).sum(axis=1) >= 0.0).all()
