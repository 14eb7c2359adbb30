"""The waves that voxels leave on a surface, taken out: they are lower than a voxel, but bend it as much as an atrium bends.

A label's border is stairs. Smoothed, it is within a tenth of a voxel of the truth, and still has waves some voxels long, whose
curvature (height over length squared) is as large as a body's. Pressure and tension in a wall balance by curvature: they would be
of the stairs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray
from lacli.geometry import curves as paths
from lacli.geometry.surface import Surface

# waves shorter than this are taken out: no wall of millimetres has them, and no cells that are used would follow them
LEAST_WAVE_MM = 8.0
WAVE_VOXELS = 6.5  # and those that the steps of coarser voxels make
MOST_WAVE_MM = 12.0  # but no longer ones than this: ostia and appendages have them
_PERIODS = 17.0  # passes of the filter, over the root of its pass band: a steep one needs them
_HALF = 1.65  # the shortest wave that passes whole, over that of which a half does
_TRIES = 10


def wave_of(voxel_mm: float) -> float:
    """Wave length (mm) below which a surface from voxels is taken for the voxels' own."""
    return min(max(LEAST_WAVE_MM, WAVE_VOXELS * voxel_mm), MOST_WAVE_MM)


def evened(surface: Surface, wave_mm: float) -> Surface:
    """The closed surface without waves shorter than ``wave_mm`` on its wall (label 0); planes, rims and volume stay.

    Of a wave as long as that a half is left, of one a fifth shorter a tenth, of one half as long again nearly all.

    Windowed sinc filter of the positions (Taubin, Zhang, Golub 1996), its pass band by the mean length of the edges. Where
    triangles would be turned over the surface is left as it is; so it is where ``wave_mm`` is 0, or shorter than its triangles.
    """
    import pyvista as pv

    if wave_mm <= 0.0:
        return surface
    wall = surface.label == 0
    used, local = np.unique(surface.triangles[wall], return_inverse=True)
    triangles = local.reshape(-1, 3)
    edges, _, _ = paths.edge_table(triangles)
    mesh = pv.PolyData.from_regular_faces(surface.points[used], triangles)
    length = float(np.linalg.norm(surface.points[used][edges[:, 0]] - surface.points[used][edges[:, 1]], axis=1).mean())
    # of a mesh of even triangles an umbrella's eigenvalue is (k h)^2 / 4, k = 2 pi / wave; the filter falls to a half beyond it
    band = (np.pi * length / (_HALF * wave_mm)) ** 2
    if band >= 1.0:
        return surface
    passes = int(np.clip(_PERIODS / np.sqrt(band), 20, 400))
    done = mesh.smooth_taubin(n_iter=passes, pass_band=band, normalize_coordinates=True, boundary_smoothing=False)
    free = np.zeros(len(surface.points), dtype=bool)
    free[used] = True
    free[surface.triangles[~wall]] = False
    points = surface.points.copy()
    points[used] = np.where(free[used, None], np.asarray(done.points, dtype=float), points[used])
    return _volume_kept(surface, _unturned(surface, points), free)


def _unturned(surface: Surface, points: FloatArray) -> FloatArray:
    """The new points but for those whose triangles would be turned over."""
    before = surface.normals()
    for _ in range(_TRIES):
        turned = (replace(surface, points=points).normals() * before).sum(axis=1) < 0.0
        if not turned.any():
            return points
        back = np.unique(surface.triangles[turned])
        points = points.copy()
        points[back] = surface.points[back]
    return surface.points


def _volume_kept(before: Surface, points: FloatArray, free: BoolArray) -> Surface:
    """With the free points moved along their normals by what the volume has changed by over their area."""
    now = replace(before, points=points)
    vectors = np.zeros_like(points)
    for corner in now.triangles.T:
        np.add.at(vectors, corner, now.area_vectors() / 3.0)
    area = np.linalg.norm(vectors, axis=1)
    whole = float(area[free].sum())
    if whole <= 0.0:
        return now
    step = 1000.0 * (before.volume_ml() - now.volume_ml()) / whole
    moved = points + np.where(free, step, 0.0)[:, None] * vectors / np.maximum(area, 1e-30)[:, None]
    return replace(now, points=_unturned(before, moved))
