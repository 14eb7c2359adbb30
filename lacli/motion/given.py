"""Motion that somebody else tracked: displacement fields, surfaces frame by frame, label maps; as displacement of the bundle."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy.inputs import extraction, image
from lacli.anatomy.inputs.meshes import surfacefile
from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import InputError, UsageError
from lacli.base.notes import note
from lacli.contracts.bundle import Bundle
from lacli.motion.field import read_field
from lacli.motion.frames import by_number
from lacli.motion.tracking import Monitor

KINDS = ("fields", "surfaces", "other-surfaces", "labels")
FARTHEST_MM = 5.0  # of the bundle's endocardium from a surface that is said to be its own
_NEIGHBOURS = 6
_MOST_POINTS = 2_000_000


def displacement(bundle: Bundle, kind: str, files: Sequence[Path], frame: str, label: int | None, monitor: Monitor) -> FloatArray:
    """(f, n, 3) mm of the bundle's points, the first frame 0.

    fields: one a frame after end-diastole, of end-diastole's points (ITK's direction). surfaces: the same points in every frame,
    end-diastole first. other-surfaces, labels: every frame's own points, end-diastole first; matched to the bundle's endocardium
    by closest points that keep smooth, which tells the motion along the normal well and the tangential motion hardly.
    """
    if kind not in KINDS:
        raise UsageError(f"--motion {kind}: there are images, {', '.join(KINDS)}.")
    paths = [p for path in files for p in (by_number(filter(Path.is_file, path.iterdir())) if path.is_dir() else [path])]
    if kind == "fields":
        return _from_fields(bundle, paths, frame, monitor)
    meshes = []
    for number, path in enumerate(paths):
        meshes.append(_label_surface(path, label) if kind == "labels" else _read_surface(path, frame))
        monitor("reading frames", number + 1, len(paths))
    if len(meshes) < 3:
        raise InputError(f"{len(meshes)} frames; a cycle needs at least 3, end-diastole first.")
    surface = Endocardium.of(bundle)
    _check_near(surface, meshes[0][0], paths[0])
    if kind == "surfaces":
        return _same_points(bundle, meshes, paths)
    return _other_points(bundle, surface, meshes, monitor)


def _from_fields(bundle: Bundle, paths: Sequence[Path], frame: str, monitor: Monitor) -> FloatArray:
    moved = [np.zeros_like(bundle.points)]
    for number, path in enumerate(paths):
        field = read_field(path, "ras" if frame == "ras" else "lps")
        inside = field.covers(bundle.points)
        if inside < 0.98:
            raise InputError(f"{path}: the field covers {100 * inside:.0f} % of the bundle; is it of the same patient (LPS mm)?")
        moved.append(field.at(bundle.points))
        monitor("reading fields", number + 1, len(paths))
    return np.stack(moved)


def _read_surface(path: Path, frame: str) -> tuple[FloatArray, IntArray]:
    if not path.is_file():
        raise InputError(f"{path}: no such frame.")
    points, faces = surfacefile.read(path)
    if not len(points) or len(points) > _MOST_POINTS or not np.isfinite(points).all():
        raise InputError(f"{path}: the surface has no points, too many, or some that are not finite.")
    return (points * [-1.0, -1.0, 1.0] if frame == "ras" else points), faces


def _label_surface(path: Path, label: int | None) -> tuple[FloatArray, IntArray]:
    labels = image.read(path)
    volumes = image.label_volumes(labels)
    if label is None or label not in volumes:
        raise UsageError(f"{path}: give the blood's label with --label; there are {', '.join(map(str, volumes))}.")
    surface = extraction.surface_of(extraction.blood_pool(labels, label).mask)
    for doubt in labels.doubts(surface.points.mean(axis=0)):
        note(f"{path.parent}: {doubt}")  # once for frames that lie together
    return surface.points, surface.triangles


def _check_near(surface: Endocardium, points: FloatArray, path: Path) -> None:
    nodes = np.unique(surface.faces)
    distance = cKDTree(points).query(surface.ed[nodes])[0]
    if float(np.median(distance)) > FARTHEST_MM:
        raise InputError(
            f"{path}: lies {np.median(distance):.0f} mm from the bundle's endocardium (median); is it the end-diastole of the "
            "same patient, in mm, and its axes as --axes says?"
        )


def _same_points(bundle: Bundle, meshes: Sequence[tuple[FloatArray, IntArray]], paths: Sequence[Path]) -> FloatArray:
    """The displacement of the given points, carried over to the bundle's by inverse distance among the nearest."""
    first = meshes[0][0]
    for (points, _), path in zip(meshes, paths, strict=True):
        if len(points) != len(first):
            raise InputError(
                f"{path}: {len(points)} points, but {paths[0]} has {len(first)}. Surfaces with points of their own: --motion "
                "other-surfaces."
            )
    return np.stack([_carried(first, points - first, bundle.points) for points, _ in meshes])


def _carried(places: FloatArray, values: FloatArray, points: FloatArray) -> FloatArray:
    distance, index = cKDTree(places).query(points, k=min(_NEIGHBOURS, len(places)))
    weight = 1.0 / np.maximum(distance, 1e-6) ** 2
    return np.einsum("nk,nki->ni", weight / weight.sum(axis=1, keepdims=True), values[index])


def _other_points(
    bundle: Bundle, surface: Endocardium, meshes: Sequence[tuple[FloatArray, IntArray]], monitor: Monitor
) -> FloatArray:
    """Closest points on each frame's surface, approached in rounds: each round's pull is smoothed over the endocardium, less and
    less, as in non-rigid ICP. What lies between end-diastole's surface and the bundle is not motion and is taken off."""
    nodes = np.unique(surface.faces)
    places = bundle.points[nodes]
    result: list[FloatArray] = []
    offset: FloatArray | None = None
    for number, (points, faces) in enumerate(meshes):
        dense = np.vstack([points, points[faces].mean(axis=1)])
        tree = cKDTree(dense)
        u = np.zeros_like(places) if not result else result[-1][nodes] + (0.0 if offset is None else offset)
        for reach in (20.0, 12.0, 8.0, 5.0, 4.0, 3.0):
            pull = dense[tree.query(places + u)[1]] - (places + u)
            u = u + _blurred(places, pull, reach)
        if offset is None:
            offset = u
        result.append(_carried(places, u - offset, bundle.points))
        monitor("matching surfaces", number + 1, len(meshes))
    return np.stack(result)


def _blurred(places: FloatArray, values: FloatArray, reach: float) -> FloatArray:
    """Gaussian mean of values (n, 3) over points within twice ``reach`` mm."""
    near = cKDTree(places).sparse_distance_matrix(cKDTree(places), 2.0 * reach, output_type="coo_matrix").tocsr()
    near.data = np.exp(-0.5 * (near.data / reach) ** 2)
    near.setdiag(1.0)
    total = np.asarray(near.sum(axis=1)).ravel()
    return np.asarray(near @ values) / total[:, None]
