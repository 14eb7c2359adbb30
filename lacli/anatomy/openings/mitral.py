"""Where the mitral valve is: from the contact with the ventricle, or from the atrium's shape alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings import branches
from lacli.anatomy.openings.candidate import CONTACT, Candidate
from lacli.anatomy.openings.landmarks import Opening
from lacli.anatomy.openings.ostium import across
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.geometry import curves as paths
from lacli.geometry.surface import Surface

LEAST_CUT_MM = 0.5
UNDER_MM = 0.7  # a flat patch is cut that far under it
FLAT_COSINE, FLAT_MM = 0.97, 0.6  # of a flat patch: its triangles' normals with its own, their distance from its plane
# Half of a flat patch's border turns by that much where a valve was closed by a plane (52 - 77 degrees, domes up to 1.5 mm
# included, all of them within 6 mm of the valve), by 20 - 48 where the body happens to be flat (benchmarks/closed_valve.py).
SHARP_DEG = 50.0
BEYOND_MM = (2.5, 4.5)  # of the patch, where the surface is looked at for that


def lv_contact(labels: Image, lv: int, surface: Surface) -> FloatArray | None:
    """(k, 3) mm: points of the surface that face the ventricle's voxels; None where fewer than an annulus would give.

    The distance allowed grows from 1.5 voxels to 6 mm, for maps that leave room for the leaflets.
    """
    where = labels.array == lv
    if not where.any():
        raise AnatomyError(f"label {lv} (left ventricle) has no voxel in the image.")
    shell = where & ~ndimage.binary_erosion(where)
    voxels = labels.to_world(np.argwhere(shell)[:, ::-1])
    low, high = surface.points.min(axis=0) - 8.0, surface.points.max(axis=0) + 8.0
    voxels = voxels[((voxels > low) & (voxels < high)).all(axis=1)]
    if len(voxels) == 0:
        return None
    distance, _ = cKDTree(voxels).query(surface.points, distance_upper_bound=8.0)
    point_area = np.bincount(
        surface.triangles.ravel(), weights=np.repeat(surface.areas() / 3.0, 3), minlength=len(surface.points)
    )
    for reach in (1.5 * float(labels.spacing.max()), 2.0, 3.0, 4.5, 6.0):
        near = distance <= reach
        if point_area[near].sum() >= 200.0:
            return surface.points[near]
    return None


def mitral_from_contact(surface: Surface, contact: FloatArray) -> Opening:
    """The plane through the border of the patch that faces the ventricle; its normal points there."""
    near = np.zeros(len(surface.points), dtype=bool)
    near[cKDTree(surface.points).query(contact)[1]] = True
    patch = near[surface.triangles].all(axis=1)
    _, part = paths.triangle_components(surface.triangles, patch)
    if not patch.any():
        raise AnatomyError("the ventricle touches the atrium in scattered points only; give [mv] in landmarks.toml.")
    area = surface.areas()
    patch = part == int(np.argmax(np.bincount(part[patch], weights=area[patch])))
    vectors = surface.area_vectors()[patch]
    outward = vectors.sum(axis=0)
    outward /= np.linalg.norm(outward)
    edge = paths.border_edges(surface.triangles, patch)
    rim = max(paths.loops(edge), key=lambda loop: paths.perimeter(surface.points, loop))
    ring = surface.points[rim]
    centre = ring.mean(axis=0)
    _, _, axes = np.linalg.svd(ring - centre)
    normal = axes[2] * np.sign(axes[2] @ outward)
    if normal @ outward < 0.5:  # a ragged border: the patch's own mean direction is safer
        normal = outward
    middle = surface.points[surface.triangles[patch]].mean(axis=1)
    beyond = middle[int(np.argmax((middle - centre) @ normal))]
    size = float(area[patch].sum())
    ratio = float(np.linalg.norm(vectors.sum(axis=0)) / size)
    # a flat patch is cut just under its top, so that the plane does not graze it
    top = float(((middle - centre) @ normal).max())
    if top < LEAST_CUT_MM:
        centre = centre - (LEAST_CUT_MM - top) * normal
    return Opening(
        "mv",
        centre,
        normal,
        beyond,
        float(2 * np.sqrt(size / np.pi)),
        round(min(0.99, ratio), 2),
        "contact with the left ventricle",
    )


def of_contact(surface: Surface, contact: FloatArray) -> Candidate:
    """The patch that faces the ventricle, as a candidate that is the mitral valve."""
    found = mitral_from_contact(surface, contact)
    area = np.pi * found.diameter_mm**2 / 4
    half = across(found.normal) * found.diameter_mm / 2
    return Candidate(found.centre, found.normal, area, CONTACT, half, tip=found.beyond)


def mitral_from_shape(surface: Surface, skeleton: branches.Skeleton, vessels: Sequence[Candidate]) -> Opening:
    """Without a ventricle: the largest flat patch of the surface, else the side opposite the ``vessels``."""
    normals, area = surface.normals(), surface.areas()
    middle = surface.points[surface.triangles].mean(axis=1)
    ostia = np.array([v.centre for v in vessels]) if vessels else skeleton.middle[None]
    down = skeleton.middle - ostia.mean(axis=0)
    down /= max(float(np.linalg.norm(down)), 1e-9)
    best: tuple[float, FloatArray, FloatArray] | None = None
    facing = np.flatnonzero(normals @ down > 0.2)
    for seed in facing[:: max(1, len(facing) // 150)]:
        n, c = normals[seed], middle[seed]
        flat = (normals @ n > FLAT_COSINE) & (np.abs((middle - c) @ n) < FLAT_MM)
        size = float(area[flat].sum())
        if best is None or size > best[0]:
            best = (size, n, np.average(middle[flat], axis=0, weights=area[flat]))
    if best is not None and best[0] > 350.0:
        size, normal, centre = best
        top = ((middle - centre) @ normal)[np.linalg.norm(middle - centre, axis=1) < np.sqrt(size)].max()
        centre = centre + (min(float(top), 0.0) - UNDER_MM) * normal
        return Opening("mv", centre, normal, centre + 2.0 * normal, float(2 * np.sqrt(size / np.pi)), 0.6, "largest flat patch")
    reach = float(((surface.points - skeleton.middle) @ down).max())
    centre = skeleton.middle + 0.75 * reach * down
    beyond = surface.points[int(np.argmax((surface.points - skeleton.middle) @ down))]
    return Opening("mv", centre, down, beyond, 30.0, 0.2, "opposite the veins")


def border_turn_deg(surface: Surface, patch: Candidate, sectors: int = 12) -> float:
    """By how much the surface turns just beyond the flat patch of ``mitral_from_shape``: median over the directions, degrees."""
    normal, middle = patch.direction, surface.points[surface.triangles].mean(axis=1)
    facing = surface.normals() @ normal
    step = middle - patch.centre
    height = step @ normal
    beside = step - height[:, None] * normal
    flat = (facing > FLAT_COSINE) & (np.abs(height - UNDER_MM) < FLAT_MM) & (np.linalg.norm(beside, axis=1) < patch.diameter_mm)
    if not flat.any():
        return 0.0
    gap, _ = cKDTree(middle[flat]).query(middle, distance_upper_bound=BEYOND_MM[1])
    band = (gap > BEYOND_MM[0]) & (gap < BEYOND_MM[1])
    one = across(normal)
    angle = np.arctan2(beside[band] @ np.cross(normal, one), beside[band] @ one)
    sector = np.minimum((angle + np.pi) / (2 * np.pi) * sectors, sectors - 1).astype(int)
    turn = np.degrees(np.arccos(np.clip(facing[band], -1.0, 1.0)))
    return float(np.median([np.median(turn[sector == k]) if (sector == k).any() else 0.0 for k in range(sectors)]))
